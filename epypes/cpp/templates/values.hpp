// Values in files of cv::FileStorage, and their comparison. Numbers are texts there, which hold each of them to the last
// bit; so are images and arrays, in base64.
#pragma once

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <tuple>
#include <type_traits>
#include <vector>

#include <opencv2/core.hpp>

{% if has_arrays %}
#include "array.hpp"

{% endif %}
namespace values {

/// How far numbers may be from what is expected; `relative` is a part of the expected one's magnitude.
struct Tolerance {
    double absolute = 0.0;
    double relative = std::numeric_limits<double>::infinity();
    bool has_integers = false;  // whether it also holds for integers
};

/// What a comparison has found: how many numbers differ, how far, and where first.
struct Difference {
    std::int64_t count = 0;      // beyond the tolerance
    std::int64_t tolerated = 0;  // not identical, but within it
    std::optional<double> largest;
    bool is_shape = false;  // whether the first one is of a shape or a type, which no tolerance allows
    std::string index;
    std::string expected;
    std::string got;

    void add(const std::string& where, const std::string& left, const std::string& right) {
        if (count++ == 0) {
            index = where;
            expected = left;
            got = right;
        }
    }

    void add_number(const std::string& where, const std::string& left, const std::string& right,
            double distance) {
        add(where, left, right);
        largest = std::max(largest.value_or(0.0), distance);
    }

    void add_shape(const std::string& where, const std::string& left, const std::string& right) {
        is_shape = is_shape || count == 0;
        add(where, left, right);
    }
};

// -- texts ------------------------------------------------------------------------------------------------------------

template <class T>
std::string text(const T& value) {
    if constexpr (std::is_same_v<T, bool>) {
        return value ? "true" : "false";
    } else if constexpr (std::is_same_v<T, std::string>) {
        return value;
    } else {
        std::ostringstream stream;
        stream.precision(std::numeric_limits<T>::max_digits10);
        stream << +value;
        return stream.str();
    }
}

template <class T>
T parse(const std::string& text) {
    if constexpr (std::is_same_v<T, std::string>) {
        return text;
    } else if constexpr (std::is_same_v<T, bool>) {
        if (text != "true" && text != "false") {
            throw std::invalid_argument("'" + text + "' is neither true nor false");
        }
        return text == "true";
    } else {
        char* end = nullptr;
        T value{};
        errno = 0;
        if constexpr (std::is_same_v<T, float>) {
            value = std::strtof(text.c_str(), &end);
        } else if constexpr (std::is_floating_point_v<T>) {
            value = std::strtod(text.c_str(), &end);
        } else if constexpr (std::is_unsigned_v<T>) {
            const unsigned long long whole = std::strtoull(text.c_str(), &end, 10);
            errno = whole > std::numeric_limits<T>::max() ? ERANGE : errno;
            value = static_cast<T>(whole);
        } else {
            const long long whole = std::strtoll(text.c_str(), &end, 10);
            const bool fits = std::numeric_limits<T>::min() <= whole && whole <= std::numeric_limits<T>::max();
            errno = fits ? errno : ERANGE;
            value = static_cast<T>(whole);
        }
        if (text.empty() || *end != '\0' || (std::is_integral_v<T> && errno == ERANGE)) {
            throw std::invalid_argument("'" + text + "' is no number of this type");
        }
        return value;
    }
}

// -- reading ----------------------------------------------------------------------------------------------------------

template <class T, class = std::enable_if_t<std::is_arithmetic_v<T> || std::is_same_v<T, std::string>>>
void read_value(const cv::FileNode& node, T& value) {
    value = parse<T>(node.string());
}

inline void read_value(const cv::FileNode& node, cv::Mat& value) { node >> value; }

inline void read_value(const cv::FileNode& node, cv::KeyPoint& point) {
    read_value(node[0], point.pt.x);
    read_value(node[1], point.pt.y);
    read_value(node[2], point.size);
    read_value(node[3], point.angle);
    read_value(node[4], point.response);
    read_value(node[5], point.octave);
    read_value(node[6], point.class_id);
}

inline void read_value(const cv::FileNode& node, cv::DMatch& match) {
    read_value(node[0], match.queryIdx);
    read_value(node[1], match.trainIdx);
    read_value(node[2], match.imgIdx);
    read_value(node[3], match.distance);
}

{% if has_arrays %}
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

{% endif %}
template <class T>
void read_value(const cv::FileNode& node, std::optional<T>& value);

template <class... T>
void read_value(const cv::FileNode& node, std::tuple<T...>& value);

template <class T>
void read_value(const cv::FileNode& node, std::vector<T>& items) {
    items.clear();
    for (const cv::FileNode& each : node) {
        T item{};
        read_value(each, item);
        items.push_back(item);
    }
}

template <class T>
void read_value(const cv::FileNode& node, std::optional<T>& value) {
    value.reset();
    if (node.size() != 0) {
        read_value(node[0], value.emplace());
    }
}

template <class... T>
void read_value(const cv::FileNode& node, std::tuple<T...>& value) {
    int index = 0;
    std::apply([&](auto&... items) { (read_value(node[index++], items), ...); }, value);
}

// -- writing ----------------------------------------------------------------------------------------------------------

template <class T, class = std::enable_if_t<std::is_arithmetic_v<T> || std::is_same_v<T, std::string>>>
void write_value(cv::FileStorage& file, const T& value) {
    file << text(value);
}

inline void write_value(cv::FileStorage& file, const cv::Mat& value) { file << value; }

inline void write_value(cv::FileStorage& file, const cv::KeyPoint& point) {
    file << "[" << text(point.pt.x) << text(point.pt.y) << text(point.size) << text(point.angle) << text(point.response)
         << text(point.octave) << text(point.class_id) << "]";
}

inline void write_value(cv::FileStorage& file, const cv::DMatch& match) {
    file << "[" << text(match.queryIdx) << text(match.trainIdx) << text(match.imgIdx) << text(match.distance) << "]";
}

{% if has_arrays %}
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

{% endif %}
template <class T>
void write_value(cv::FileStorage& file, const std::optional<T>& value);

template <class... T>
void write_value(cv::FileStorage& file, const std::tuple<T...>& value);

template <class T>
void write_value(cv::FileStorage& file, const std::vector<T>& items) {
    file << "[";
    for (const auto& item : items) {
        write_value(file, static_cast<const T&>(item));
    }
    file << "]";
}

template <class T>
void write_value(cv::FileStorage& file, const std::optional<T>& value) {
    file << "[";
    if (value) {
        write_value(file, *value);
    }
    file << "]";
}

template <class... T>
void write_value(cv::FileStorage& file, const std::tuple<T...>& value) {
    file << "[";
    std::apply([&](const auto&... items) { (write_value(file, items), ...); }, value);
    file << "]";
}

// -- comparing --------------------------------------------------------------------------------------------------------

/// Compares two numbers, to the last bit or within a tolerance.
template <class T>
void compare_numbers(const T& expected, const T& got, const Tolerance& tolerance, const std::string& where,
                     double magnitude, Difference& found) {
    if (std::memcmp(&expected, &got, sizeof(T)) == 0) {
        return;
    }
    const double left = static_cast<double>(expected);
    const double right = static_cast<double>(got);
    const bool agree = left == right || (std::isnan(left) && std::isnan(right));
    const double distance = agree ? 0.0 : std::abs(right - left);
    const double own = std::max(std::isfinite(left) ? std::abs(left) : 0.0, magnitude);
    const bool is_part = std::isinf(tolerance.relative) || distance <= tolerance.relative * own;
    const bool is_near = distance <= tolerance.absolute && (distance == 0.0 || is_part);
    if (is_near && tolerance.absolute > 0.0 && (std::is_floating_point_v<T> || tolerance.has_integers)) {
        ++found.tolerated;
    } else {
        found.add_number(where, text(expected), text(got), distance);
    }
}

template <class T, class = std::enable_if_t<std::is_arithmetic_v<T>>>
void compare(const T& expected, const T& got, const Tolerance& tolerance, const std::string& where,
        Difference& found) {
    compare_numbers(expected, got, tolerance, where, 0.0, found);
}

inline void compare(const std::string& expected, const std::string& got, const Tolerance&,
        const std::string& where,
                    Difference& found) {
    if (expected != got) {
        found.add(where, expected, got);
    }
}

/// Numbers that are almost nothing beside the largest of their array are compared with a part of that.
template <class T>
double floor_of(const std::vector<T>& numbers) {
    if constexpr (std::is_floating_point_v<T>) {
        double largest = 0.0;
        for (const T number : numbers) {
            largest = std::isfinite(number) ? std::max(largest,
                    std::abs(static_cast<double>(number))) : largest;
        }
        return 16.0 * std::sqrt(static_cast<double>(std::numeric_limits<T>::epsilon())) * largest;
    } else {
        return 0.0;
    }
}

template <class T>
std::vector<T> elements(const cv::Mat& image) {
    const cv::Mat whole = image.isContinuous() ? image : image.clone();
    const auto* first = reinterpret_cast<const T*>(whole.data);
    return first == nullptr ? std::vector<T>{} : std::vector<T>(first,
            first + whole.total() * whole.channels());
}

/// Compares the numbers of two arrays of one shape.
template <class T>
void compare_elements(const std::vector<T>& expected, const std::vector<T>& got,
        const std::vector<std::int64_t>& shape,
                      const Tolerance& tolerance, const std::string& where, Difference& found) {
    const double magnitude = floor_of(expected);
    for (std::size_t index = 0; index < expected.size(); ++index) {
        if (std::memcmp(&expected[index], &got[index], sizeof(T)) == 0) {
            continue;
        }
        std::string place;
        std::size_t rest = index;
        for (std::size_t axis = shape.size(); axis-- > 0;) {
            place = std::to_string(rest % shape[axis]) + (place.empty() ? "" : ", ") + place;
            rest /= shape[axis];
        }
        compare_numbers(expected[index], got[index], tolerance, where + "[" + place + "]", magnitude, found);
    }
}

inline void compare(const cv::Mat& expected, const cv::Mat& got, const Tolerance& tolerance,
        const std::string& where,
                    Difference& found) {
    const auto described = [](const cv::Mat& image) {
        return std::to_string(image.rows) + " x " + std::to_string(image.cols) + " of type " + cv::typeToString(image.type());
    };
    if (expected.size() != got.size() ||
            (expected.type() != got.type() && !(expected.empty() && got.empty()))) {
        found.add_shape(where, described(expected), described(got));
        return;
    }
    const auto with = [&](auto element) {
        using T = decltype(element);
        std::vector<std::int64_t> shape{expected.rows, expected.cols};
        if (expected.channels() > 1) {
            shape.push_back(expected.channels());
        }
        compare_elements(elements<T>(expected), elements<T>(got), shape, tolerance, where, found);
    };
    switch (expected.depth()) {
        case CV_8U: return with(std::uint8_t{});
        case CV_8S: return with(std::int8_t{});
        case CV_16U: return with(std::uint16_t{});
        case CV_16S: return with(std::int16_t{});
        case CV_32S: return with(std::int32_t{});
        case CV_32F: return with(float{});
        case CV_64F: return with(double{});
        default: throw std::invalid_argument("no comparison for " + described(expected));
    }
}

inline void compare(const cv::KeyPoint& expected, const cv::KeyPoint& got, const Tolerance& tolerance,
                    const std::string& where, Difference& found) {
    compare(expected.pt.x, got.pt.x, tolerance, where + ".x", found);
    compare(expected.pt.y, got.pt.y, tolerance, where + ".y", found);
    compare(expected.size, got.size, tolerance, where + ".size", found);
    compare(expected.angle, got.angle, tolerance, where + ".angle", found);
    compare(expected.response, got.response, tolerance, where + ".response", found);
    compare(expected.octave, got.octave, Tolerance{}, where + ".octave", found);
    compare(expected.class_id, got.class_id, Tolerance{}, where + ".class_id", found);
}

inline void compare(const cv::DMatch& expected, const cv::DMatch& got, const Tolerance& tolerance,
                    const std::string& where, Difference& found) {
    compare(expected.queryIdx, got.queryIdx, Tolerance{}, where + ".queryIdx", found);
    compare(expected.trainIdx, got.trainIdx, Tolerance{}, where + ".trainIdx", found);
    compare(expected.imgIdx, got.imgIdx, Tolerance{}, where + ".imgIdx", found);
    compare(expected.distance, got.distance, tolerance, where + ".distance", found);
}

{% if has_arrays %}
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

{% endif %}
template <class T>
void compare(const std::optional<T>& expected, const std::optional<T>& got, const Tolerance& tolerance,
             const std::string& where, Difference& found);

template <class... T>
void compare(const std::tuple<T...>& expected, const std::tuple<T...>& got, const Tolerance& tolerance,
             const std::string& where, Difference& found);

template <class T>
void compare(const std::vector<T>& expected, const std::vector<T>& got, const Tolerance& tolerance,
             const std::string& where, Difference& found) {
    if (expected.size() != got.size()) {
        found.add_shape(where, std::to_string(expected.size()) + " items",
                std::to_string(got.size()) + " items");
        return;
    }
    for (std::size_t index = 0; index < expected.size(); ++index) {
        const T& left = expected[index];
        const T& right = got[index];
        compare(left, right, tolerance, where + "[" + std::to_string(index) + "]", found);
    }
}

template <class T>
void compare(const std::optional<T>& expected, const std::optional<T>& got, const Tolerance& tolerance,
             const std::string& where, Difference& found) {
    if (expected && got) {
        compare(*expected, *got, tolerance, where, found);
    } else if (expected || got) {
        found.add(where, expected ? "a value" : "none", got ? "a value" : "none");
    }
}

template <std::size_t index = 0, class... T>
void compare_items(const std::tuple<T...>& expected, const std::tuple<T...>& got, const Tolerance& tolerance,
                   const std::string& where, Difference& found) {
    if constexpr (index < sizeof...(T)) {
        const std::string place = where + "[" + std::to_string(index) + "]";
        compare(std::get<index>(expected), std::get<index>(got), tolerance, place, found);
        compare_items<index + 1>(expected, got, tolerance, where, found);
    }
}

template <class... T>
void compare(const std::tuple<T...>& expected, const std::tuple<T...>& got, const Tolerance& tolerance,
             const std::string& where, Difference& found) {
    compare_items(expected, got, tolerance, where, found);
}

}  // namespace values
