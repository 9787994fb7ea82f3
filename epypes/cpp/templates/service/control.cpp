#include "control.hpp"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <fstream>

#include "address.hpp"
#include "sockets.hpp"

namespace service {
namespace {

constexpr std::size_t most_body_bytes = 64 * 1024;
constexpr std::size_t key_bytes = 32;
constexpr std::size_t least_key_characters = 22;

// The access key in a file, which is made, readable by its owner alone, if it does not exist.
std::string read_or_make_access_key(const std::string& path) {
    const int made = open(path.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, S_IRUSR | S_IWUSR);
    if (made >= 0) {
        const std::string key = random_hex(key_bytes);
        const auto written = write(made, (key + "\n").data(), key.size() + 1);
        close(made);
        if (written != static_cast<ssize_t>(key.size() + 1)) {
            unlink(path.c_str());
            throw std::runtime_error("The file " + path + " of the access key can't be written.");
        }
        return key;
    }
    struct stat found{};
    std::ifstream file(path);
    std::string key;
    if (!file || !std::getline(file, key) || stat(path.c_str(), &found) != 0) {
        throw std::runtime_error("The file " + path + " of the access key can't be read.");
    }
    if ((found.st_mode & (S_IRWXG | S_IRWXO)) != 0) {
        throw std::runtime_error("Others can read the access key in " + path + ". Run: chmod 600 " + path);
    }
    if (key.size() < least_key_characters) {
        throw std::runtime_error(path + " holds no access key: 22 letters and digits or more, in one line.");
    }
    return key;
}

// Whether two texts are equal, in a time that does not depend on where they differ.
bool is_same(const std::string& left, const std::string& right) {
    unsigned char difference = left.size() == right.size() ? 0 : 1;
    for (std::size_t index = 0; index < left.size() && index < right.size(); ++index) {
        difference = static_cast<unsigned char>(difference | (left[index] ^ right[index]));
    }
    return difference == 0;
}

void respond(httplib::Response& response, const Json& body, int status = 200) {
    response.status = status;
    response.set_header("Cache-Control", "no-store");
    response.set_header("X-Content-Type-Options", "nosniff");
    response.set_content(body.dump(-1, ' ', true, Json::error_handler_t::replace), "application/json");
}

}  // namespace

Control::Control(const std::string& address, const std::string& access_key_file, Parameters& parameters,
                 std::function<Json()> info)
    : parameters_(parameters),
      access_key_(read_or_make_access_key(access_key_file)),
      access_key_file_(access_key_file) {
    const auto colon = address.rfind(':');
    const std::string host = address.substr(0, colon);
    int port = 0;
    try {
        port = colon == std::string::npos ? 0 : std::stoi(address.substr(colon + 1));
    } catch (const std::logic_error&) {
        throw std::runtime_error(address + " is no address of HTTP. Write it as 127.0.0.1:8642.");
    }
    if (!is_loopback(host)) {
        throw std::runtime_error("Other machines can reach " + address + ": HTTP is bound on 127.0.0.1 alone.");
    }
    server_.set_payload_max_length(most_body_bytes);
    server_.set_keep_alive_timeout(1);
    server_.set_read_timeout(2);
    server_.set_write_timeout(2);
    // A page of a foreign site whose name was made to mean 127.0.0.1 still sends the site's name.
    server_.set_pre_routing_handler([](const httplib::Request& request, httplib::Response& response) {
        const std::string host = request.get_header_value("Host");
        if (is_loopback(host.substr(0, host.rfind(':')))) {
            return httplib::Server::HandlerResponse::Unhandled;
        }
        respond(response, {{"detail", "This host name is not that of the service."}}, 400);
        return httplib::Server::HandlerResponse::Handled;
    });
    server_.set_error_handler([](const httplib::Request& request, httplib::Response& response) {
        if (response.body.empty()) {
            const std::string place = request.method.substr(0, 20) + " " + request.path.substr(0, 200);
            const bool is_too_long = response.status == 413;
            respond(
                response,
                {{"detail", is_too_long ? "The body is too long. Send less." : "There is nothing at " + place + "."}},
                response.status);
        }
    });
    server_.set_exception_handler([](const httplib::Request&, httplib::Response& response, std::exception_ptr) {
        respond(response, {{"detail", "The server failed."}}, 500);
    });
    server_.Get("/livez", [](const httplib::Request&, httplib::Response& response) {
        respond(response, {{"alive", true}, {"reason", ""}});
    });
    server_.Get("/readyz", [](const httplib::Request&, httplib::Response& response) {
        respond(response, {{"ready", true}, {"state", "READY"}, {"reason", ""}});
    });
    server_.Get("/v1/info", [this, info = std::move(info)](const httplib::Request&, httplib::Response& response) {
        Json about = info();
        about["addresses"]["http"] = url_;
        respond(response, about);
    });
    server_.Get("/v1/parameters", [this](const httplib::Request&, httplib::Response& response) {
        respond(response, parameters_.describe());
    });
    server_.Patch("/v1/parameters",
                  [this](const httplib::Request& request, httplib::Response& response) { change(request, response); });
    const bool is_bound =
        port == 0 ? (port = server_.bind_to_any_port(host.c_str())) > 0 : server_.bind_to_port(host.c_str(), port);
    if (!is_bound) {
        throw std::runtime_error(address + " can't be bound.");
    }
    url_ = "http://" + host + ":" + std::to_string(port);
    thread_ = std::thread([this] { server_.listen_after_bind(); });
}

Control::~Control() {
    server_.stop();
    thread_.join();
}

void Control::change(const httplib::Request& request, httplib::Response& response) {
    const std::string hint = " It is in " + access_key_file_ + ".";
    if (!request.has_header("Authorization")) {
        response.set_header("WWW-Authenticate", "Bearer realm=\"epypes\"");
        const char* text = "Changes need the service's access key, as a header 'Authorization: Bearer ACCESS_KEY'.";
        return respond(response, {{"detail", text + hint}}, 401);
    }
    if (!is_same(request.get_header_value("Authorization"), "Bearer " + access_key_)) {
        return respond(response, {{"detail", "This is not the service's access key." + hint}}, 403);
    }
    const Json wanted = Json::parse(request.body, nullptr, false);
    const bool is_wanted = wanted.is_object() && wanted.contains("values") && wanted["values"].is_object();
    const Json revision = is_wanted ? wanted.value("revision", Json()) : Json();
    if (!is_wanted || !(revision.is_null() || revision.is_number_unsigned())) {
        const char* text = "The body must be JSON: {\"revision\": null or a number, \"values\": {\"TOKEN\": VALUE}}.";
        return respond(response, {{"detail", text}}, wanted.is_discarded() ? 400 : 422);
    }
    try {
        const auto since = revision.is_null() ? std::nullopt : std::optional(revision.get<std::uint64_t>());
        parameters_.change(wanted["values"], since);
        respond(response, parameters_.describe());
    } catch (const RevisionConflict& error) {
        Json body = parameters_.describe();
        body["detail"] = error.what();
        respond(response, body, 409);
    } catch (const ParametersRefused& error) {
        respond(response, {{"detail", error.what()}, {"problems", error.problems}}, 422);
    }
}

}  // namespace service
