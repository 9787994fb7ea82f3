#include "sockets.hpp"

#include <sys/random.h>

#include <array>
#include <stdexcept>

#include "address.hpp"

namespace service {
namespace {

const std::string connect_prefix = "connect:";
const std::string join_prefix =
    "\xff\xff"
    "epypes/join/";
constexpr std::size_t identity_bytes = 16;
// Answers kept for a subscriber that does not read: images are large.
constexpr int most_kept_answers = 256;
constexpr int most_kept_events = 1000;
constexpr int linger_ms = 1000;
// What a peer sends to a publisher is a subscription; a topic has 1,024 bytes at most.
constexpr int most_subscription_bytes = 2048;
constexpr int most_kept_subscriptions = 100;
constexpr std::size_t most_topics = 16 * 1024;
// ZMQ_XPUB_MANUAL_LAST_VALUE: the next message goes only to the peer whose subscription was read last. It is a draft
// option, which libzmq takes all the same; where it is refused, the answer goes to all, and they ignore it.
constexpr int only_to_last_peer = 98;

void set_common_options(zmq::socket_t& socket) {
    // TCP drops a host that does not answer after 15 s.
    socket.set(zmq::sockopt::tcp_keepalive, 1);
    socket.set(zmq::sockopt::tcp_keepalive_idle, 5);
    socket.set(zmq::sockopt::tcp_keepalive_intvl, 5);
    socket.set(zmq::sockopt::tcp_keepalive_cnt, 2);
    socket.set(zmq::sockopt::handshake_ivl, 10'000);
    socket.set(zmq::sockopt::reconnect_ivl, 50);
    socket.set(zmq::sockopt::reconnect_ivl_max, 200);
}

// Binds or connects a socket; returns where it is.
std::string bind_or_connect(zmq::socket_t& socket, const std::string& address, bool insecure) {
    try {
        if (address.rfind(connect_prefix, 0) == 0) {
            socket.connect(address.substr(connect_prefix.size()));
            return address;
        }
        const std::string tcp = "tcp://";
        if (address.rfind(tcp, 0) == 0 && !insecure &&
            !is_loopback(address.substr(tcp.size(), address.rfind(':') - tcp.size()))) {
            throw std::runtime_error("Other machines can reach " + address + ". Bind 127.0.0.1, or say --insecure.");
        }
        socket.bind(address);
        return socket.get(zmq::sockopt::last_endpoint);
    } catch (const zmq::error_t& error) {
        throw std::runtime_error(address + " can't be opened: " + error.what() + ".");
    }
}

}  // namespace

std::string random_hex(std::size_t bytes) {
    std::string data(bytes, '\0');
    if (getrandom(data.data(), bytes, 0) != static_cast<ssize_t>(bytes)) {
        throw std::runtime_error("The system gives no random bytes.");
    }
    std::string text;
    for (const char byte : data) {
        constexpr char digits[] = "0123456789abcdef";
        text += digits[(byte >> 4) & 15];
        text += digits[byte & 15];
    }
    return text;
}

Sockets::Sockets(const std::string& sub, const std::string& pub, bool insecure)
    : events_(context_, zmq::socket_type::sub),
      answers_(context_, zmq::socket_type::xpub),
      identity_(random_hex(identity_bytes / 2)),
      epoch_(unix_ns()) {
    set_common_options(answers_);
    answers_.set(zmq::sockopt::xpub_manual, 1);
    answers_.set(zmq::sockopt::sndhwm, most_kept_answers);
    answers_.set(zmq::sockopt::linger, linger_ms);
    answers_.set(zmq::sockopt::maxmsgsize, std::int64_t{most_subscription_bytes});
    answers_.set(zmq::sockopt::rcvhwm, most_kept_subscriptions);
    pub_address_ = bind_or_connect(answers_, pub, insecure);
    set_common_options(events_);
    events_.set(zmq::sockopt::rcvhwm, most_kept_events);
    events_.set(zmq::sockopt::maxmsgsize, static_cast<std::int64_t>(limits::total_bytes));
    events_.set(zmq::sockopt::linger, 0);
    events_.set(zmq::sockopt::subscribe, "");
    sub_address_ = bind_or_connect(events_, sub, insecure);
}

void Sockets::wait(int first, int second, std::int64_t timeout_ms) {
    std::array<zmq::pollitem_t, 4> items{{{nullptr, first, ZMQ_POLLIN, 0},
                                          {nullptr, second, ZMQ_POLLIN, 0},
                                          {answers_.handle(), 0, ZMQ_POLLIN, 0},
                                          {takes_events_ ? events_.handle() : nullptr, 0, ZMQ_POLLIN, 0}}};
    try {
        zmq::poll(items.data(), takes_events_ ? 4 : 3, std::chrono::milliseconds(timeout_ms));
    } catch (const zmq::error_t& error) {
        // A debugger, or Ctrl+Z and fg.
        if (error.num() != EINTR) {
            throw;
        }
    }
}

std::optional<Frames> Sockets::receive() {
    Frames frames;
    std::size_t bytes = 0;
    bool is_refused = false;
    while (true) {
        zmq::message_t frame;
        if (!takes_events_ || !events_.recv(frame, zmq::recv_flags::dontwait)) {
            return std::nullopt;
        }
        const bool has_more = frame.more();
        bytes += frame.size();
        is_refused = is_refused || bytes > limits::total_bytes || frames.size() >= limits::frames + 2;
        if (is_refused) {
            frames.clear();
        } else {
            frames.push_back(std::move(frame));
        }
        if (has_more) {
            continue;
        }
        const bool is_join = frames.size() == 2 && frames[1].size() == identity_bytes &&
                             frames[0].to_string_view().substr(0, join_prefix.size()) == join_prefix;
        if (!is_refused && !is_join) {
            return frames;
        }
        rejected_ += is_refused ? 1 : 0;
        frames.clear();
        bytes = 0;
        is_refused = false;
    }
}

void Sockets::read_subscriptions() {
    zmq::message_t message;
    // Not without end: events and answers have their turn.
    for (int count = 0; count < 100 && answers_.recv(message, zmq::recv_flags::dontwait); ++count) {
        const auto* bytes = message.data<unsigned char>();
        if (message.size() == 0 || bytes[0] > 1) {
            continue;
        }
        const std::string topic = message.to_string().substr(1);
        const bool is_join = topic.rfind(join_prefix, 0) == 0;
        if (bytes[0] == 0) {
            answers_.set(zmq::sockopt::unsubscribe, topic);
            const auto found = topics_.find(topic);
            if (found != topics_.end()) {
                topics_.erase(found);
            }
            continue;
        }
        if (topics_.size() >= most_topics) {
            continue;
        }
        topics_.insert(topic);
        answers_.set(zmq::sockopt::subscribe, topic);
        if (is_join) {
            const int on = 1;
            const int off = 0;
            zmq_setsockopt(answers_.handle(), only_to_last_peer, &on, sizeof on);
            answers_.send(zmq::buffer(topic), zmq::send_flags::sndmore | zmq::send_flags::dontwait);
            answers_.send(zmq::buffer(identity_), zmq::send_flags::dontwait);
            // Taking it back switches manual mode off as well; nothing is read between these two lines.
            zmq_setsockopt(answers_.handle(), only_to_last_peer, &off, sizeof off);
            answers_.set(zmq::sockopt::xpub_manual, 1);
        }
    }
}

void Sockets::publish(const epypes::v1::Envelope& answer, const std::vector<std::string>& payloads) {
    epypes::v1::Header stamp;
    stamp.set_epoch(epoch_);
    stamp.set_sequence(sequence_ + 1);
    stamp.set_published_ns(unix_ns());
    // protobuf merges concatenated messages.
    const std::string header = answer.SerializeAsString() + stamp.SerializeAsString();
    const auto flags = [](bool has_more) {
        return has_more ? zmq::send_flags::sndmore | zmq::send_flags::dontwait : zmq::send_flags::dontwait;
    };
    answers_.send(zmq::str_buffer("/"), flags(true));
    answers_.send(zmq::buffer(header), flags(!payloads.empty()));
    for (std::size_t index = 0; index < payloads.size(); ++index) {
        answers_.send(zmq::buffer(payloads[index]), flags(index + 1 < payloads.size()));
    }
    ++sequence_;
}

void Sockets::close_events() {
    takes_events_ = false;
    events_.close();
}

void Sockets::close() {
    answers_.close();
    context_.close();
}

}  // namespace service
