// @ARRAY_INCLUDE
#include "array.hpp"
// @ARRAY_READ
template <class T, int N>
void read_value(const cv::FileNode& node, numpy::Array<T, N>& array) {
    numpy::Shape<N> shape{};
    int axis = 0;
    for (const cv::FileNode& size : node["shape"]) {
        shape.at(axis++) = static_cast<int>(size);
    }
    array = numpy::empty<T, N>(shape);
    cv::Mat bytes;
    node["bytes"] >> bytes;
    if (array.size() > 0) {
        std::memcpy(array.data, bytes.data, static_cast<std::size_t>(array.size()) * sizeof(T));
    }
}
// @ARRAY_WRITE
template <class T, int N>
void write_value(cv::FileStorage& file, const numpy::Array<T, N>& array) {
    const numpy::Array<T, N> whole = numpy::contiguous(array);
    const int size = static_cast<int>(whole.size() * static_cast<numpy::Size>(sizeof(T)));
    file << "{"
         << "shape"
         << "[";
    for (const numpy::Size each : whole.shape) {
        file << static_cast<int>(each);
    }
    file << "]"
         << "bytes" << cv::Mat(1, size, CV_8U, whole.data) << "}";
}
// @ARRAY_COMPARE
template <class T, int N>
void compare(const numpy::Array<T, N>& expected, const numpy::Array<T, N>& got, const Tolerance& tolerance,
             const std::string& where, Difference& found) {
    const auto described = [](const numpy::Array<T, N>& array) {
        std::string sizes;
        for (const numpy::Size each : array.shape) {
            sizes += (sizes.empty() ? "" : ", ") + std::to_string(each);
        }
        return "an array of (" + sizes + ")";
    };
    if (expected.shape != got.shape) {
        found.add_shape(where, described(expected), described(got));
        return;
    }
    const auto listed = [](const numpy::Array<T, N>& array) {
        const numpy::Array<T, N> whole = numpy::contiguous(array);
        std::vector<std::conditional_t<std::is_same_v<T, bool>, std::uint8_t, T>> numbers(static_cast<std::size_t>(whole.size()));
        if (!numbers.empty()) {
            std::memcpy(numbers.data(), whole.data, numbers.size() * sizeof(T));
        }
        return numbers;
    };
    const std::vector<std::int64_t> shape(expected.shape.begin(), expected.shape.end());
    compare_elements(listed(expected), listed(got), shape, tolerance, where, found);
}
// @END
