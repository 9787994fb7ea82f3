// The hyperparameters of the running service: how they are read and changed, in the JSON that `epypes set` sends.
//
// A change is all or nothing, counts from the next event on, and has a revision that every answer is stamped with.
#pragma once

#include <cstdint>
#include <map>
#include <mutex>
#include <nlohmann/json.hpp>
#include <optional>
#include <stdexcept>
#include <string>

#include "tokens.hpp"

namespace service {

using Json = nlohmann::json;
using tokens::Hyperparameters;

// Values that are not taken, with a reason by token; nothing is changed.
class ParametersRefused : public std::runtime_error {
  public:
    explicit ParametersRefused(std::map<std::string, std::string> problems);
    const std::map<std::string, std::string> problems;
};

// The parameters have another revision by now.
class RevisionConflict : public std::runtime_error {
  public:
    explicit RevisionConflict(std::uint64_t revision);
};

class Parameters {
  public:
    struct Snapshot {
        std::uint64_t revision;
        Hyperparameters values;
    };

    // What an event that begins now is computed with.
    Snapshot current() const;

    // The values, their types and their ranges by token, with their revision, as `epypes serve` answers.
    Json describe() const;

    // Changes values, given by token, if they have that revision or none is given.
    void change(const Json& values, std::optional<std::uint64_t> revision);

  private:
    mutable std::mutex mutex_;
    Snapshot current_{0, Hyperparameters()};
};

}  // namespace service
