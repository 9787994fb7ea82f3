// Runs the exported edge graph as many times as each line of the standard input says, and prints for each event how
// long the run took and the overhead of the graph, in nanoseconds.
#include <chrono>
#include <iostream>
#include <numeric>

#include <opencv2/imgcodecs.hpp>

#include "graph.hpp"

int main(int count, char** arguments) {
    if (count != 2) {
        std::cerr << "usage: events IMAGE\n";
        return 2;
    }
    edges::Graph graph;
    edges::Inputs inputs;
    inputs.image = cv::imread(arguments[1]);
    int events = 0;
    while (std::cin >> events) {
        for (int event = 0; event < events; ++event) {
            const auto begin = std::chrono::steady_clock::now();
            const edges::Outputs outputs = graph.run(inputs);
            const std::chrono::duration<double, std::nano> taken = std::chrono::steady_clock::now() - begin;
            const auto& seconds = graph.seconds();
            const double functions = std::accumulate(seconds.begin(), seconds.end(), 0.0);
            std::cout << taken.count() << " " << 1e9 * (graph.total_seconds() - functions) << "\n";
        }
        std::cout << cv::countNonZero(graph.run(inputs).edges) << std::endl;
    }
    return 0;
}
