// Addresses of this machine alone.
#pragma once

#include <string>

namespace service {

// Whether other machines can't reach what is bound to a host.
inline bool is_loopback(const std::string& host) {
    return host == "localhost" || host == "[::1]" || host.rfind("127.", 0) == 0;
}

}  // namespace service
