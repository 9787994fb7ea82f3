// Serves the graph behind ZeroMQ: events arrive as v1 envelopes, and each is answered with the output tokens or with
// the failure. See envelope.proto for the messages.
//
// One thread owns the sockets, and one computes. An event that was accepted is answered, also when the service stops.
#include <cxxabi.h>
#include <sys/eventfd.h>
#include <sys/signalfd.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <csignal>
#include <cstdlib>
#include <deque>
#include <exception>
#include <iostream>
#include <memory>
#include <mutex>
#include <optional>
#include <sstream>
#include <string>
#include <thread>
#include <utility>

#include "codec.hpp"
#include "control.hpp"
#include "parameters.hpp"
#include "sockets.hpp"
#include "tokens.hpp"
#include "values.hpp"

namespace service {
namespace {

using epypes::v1::Envelope;
using Clock = std::chrono::steady_clock;

constexpr std::size_t most_waiting = 100'000;
constexpr double longest_drain_s = 86'400;

constexpr const char* usage = R"(Serves a graph until SIGTERM or Ctrl+C.

  --sub ADDRESS            address that events come from (default tcp://127.0.0.1:*: a free port)
  --pub ADDRESS            address that answers go to (default tcp://127.0.0.1:*)
  --http HOST:PORT         address of HTTP control, for `epypes set` (default none)
  --access-key-file FILE   file of the access key for HTTP; created if missing
  --mailbox POLICY         when too many events wait: drop_oldest (default), latest or fault
  --mailbox-size NUMBER    events that may wait (default 8)
  --drain-timeout SECONDS  time to answer accepted events after SIGTERM (default 5)
  --insecure               allow addresses that other machines can reach

An address of ZeroMQ is bound; connect:tcp://HOST:PORT is connected to.
)";

/// A command line that can't be understood.
class UsageError : public std::runtime_error {
  public:
    using std::runtime_error::runtime_error;
};

struct Options {
    std::string sub = "tcp://127.0.0.1:*";
    std::string pub = "tcp://127.0.0.1:*";
    std::string http;
    std::string access_key_file;
    std::string mailbox = "drop_oldest";
    std::size_t mailbox_size = 8;
    double drain_timeout_s = 5.0;
    bool insecure = false;
};

Options parse_options(int count, char** arguments) {
    Options options;
    for (int index = 1; index < count; ++index) {
        const std::string name = arguments[index];
        if (name == "--insecure") {
            options.insecure = true;
            continue;
        }
        if (index + 1 >= count) {
            throw UsageError("There is no option " + name + ", or it needs a value.");
        }
        const std::string value = arguments[++index];
        try {
            if (name == "--sub") {
                options.sub = value;
            } else if (name == "--pub") {
                options.pub = value;
            } else if (name == "--http") {
                options.http = value;
            } else if (name == "--access-key-file") {
                options.access_key_file = value;
            } else if (name == "--mailbox") {
                options.mailbox = value;
            } else if (name == "--mailbox-size") {
                options.mailbox_size = values::parse<std::uint32_t>(value);
            } else if (name == "--drain-timeout") {
                options.drain_timeout_s = values::parse<double>(value);
            } else {
                throw UsageError("There is no option " + name + ".");
            }
        } catch (const std::invalid_argument& error) {
            throw UsageError(name + " takes a number: " + error.what() + ".");
        }
    }
    if (options.mailbox != "drop_oldest" && options.mailbox != "latest" && options.mailbox != "fault") {
        throw UsageError("There is no mailbox " + options.mailbox + ". Take drop_oldest, latest or fault.");
    }
    if (options.mailbox_size < 1 || options.mailbox_size > most_waiting) {
        throw UsageError("A mailbox holds 1 to " + std::to_string(most_waiting) + " events.");
    }
    if (!(options.drain_timeout_s >= 0 && options.drain_timeout_s <= longest_drain_s)) {
        throw UsageError("Draining takes 0 seconds to a day.");
    }
    if (!options.http.empty() && options.access_key_file.empty()) {
        throw UsageError(
            "HTTP control needs an access key: give --access-key-file FILE, which is made if it is missing.");
    }
    options.mailbox_size = options.mailbox == "latest" ? 1 : options.mailbox_size;
    return options;
}

/// A message that was accepted, with its header; that of a message of one frame is empty.
struct Event {
    Frames frames;
    epypes::v1::Header header;
};

/// The answer to an event, and how it is counted.
struct Result {
    enum class Outcome { answered, failed, dropped };

    Envelope answer;
    std::vector<std::string> payloads;
    Outcome outcome = Outcome::answered;
};

/// Events that wait for the thread that computes.
class Mailbox {
  public:
    Mailbox(std::string policy, std::size_t size) : policy_(std::move(policy)), size_(size) {}

    /// Returns the event that is dropped, if there is no room.
    std::optional<Event> put(Event event) {
        const std::lock_guard<std::mutex> lock(mutex_);
        events_.push_back(std::move(event));
        changed_.notify_one();
        if (events_.size() <= size_) {
            return std::nullopt;
        }
        Event surplus = std::move(policy_ == "fault" ? events_.back() : events_.front());
        policy_ == "fault" ? events_.pop_back() : events_.pop_front();
        return surplus;
    }

    /// Waits for an event; there is none once the mailbox is closed and empty.
    std::optional<Event> take() {
        std::unique_lock<std::mutex> lock(mutex_);
        changed_.wait(lock, [this] { return !events_.empty() || is_closed_; });
        if (events_.empty()) {
            return std::nullopt;
        }
        Event event = std::move(events_.front());
        events_.pop_front();
        running_ = event.header;
        return event;
    }

    /// Says that the event which was taken last is done, and its result is where it is published from.
    void done() {
        const std::lock_guard<std::mutex> lock(mutex_);
        running_.reset();
    }

    /// The header of the event that was taken and is not done.
    std::optional<epypes::v1::Header> running() {
        const std::lock_guard<std::mutex> lock(mutex_);
        return running_;
    }

    void close() {
        const std::lock_guard<std::mutex> lock(mutex_);
        is_closed_ = true;
        changed_.notify_all();
    }

    /// Takes all events that still wait.
    std::deque<Event> clear() {
        const std::lock_guard<std::mutex> lock(mutex_);
        return std::exchange(events_, {});
    }

  private:
    const std::string policy_;
    const std::size_t size_;
    std::mutex mutex_;
    std::condition_variable changed_;
    std::deque<Event> events_;
    std::optional<epypes::v1::Header> running_;
    bool is_closed_ = false;
};

/// The header of a message; nothing for what is no v1 message, nor one frame.
std::optional<epypes::v1::Header> read_header(const Frames& frames) {
    epypes::v1::Header header;
    if (frames.size() == 1) {
        return header;
    }
    try {
        check_frames(frames);
    } catch (const MessageError&) {
        return std::nullopt;
    }
    const auto& frame = frames[1];
    const bool is_header = header.ParseFromArray(frame.data(), static_cast<int>(frame.size()));
    return is_header && header.version() <= newest_version ? std::optional(header) : std::nullopt;
}

Envelope answer_to(const epypes::v1::Header& event, std::uint64_t revision) {
    Envelope answer;
    answer.set_version(newest_version);
    answer.set_id(random_hex(16));
    answer.set_source(tokens::bundle);
    answer.set_bundle_digest(tokens::digest);
    answer.set_correlation_id(event.id());
    answer.set_acquired_ns(event.acquired_ns());
    answer.set_revision(revision);
    answer.set_request_source(event.source());
    answer.set_request_epoch(event.epoch());
    answer.set_request_sequence(event.sequence());
    return answer;
}

/// The answer that reports a failure; its text is cut.
Result failed(const epypes::v1::Header& event, std::uint64_t revision, const std::string& function,
              const std::string& exception, const std::string& message, const std::vector<std::string>& inputs = {}) {
    constexpr std::size_t most_bytes = 2000;
    Result result;
    result.outcome = Result::Outcome::failed;
    result.answer = answer_to(event, revision);
    result.answer.set_type("epypes.failure");
    auto& failure = *result.answer.mutable_failure();
    failure.set_function(function);
    failure.set_exception(exception);
    // Text of any encoding, as the UTF-8 that a message has.
    const std::string text = Json(message.substr(0, most_bytes)).dump(-1, ' ', true, Json::error_handler_t::replace);
    failure.set_message(Json::parse(text).get<std::string>());
    failure.set_input_id(event.id());
    failure.set_attempt(1);
    for (const auto& token : inputs) {
        failure.add_tokens(token);
    }
    return result;
}

Result dropped(const epypes::v1::Header& event, std::uint64_t revision, const std::string& reason) {
    Result result = failed(event, revision, "mailbox", "MessageError",
                           "The service dropped this event: " + reason + ". Send it again later.");
    result.outcome = Result::Outcome::dropped;
    return result;
}

/// What an exception is called in C++.
std::string type_name(const std::exception& error) {
    int status = 0;
    const std::unique_ptr<char, void (*)(void*)> name(
        abi::__cxa_demangle(typeid(error).name(), nullptr, nullptr, &status), std::free);
    return status == 0 ? name.get() : typeid(error).name();
}

/// What an exception says, on one line; of OpenCV without the place in its source.
std::string message_of(const std::exception& error) {
    const std::string whole = error.what();
    const auto place =
        dynamic_cast<const cv::Exception*>(&error) == nullptr ? std::string::npos : whole.find(" error: ");
    std::istringstream lines(place == std::string::npos ? whole : whole.substr(place + 8));
    std::string text;
    for (std::string line; std::getline(lines, line);) {
        const auto begin = line.find_first_not_of("> ");
        text += begin == std::string::npos ? "" : (text.empty() ? "" : " ") + line.substr(begin);
    }
    return text;
}

/// Computes the answer to an event.
Result compute(tokens::Graph& graph, const Parameters::Snapshot& parameters, const Event& event) {
    const auto fail = [&](const std::string& function, const std::vector<std::string>& inputs,
                          const std::exception& error) {
        const bool is_message = dynamic_cast<const MessageError*>(&error) != nullptr;
        return failed(event.header, parameters.revision, function, is_message ? "MessageError" : type_name(error),
                      message_of(error), inputs);
    };
    tokens::Inputs inputs;
    std::optional<Reader> reader;
    try {
        if (event.frames.size() == 1) {
            throw MessageError("The event is one frame, not an epypes.v1 Envelope.");
        }
        reader.emplace(event.frames);
        inputs = tokens::read_inputs(*reader);
    } catch (const std::exception& error) {
        return fail("f_in", tokens::inputs, error);
    }
    tokens::Outputs outputs;
    try {
        graph.set(parameters.values);
        outputs = graph.run(inputs);
    } catch (const std::exception& error) {
        const auto running = graph.running();
        return fail(tokens::Graph::functions[running], tokens::inputs_of_functions[running], error);
    }
    Result result;
    result.answer = answer_to(event.header, parameters.revision);
    result.answer.set_type("epypes.result");
    try {
        Writer writer;
        tokens::write_outputs(outputs, result.answer, writer);
        result.payloads = writer.take();
        std::size_t bytes = result.answer.ByteSizeLong();
        const bool has_room = bytes <= limits::header_bytes && result.payloads.size() <= limits::frames;
        for (const auto& payload : result.payloads) {
            bytes += payload.size();
        }
        if (!has_room || bytes > limits::total_bytes) {
            throw MessageError("The answer has " + std::to_string(bytes) + " bytes, which is more than a peer takes.");
        }
    } catch (const std::exception& error) {
        return fail("f_out", tokens::outputs, error);
    }
    const auto ns = [](double seconds) { return static_cast<std::int64_t>(seconds * 1e9); };
    std::int64_t overhead_ns = ns(graph.total_seconds());
    const auto attribute = [&](const char* name, std::int64_t value) {
        auto& added = *result.answer.add_attributes();
        added.set_name(name);
        added.mutable_value()->set_integer(value);
    };
    attribute("total_ns", overhead_ns);
    for (std::size_t index = 0; index < graph.seconds().size(); ++index) {
        auto& timing = *result.answer.add_timings();
        timing.set_function(tokens::Graph::functions[index]);
        timing.set_duration_ns(ns(graph.seconds()[index]));
        overhead_ns -= timing.duration_ns();
    }
    attribute("overhead_ns", overhead_ns);
    return result;
}

/// The service: events from the sockets to the thread that computes, and results back.
class Service {
  public:
    explicit Service(const Options& options)
        : options_(options),
          sockets_(options.sub, options.pub, options.insecure),
          mailbox_(options.mailbox, options.mailbox_size) {}

    /// Serves until a signal can be read from a descriptor; returns whether all accepted events were computed.
    bool serve(int signals) {
        if (!options_.http.empty()) {
            control_.emplace(options_.http, options_.access_key_file, parameters_, [this] { return info(); });
        }
        std::cout << "READY " << tokens::bundle << ": events at " << sockets_.sub() << ", answers at " << sockets_.pub()
                  << (control_ ? ", control at " + control_->url() : "") << ", process " << getpid() << "."
                  << std::endl;
        std::thread computing([this] { compute_all(); });
        bool is_done = false;
        try {
            is_done = answer_until(signals);
        } catch (const std::exception& error) {
            // The other thread still computes: nothing here may be destroyed.
            std::cerr << "The service ends: " << error.what() << std::endl;
            std::_Exit(1);
        }
        control_.reset();
        sockets_.close();
        if (is_done) {
            computing.join();
        } else {
            // Nothing can end a function that does not return: the process ends without it.
            computing.detach();
        }
        std::cout << "STOPPED received " << received_ << ", answered " << answered_ << ", failed " << failed_
                  << ", dropped " << dropped_ << ", rejected " << rejected_ + sockets_.rejected() << std::endl;
        return is_done;
    }

  private:
    static bool has_signal(int signals) {
        signalfd_siginfo info;
        return read(signals, &info, sizeof info) == sizeof info;
    }

    /// Answers events until a signal, and then those that were accepted; returns whether all were computed.
    bool answer_until(int signals) {
        while (!has_signal(signals)) {
            sockets_.wait(signals, wake_, -1);
            sockets_.read_subscriptions();
            accept();
            publish_results();
        }
        accept();
        sockets_.close_events();
        mailbox_.close();
        return drain(signals);
    }

    void accept() {
        // Not without end: answers and subscribers have their turn.
        for (int count = 0; count < 64; ++count) {
            auto frames = sockets_.receive();
            if (!frames) {
                return;
            }
            const auto header = read_header(*frames);
            if (!header) {
                ++rejected_;
                continue;
            }
            ++received_;
            ++unanswered_;
            const auto surplus = mailbox_.put({std::move(*frames), *header});
            if (surplus) {
                publish(
                    dropped(surplus->header, parameters_.current().revision, "it has more events than it can answer"));
            }
        }
    }

    void publish_results() {
        std::uint64_t count = 0;
        [[maybe_unused]] const auto size = read(wake_, &count, sizeof count);
        std::deque<Result> results;
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            results.swap(results_);
        }
        for (const auto& result : results) {
            publish(result);
        }
    }

    void publish(const Result& result) {
        sockets_.publish(result.answer, result.payloads);
        --unanswered_;
        auto& count = result.outcome == Result::Outcome::answered ? answered_
                      : result.outcome == Result::Outcome::failed ? failed_
                                                                  : dropped_;
        ++count;
    }

    /// Answers what was accepted, for as long as the time-out says or until another signal; the rest with failures.
    bool drain(int signals) {
        const auto end = Clock::now() + std::chrono::duration<double>(options_.drain_timeout_s);
        while (unanswered_ > 0 && Clock::now() < end && !has_signal(signals)) {
            const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(end - Clock::now()).count() + 1;
            sockets_.wait(signals, wake_, std::max<std::int64_t>(left, 0));
            sockets_.read_subscriptions();
            publish_results();
        }
        for (const auto& event : mailbox_.clear()) {
            publish(dropped(event.header, parameters_.current().revision, "it has stopped"));
        }
        // If it is done from now on, its result is published next, or never.
        const auto running = mailbox_.running();
        publish_results();
        if (unanswered_ == 0) {
            return true;
        }
        publish(failed(running.value(), parameters_.current().revision, "worker", "ServiceError",
                       "The service has stopped, so this event was not finished."));
        return false;
    }

    void compute_all() {
        tokens::Graph graph;
        while (auto event = mailbox_.take()) {
            Result result = compute(graph, parameters_.current(), *event);
            event.reset();
            if (result.outcome == Result::Outcome::failed && result.answer.failure().function() != "f_in") {
                const auto& failure = result.answer.failure();
                std::cerr << "event " << failure.input_id() << " failed in " << failure.function() << ": "
                          << failure.exception() << ": " << failure.message() << std::endl;
            }
            {
                const std::lock_guard<std::mutex> lock(mutex_);
                results_.push_back(std::move(result));
            }
            mailbox_.done();
            const std::uint64_t one = 1;
            [[maybe_unused]] const auto size = write(wake_, &one, sizeof one);
        }
    }

    Json info() const {
        return {{"name", tokens::bundle},
                {"bundle", tokens::bundle},
                {"digest", tokens::digest},
                {"inputs", tokens::inputs},
                {"outputs", tokens::outputs},
                {"func_io", Json::parse(tokens::func_io)},
                {"pid", getpid()},
                {"versions", {{"epypes", tokens::epypes_version}, {"opencv", CV_VERSION}}},
                {"state", "READY"},
                {"reason", ""},
                {"revision", parameters_.current().revision},
                {"addresses", {{"sub", sockets_.sub()}, {"pub", sockets_.pub()}}},
                {"counts",
                 {{"received", received_.load()},
                  {"answered", answered_.load()},
                  {"failed", failed_.load()},
                  {"dropped", dropped_.load()},
                  {"rejected", rejected_ + sockets_.rejected()}}}};
    }

    const Options options_;
    Sockets sockets_;
    Mailbox mailbox_;
    Parameters parameters_;
    std::optional<Control> control_;
    // Wakes the thread of the sockets when there is a result.
    const int wake_ = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    std::mutex mutex_;
    std::deque<Result> results_;
    std::uint64_t unanswered_ = 0;
    std::atomic<std::uint64_t> received_{0}, answered_{0}, failed_{0}, dropped_{0}, rejected_{0};
};

}  // namespace
}  // namespace service

int main(int count, char** arguments) {
    if (count == 2 && (std::string(arguments[1]) == "--help" || std::string(arguments[1]) == "-h")) {
        std::cout << service::usage;
        return 0;
    }
    // In all threads: they are read from a descriptor.
    sigset_t signals;
    sigemptyset(&signals);
    sigaddset(&signals, SIGTERM);
    sigaddset(&signals, SIGINT);
    pthread_sigmask(SIG_BLOCK, &signals, nullptr);
    std::signal(SIGPIPE, SIG_IGN);
    const int descriptor = signalfd(-1, &signals, SFD_CLOEXEC | SFD_NONBLOCK);
    try {
        auto served = std::make_unique<service::Service>(service::parse_options(count, arguments));
        if (!served->serve(descriptor)) {
            std::cout.flush();
            // A function still runs, with objects of this process.
            served.release();
            std::_Exit(1);
        }
        return 0;
    } catch (const service::UsageError& error) {
        std::cerr << error.what() << " See --help.\n";
        return 2;
    } catch (const std::exception& error) {
        std::cerr << error.what() << "\n";
        return 1;
    }
}
