{% filter wrapped %}
// @{mark}
#include "graph.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <stdexcept>
#include <utility>

#include <opencv2/opencv.hpp>
{% if includes %}

{% endif %}
{% for name in includes %}
#include "@{name}"
{% endfor %}

namespace @{ns} {

namespace {

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point begin) { return std::chrono::duration<double>(Clock::now() - begin).count(); }

{% if states %}
// A state outlives the inputs of its run, whose memory the caller may use again.
template <class T>
T owned(const T& value) {
    return value;
}

inline cv::Mat owned(const cv::Mat& image) { return image.empty() ? image : image.clone(); }

template <class T>
std::vector<T> owned(const std::vector<T>& items) {
    std::vector<T> result;
    for (const T& item : items) {
        result.push_back(owned(item));
    }
    return result;
}

template <class T>
std::optional<T> owned(const std::optional<T>& value) {
    return value ? std::optional<T>(owned(*value)) : std::nullopt;
}

{% endif %}
{% for function in called %}
@{function.signature};
{% if loop.last %}

{% endif %}
{% endfor %}
}  // namespace

{% if called %}
namespace {

{% for function in called %}
@{function.head} {
@{function.lines | join("\n")}
}

{% endfor %}
}  // namespace

{% endif %}
{% for function in functions if not function.is_by_hand %}
@{function.head} {
@{function.lines | join("\n")}
}

{% endfor %}
void Hyperparameters::check() const {
{% for token in hyperparameters if token.cpp in ("int", "std::int64_t", "double") and bounds_of(token) %}
{% set bounds = bounds_of(token) %}
    if (!(@{bounds.values() | join(" && ")})) {
        throw std::invalid_argument(@{(token.token ~ " has to be " ~ bounds | join(" and ")) | quoted});
    }
{% endfor %}
}

Graph::Graph(const Hyperparameters& hyperparameters) : hyperparameters_(hyperparameters) { hyperparameters.check(); }

Hyperparameters Graph::hyperparameters() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return hyperparameters_;
}

void Graph::set(const Hyperparameters& hyperparameters) {
    hyperparameters.check();
    const std::lock_guard<std::mutex> lock(mutex_);
    hyperparameters_ = hyperparameters;
}

Outputs Graph::run([[maybe_unused]] const Inputs& inputs) {
    [[maybe_unused]] const Hyperparameters h = hyperparameters();
    const Clock::time_point first = Clock::now();
    Clock::time_point begin;

{% for function in functions %}
{% set made, arguments = recording.outputs_of(function.function), recording.inputs_of(function.function) %}
    running_ = @{loop.index0};
    begin = Clock::now();
{% if cg.has_single_output(function.function) %}
    const @{made[0].cpp} @{made[0].name} = @{ns}::@{function.name}(@{arguments | map("source") | join(", ")});
{% else %}
    const auto [@{made | map(attribute="name") | join(", ")}] = @{ns}::@{function.name}(@{arguments | map("source") | join(", ")});
{% endif %}
    seconds_[@{loop.index0}] = seconds_since(begin);

{% endfor %}
{% if states %}
    State state;
{% for token in states %}
    state.@{token.name} = owned(@{recording.tokens[cg.delays[token.token].token] | source});
{% endfor %}
    state_ = state;
{% endif %}
    total_seconds_ = seconds_since(first);
    Outputs outputs;
{% for token in outputs %}
    outputs.@{token.name} = @{token | source};
{% endfor %}
    return outputs;
}

}  // namespace @{ns}
{% endfilter %}
