// @MARK@
// @TITLE@
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
@GRAPH_INCLUDES@
namespace @NS@ {

/// What the graph is tuned by.
struct Hyperparameters {
@HYPERPARAMETERS@
    /// Throws std::invalid_argument if a value is out of its range.
    void check() const;

    /// Calls visit(name, member) for each hyperparameter.
    template <class Self, class Visit>
    static void each([[maybe_unused]] Self& self, [[maybe_unused]] Visit&& visit) {
@EACH_HYPERPARAMETER@
    }
};

/// What a run takes.
struct Inputs {
@INPUTS@
    /// Calls visit(name, member) for each input.
    template <class Self, class Visit>
    static void each([[maybe_unused]] Self& self, [[maybe_unused]] Visit&& visit) {
@EACH_INPUT@
    }
};

/// What a run makes.
struct Outputs {
@OUTPUTS@
    /// Calls visit(name, member) for each output.
    template <class Self, class Visit>
    static void each([[maybe_unused]] Self& self, [[maybe_unused]] Visit&& visit) {
@EACH_OUTPUT@
    }
};

@STATE@// The functions, in run order.

@DECLARATIONS@

/// The functions in run order, with the hyperparameters that they take.
///
/// `run` is for one thread; hyperparameters may be read and changed from any thread meanwhile.
class Graph {
  public:
    static constexpr std::array<const char*, @COUNT@> functions{@FUNCTION_NAMES@};

    /// Throws std::invalid_argument if a value is out of its range.
    explicit Graph(const Hyperparameters& hyperparameters = Hyperparameters());

    Hyperparameters hyperparameters() const;

    /// Sets all hyperparameters; the next run has them. Throws std::invalid_argument if a value is out of its range.
    void set(const Hyperparameters& hyperparameters);

    /// Computes the outputs. Throws what the functions throw: cv::Exception, and errors of the standard library.
    Outputs run(const Inputs& inputs);

@STATE_METHODS@    /// How long each function took in the last run, in the order of `functions`.
    const std::array<double, @COUNT@>& seconds() const { return seconds_; }

    /// The place in `functions` of the one that ran last: of the one that threw, if `run` has thrown.
    std::size_t running() const { return running_; }

    /// How long the last run took as a whole.
    double total_seconds() const { return total_seconds_; }

  private:
    mutable std::mutex mutex_;
    Hyperparameters hyperparameters_;
    std::array<double, @COUNT@> seconds_{};
    std::size_t running_ = 0;
    double total_seconds_ = 0.0;
@STATE_MEMBER@};

}  // namespace @NS@
