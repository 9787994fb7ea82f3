// The HTTP control: the part of that of `epypes serve` which reads and changes hyperparameters.
//
// GET /livez, /readyz, /v1/info, /v1/parameters; PATCH /v1/parameters with the access key, as `epypes set` sends it.
#pragma once

#include <httplib.h>

#include <functional>
#include <string>
#include <thread>

#include "parameters.hpp"

namespace service {

class Control {
  public:
    // Binds HOST:PORT, or HOST for any port; std::runtime_error where that is impossible. The access key is in a file,
    // which is made if it is missing.
    Control(const std::string& address, const std::string& access_key_file, Parameters& parameters,
            std::function<Json()> info);
    ~Control();
    Control(const Control&) = delete;
    Control& operator=(const Control&) = delete;

    // As http://127.0.0.1:8642.
    const std::string& url() const { return url_; }

  private:
    void change(const httplib::Request& request, httplib::Response& response);

    Parameters& parameters_;
    std::string access_key_;
    std::string access_key_file_;
    std::string url_;
    httplib::Server server_;
    std::thread thread_;
};

}  // namespace service
