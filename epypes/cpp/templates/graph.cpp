// @MARK@
#include "graph.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <stdexcept>
#include <utility>

#include <opencv2/opencv.hpp>
@INCLUDES@
namespace @NS@ {

namespace {

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point begin) { return std::chrono::duration<double>(Clock::now() - begin).count(); }

@STATE_OWNED@@HELPERS@}  // namespace

@FUNCTIONS@void Hyperparameters::check() const {
@CHECKS@}

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

@RUN@    return outputs;
}

}  // namespace @NS@
