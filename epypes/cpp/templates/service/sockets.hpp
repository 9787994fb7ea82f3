// The ZeroMQ sockets of the service: one takes events, one publishes answers and answers subscribers that join.
//
// One thread uses them. A subscriber of EPypes also subscribes to a private topic, on which the publisher answers it
// alone: when that answer has come, its other subscriptions have arrived too, and it loses nothing from then on.
#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <optional>
#include <set>
#include <string>
#include <vector>
#include <zmq.hpp>

#include "codec.hpp"
#include "envelope.pb.h"

namespace service {

/// Unix time in nanoseconds.
inline std::int64_t unix_ns() {
    const auto since = std::chrono::system_clock::now().time_since_epoch();
    return std::chrono::duration_cast<std::chrono::nanoseconds>(since).count();
}

/// Random hexadecimal digits, two for each byte.
std::string random_hex(std::size_t bytes);

class Sockets {
  public:
    // Each address is bound; "connect:ADDRESS" is connected to. std::runtime_error where that is impossible.
    Sockets(const std::string& sub, const std::string& pub, bool insecure);

    // Where they are bound.
    const std::string& sub() const { return sub_address_; }
    const std::string& pub() const { return pub_address_; }

    // Waits until there is something to read, from a socket or one of two file descriptors.
    void wait(int first, int second, std::int64_t timeout_ms);

    // The next event, if one has arrived. Messages beyond the limits are read and counted.
    std::optional<Frames> receive();

    // Grants the subscriptions that have arrived, and answers subscribers that join.
    void read_subscriptions();

    // Sends a message, numbered; a subscriber that does not keep up loses it, and sees that in the numbers.
    void publish(const epypes::v1::Envelope& answer, const std::vector<std::string>& payloads);

    // No more events are taken.
    void close_events();

    // Ends; what was published still leaves, if a peer reads it.
    void close();

    std::uint64_t rejected() const { return rejected_; }

  private:
    zmq::context_t context_;
    zmq::socket_t events_;
    zmq::socket_t answers_;
    std::string sub_address_;
    std::string pub_address_;
    std::multiset<std::string> topics_;
    const std::string identity_;
    const std::int64_t epoch_;
    std::uint64_t sequence_ = 0;
    std::atomic<std::uint64_t> rejected_{0};
    bool takes_events_ = true;
};

}  // namespace service
