{% macro each(tokens, item) %}
    /// Calls visit(name, member) for each @{item}.
    template <class Self, class Visit>
    static void each([[maybe_unused]] Self& self, [[maybe_unused]] Visit&& visit) {
{% for token in tokens %}
        visit(@{token.name | quoted}, self.@{token.name});
{% endfor %}
    }
{%- endmacro %}
{% macro comment(token) %}
@{"  // " ~ about(token) if about(token)}
{%- endmacro %}
{% filter wrapped %}
// @{mark}
// @{title}
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <mutex>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include <opencv2/core.hpp>
{% if has_arrays %}

#include "array.hpp"
{% endif %}

namespace @{ns} {

/// What the graph is tuned by.
struct Hyperparameters {
{% for token in hyperparameters %}
    @{token.cpp} @{token.name}@{settings.hyperparameters[token.token] | initial(token)};@{comment(token)}
{% endfor %}

    /// Throws std::invalid_argument if a value is out of its range.
    void check() const;

@{each(hyperparameters, "hyperparameter")}
};

/// What a run takes.
struct Inputs {
{% for token in inputs %}
    @{token.cpp} @{token.name}{};@{comment(token)}
{% endfor %}

@{each(inputs, "input")}
};

/// What a run makes.
struct Outputs {
{% for token in outputs %}
    @{token.cpp} @{token.name}{};@{comment(token)}
{% endfor %}

@{each(outputs, "output")}
};

{% if states %}
/// What a run leaves for the next one.
struct State {
{% for token in states %}
    @{token.cpp} @{token.name}@{cg.delays[token.token].initial | initial(token)};
{% endfor %}

@{each(states, "value")}
};

{% endif %}
// The functions, in run order.

{% for function in functions %}
@{function.signature};
{% endfor %}

/// The functions in run order, with the hyperparameters that they take.
///
/// `run` is for one thread; hyperparameters may be read and changed from any thread meanwhile.
class Graph {
  public:
    static constexpr std::array<const char*, @{functions | length}> functions{@{functions | map(attribute="name") | map("quoted") | join(", ")}};

    /// Throws std::invalid_argument if a value is out of its range.
    explicit Graph(const Hyperparameters& hyperparameters = Hyperparameters());

    Hyperparameters hyperparameters() const;

    /// Sets all hyperparameters; the next run has them. Throws std::invalid_argument if a value is out of its range.
    void set(const Hyperparameters& hyperparameters);

    /// Computes the outputs. Throws what the functions throw: cv::Exception, and errors of the standard library.
    Outputs run(const Inputs& inputs);

{% if states %}
    /// What the next run begins with. A run that throws leaves it as it was.
    const State& state() const { return state_; }

    void set_state(const State& state) { state_ = state; }

{% endif %}
    /// How long each function took in the last run, in the order of `functions`.
    const std::array<double, @{functions | length}>& seconds() const { return seconds_; }

    /// The place in `functions` of the one that ran last: of the one that threw, if `run` has thrown.
    std::size_t running() const { return running_; }

    /// How long the last run took as a whole.
    double total_seconds() const { return total_seconds_; }

  private:
    mutable std::mutex mutex_;
    Hyperparameters hyperparameters_;
    std::array<double, @{functions | length}> seconds_{};
    std::size_t running_ = 0;
    double total_seconds_ = 0.0;
{% if states %}
    State state_;
{% endif %}
};

}  // namespace @{ns}
{% endfilter %}
