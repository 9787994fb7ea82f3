#include "parameters.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

namespace service {
namespace {

// A double holds every whole number up to this one.
constexpr double most_whole = 9007199254740991.0;

std::string brief(const Json& value) {
    const std::string text = value.dump(-1, ' ', false, Json::error_handler_t::replace);
    return text.size() <= 60 ? text : text.substr(0, 57) + "...";
}

[[noreturn]] void refuse(const Json& given, const char* wanted) {
    throw std::invalid_argument("is " + std::string(wanted) + ", and " + brief(given) + " is none");
}

// Reading a value of JSON as the type of a hyperparameter; writing it. Of other types a value can't be changed.

template <class T>
std::enable_if_t<std::is_arithmetic_v<T>> assign(T& member, const Json& given) {
    if constexpr (std::is_same_v<T, bool>) {
        if (!given.is_boolean()) {
            refuse(given, "true or false");
        }
        member = given.get<bool>();
    } else if constexpr (std::is_floating_point_v<T>) {
        if (!given.is_number()) {
            refuse(given, "a number");
        }
        member = given.get<T>();
    } else {
        const double number = given.is_number() ? given.get<double>() : std::numeric_limits<double>::quiet_NaN();
        if (std::trunc(number) != number) {
            refuse(given, "a whole number");
        }
        const double low = std::max(static_cast<double>(std::numeric_limits<T>::min()), -most_whole);
        const double high = std::min(static_cast<double>(std::numeric_limits<T>::max()), most_whole);
        if (number < low || number > high) {
            const auto shown = [](double limit) { return std::to_string(static_cast<std::int64_t>(limit)); };
            refuse(given, ("a whole number from " + shown(low) + " to " + shown(high)).c_str());
        }
        member = static_cast<T>(number);
    }
}

[[maybe_unused]] void assign(std::string& member, const Json& given) {
    if (!given.is_string()) {
        refuse(given, "a text");
    }
    member = given.get<std::string>();
}

template <class... T>
void assign(std::tuple<T...>& member, const Json& given) {
    if (!given.is_array() || given.size() != sizeof...(T)) {
        refuse(given, ("a list of " + std::to_string(sizeof...(T)) + " items").c_str());
    }
    std::size_t index = 0;
    std::apply([&](auto&... items) { (assign(items, given[index++]), ...); }, member);
}

template <class T>
void assign(std::vector<T>& member, const Json& given) {
    if (!given.is_array() || given.size() != member.size()) {
        refuse(given, ("a list of " + std::to_string(member.size()) + " items").c_str());
    }
    for (std::size_t index = 0; index < member.size(); ++index) {
        T item = member[index];
        assign(item, given[index]);
        member[index] = item;
    }
}

template <class T, class = void>
struct is_changeable : std::false_type {};
template <class T>
struct is_changeable<T, std::void_t<decltype(assign(std::declval<T&>(), std::declval<const Json&>()))>>
    : std::true_type {};

template <class T>
Json json_of(const T& member) {
    if constexpr (is_changeable<T>::value) {
        return Json(member);
    } else {
        return Json();
    }
}

const char* type_of(const Json& value) {
    return value.is_boolean()          ? "bool"
           : value.is_number_integer() ? "int"
           : value.is_number()         ? "float"
           : value.is_string()         ? "text"
           : value.is_array()          ? "list"
                                       : "other";
}

// The values by name; null for those of other types.
Json values_of(const Hyperparameters& hyperparameters) {
    Json values = Json::object();
    Hyperparameters::each(hyperparameters,
                          [&](const char* name, const auto& member) { values[name] = json_of(member); });
    return values;
}

std::string joined(const std::map<std::string, std::string>& problems) {
    std::string text = "Nothing was changed.";
    for (const auto& [token, problem] : problems) {
        text += " " + problem;
    }
    return text;
}

// Changes one value; std::invalid_argument if it can't be taken.
void change_one(Hyperparameters& hyperparameters, const std::string& token, const Json& given) {
    std::string known;
    bool found = false;
    Hyperparameters::each(hyperparameters, [&](const char* name, auto& member) {
        known += (known.empty() ? "" : ", ") + std::string(name);
        if (token != name) {
            return;
        }
        found = true;
        if constexpr (is_changeable<std::decay_t<decltype(member)>>::value) {
            try {
                assign(member, given);
            } catch (const std::invalid_argument& error) {
                throw std::invalid_argument("'" + token + "' " + error.what() + ".");
            }
        } else {
            throw std::invalid_argument("'" + token + "' can't be changed while it is served.");
        }
    });
    if (!found) {
        throw std::invalid_argument("No hyperparameter '" + token.substr(0, 80) +
                                    "' in this service. There are: " + known + ".");
    }
    hyperparameters.check();
}

}  // namespace

ParametersRefused::ParametersRefused(std::map<std::string, std::string> given)
    : std::runtime_error(joined(given)), problems(std::move(given)) {}

RevisionConflict::RevisionConflict(std::uint64_t revision)
    : std::runtime_error("The parameters have been changed meanwhile: they have revision " + std::to_string(revision) +
                         " now. Look at them, and change them again.") {}

Parameters::Snapshot Parameters::current() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return current_;
}

Json Parameters::describe() const {
    const Snapshot now = current();
    Json entries = Json::parse(tokens::hyperparameters);
    const Json values = values_of(now.values);
    for (const auto& [name, value] : values.items()) {
        Json& entry = entries[name];
        if (!value.is_null()) {
            entry["value"] = value;
        }
        entry["type"] = type_of(value);
    }
    return {{"revision", now.revision}, {"parameters", entries}};
}

void Parameters::change(const Json& values, std::optional<std::uint64_t> revision) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (revision && *revision != current_.revision) {
        throw RevisionConflict(current_.revision);
    }
    Hyperparameters changed = current_.values;
    std::map<std::string, std::string> problems;
    for (const auto& [token, value] : values.items()) {
        Hyperparameters alone = current_.values;
        try {
            change_one(alone, token, value);
            change_one(changed, token, value);
        } catch (const std::invalid_argument& error) {
            problems[token] = error.what();
        }
    }
    if (!problems.empty()) {
        throw ParametersRefused(std::move(problems));
    }
    if (values_of(changed) != values_of(current_.values)) {
        current_ = {current_.revision + 1, changed};
    }
}

}  // namespace service
