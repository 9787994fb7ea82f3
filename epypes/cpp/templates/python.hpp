// @{mark}
// Numbers and lists as Python has them: what C++ does otherwise, or what it would not notice.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include <opencv2/core.hpp>

namespace python {

constexpr std::int64_t end = std::numeric_limits<std::int64_t>::max();

[[noreturn]] inline void overflow() { throw std::overflow_error("an integer has more than 64 bits"); }

[[noreturn]] inline void zero_division() { throw std::domain_error("division by zero"); }

// -- integers ---------------------------------------------------------------------------------------------------------

inline std::int64_t add(std::int64_t left, std::int64_t right) {
    std::int64_t result = 0;
    return __builtin_add_overflow(left, right, &result) ? (overflow(), 0) : result;
}

inline std::int64_t subtract(std::int64_t left, std::int64_t right) {
    std::int64_t result = 0;
    return __builtin_sub_overflow(left, right, &result) ? (overflow(), 0) : result;
}

inline std::int64_t multiply(std::int64_t left, std::int64_t right) {
    std::int64_t result = 0;
    return __builtin_mul_overflow(left, right, &result) ? (overflow(), 0) : result;
}

/// The quotient, rounded down as Python does.
inline std::int64_t floor_divide_integers(std::int64_t left, std::int64_t right) {
    if (right == 0) {
        zero_division();
    }
    if (right == -1) {
        return subtract(0, left);
    }
    return left / right - (left % right != 0 && (left < 0) != (right < 0) ? 1 : 0);
}

/// The remainder, which has the sign of the divisor.
inline std::int64_t modulo_integers(std::int64_t left, std::int64_t right) {
    if (right == 0) {
        zero_division();
    }
    const std::int64_t rest = right == -1 ? 0 : left % right;
    return rest != 0 && (rest < 0) != (right < 0) ? rest + right : rest;
}

inline std::int64_t power_integers(std::int64_t base, std::int64_t exponent) {
    if (exponent < 0) {
        throw std::domain_error("a negative exponent");
    }
    std::int64_t result = 1;
    while (exponent > 0) {
        if ((exponent & 1) != 0) {
            result = multiply(result, base);
        }
        exponent >>= 1;
        base = exponent > 0 ? multiply(base, base) : base;
    }
    return result;
}

inline std::int64_t shift_left(std::int64_t value, std::int64_t count) {
    if (count < 0) {
        throw std::invalid_argument("negative shift count");
    }
    return value == 0 ? 0 : count > 62 ? (overflow(), 0) : multiply(value, std::int64_t{1} << count);
}

inline std::int64_t shift_right(std::int64_t value, std::int64_t count) {
    if (count < 0) {
        throw std::invalid_argument("negative shift count");
    }
    return count > 63 ? (value < 0 ? -1 : 0) : value >> count;
}

inline std::int64_t absolute(std::int64_t value) { return value < 0 ? subtract(0, value) : value; }

template <class T, class V>
[[noreturn]] void out_of_bounds(V value) {
    if constexpr (std::is_same_v<T, std::int64_t>) {
        overflow();  // Python has integers of any size
    }
    const std::string name = (std::is_unsigned_v<T> ? "uint" : "int") + std::to_string(8 * sizeof(T));
    throw std::overflow_error("integer " + std::to_string(value) + " is out of bounds for " + name);
}

/// An integer as one of fewer bits; throws if it does not fit.
template <class T, class V>
T narrow(V value) {
    if constexpr (std::is_unsigned_v<V>) {
        if (value > static_cast<std::make_unsigned_t<T>>(std::numeric_limits<T>::max())) {
            out_of_bounds<T>(value);
        }
    } else {
        if (value < 0 ? std::is_unsigned_v<T> ||
                value < static_cast<std::int64_t>(std::numeric_limits<T>::min())
                      : static_cast<std::uint64_t>(value) > static_cast<std::uint64_t>(std::numeric_limits<T>::max())) {
            out_of_bounds<T>(value);
        }
    }
    return static_cast<T>(value);
}

// -- floats -----------------------------------------------------------------------------------------------------------

inline double divide_floats(double left, double right) {
    if (right == 0.0) {
        zero_division();
    }
    return left / right;
}

/// The quotient of two integers, rounded once as Python does.
inline double divide_integers(std::int64_t left, std::int64_t right) {
    constexpr std::int64_t exact = std::int64_t{1} << 53;
    if (right == 0) {
        zero_division();
    }
    if (left < -exact || left > exact || right < -exact || right > exact) {
        throw std::overflow_error("a quotient of integers of more than 53 bits");
    }
    return static_cast<double>(left) / static_cast<double>(right);
}

inline double modulo_floats(double left, double right) {
    if (right == 0.0) {
        zero_division();
    }
    const double rest = std::fmod(left, right);
    if (rest == 0.0) {
        return std::copysign(0.0, right);
    }
    return (rest < 0.0) != (right < 0.0) ? rest + right : rest;
}

inline double floor_divide_floats(double left, double right) {
    if (right == 0.0) {
        zero_division();
    }
    double rest = std::fmod(left, right);
    double quotient = (left - rest) / right;
    if (rest != 0.0 && (right < 0.0) != (rest < 0.0)) {
        quotient -= 1.0;
    }
    if (quotient == 0.0) {
        return std::copysign(0.0, left / right);
    }
    const double floor = std::floor(quotient);
    return quotient - floor > 0.5 ? floor + 1.0 : floor;
}

inline double power_floats(double base, double exponent) {
    if (base == 0.0 && exponent < 0.0) {
        zero_division();
    }
    const double result = std::pow(base, exponent);
    if (std::isfinite(base) && std::isfinite(exponent) && !std::isfinite(result)) {
        throw std::overflow_error(std::isnan(result) ? "a complex number" : "a power that is too large");
    }
    return result;
}

#define PYTHON_BINARY(name)                                                                    \
    template <class A, class B>                                                                \
    auto name(A left, B right) {                                                               \
        if constexpr (std::is_integral_v<A> && std::is_integral_v<B>) {                        \
            return name##_integers(static_cast<std::int64_t>(left), static_cast<std::int64_t>(right)); \
        } else {                                                                               \
            return name##_floats(static_cast<double>(left), static_cast<double>(right));       \
        }                                                                                      \
    }

PYTHON_BINARY(divide)
PYTHON_BINARY(floor_divide)
PYTHON_BINARY(modulo)
PYTHON_BINARY(power)
#undef PYTHON_BINARY

/// A result of the C library, for which Python raises where it is no number though all arguments are.
template <class... T>
double finite(double result, T... arguments) {
    if (!std::isfinite(result) && (std::isfinite(arguments) && ...)) {
        throw std::domain_error("math domain error");
    }
    if (std::isnan(result) && !(std::isnan(arguments) || ...)) {
        throw std::domain_error("math domain error");
    }
    return result;
}

/// A float as an integer, without its fraction.
inline std::int64_t integer(double value) {
    if (!std::isfinite(value)) {
        throw std::invalid_argument("cannot convert float NaN or infinity to integer");
    }
    const double whole = std::trunc(value);
    if (whole < -9223372036854775808.0 || whole >= 9223372036854775808.0) {
        overflow();
    }
    return static_cast<std::int64_t>(whole);
}

/// Rounds half to even.
inline std::int64_t round(double value) { return integer(std::nearbyint(value)); }

// -- lists ------------------------------------------------------------------------------------------------------------

inline std::int64_t length(const cv::Mat& image) { return image.rows; }

template <class List>
std::int64_t length(const List& list) {
    return static_cast<std::int64_t>(list.size());
}

/// The place of an item; a negative index counts from the end.
inline std::size_t place(std::int64_t index, std::int64_t size) {
    if (index < -size || index >= size) {
        throw std::out_of_range("index " + std::to_string(index) + " of " + std::to_string(size) + " items");
    }
    return static_cast<std::size_t>(index < 0 ? index + size : index);
}

template <class T>
T at(const std::vector<T>& items, std::int64_t index) {
    return items[place(index, length(items))];
}

template <class T>
std::vector<T> slice(const std::vector<T>& items, std::int64_t low, std::int64_t high) {
    const std::int64_t count = length(items);
    const auto bound = [count](std::int64_t index) { return std::clamp<std::int64_t>(index < 0 ? index + count : index,
            0, count); };
    const std::int64_t first = bound(low);
    return {items.begin() + first, items.begin() + std::max(first, bound(high))};
}

template <class T>
void check_size(const std::vector<T>& items, std::int64_t wanted) {
    if (length(items) != wanted) {
        throw std::invalid_argument(std::to_string(items.size()) + " values to unpack, and not " + std::to_string(wanted));
    }
}

/// The first of the smallest items, as Python's min.
template <class T>
T min(const std::vector<T>& items) {
    if (items.empty()) {
        throw std::invalid_argument("min() of no items");
    }
    T found = items[0];
    for (const T& item : items) {
        found = item < found ? item : found;
    }
    return found;
}

/// The first of the largest items, as Python's max.
template <class T>
T max(const std::vector<T>& items) {
    if (items.empty()) {
        throw std::invalid_argument("max() of no items");
    }
    T found = items[0];
    for (const T& item : items) {
        found = found < item ? item : found;
    }
    return found;
}

inline std::int64_t sum(const std::vector<std::int64_t>& items) {
    std::int64_t total = 0;
    for (const std::int64_t item : items) {
        total = add(total, item);
    }
    return total;
}

template <class T>
std::vector<T> sorted(std::vector<T> items, bool reverse) {
    if constexpr (std::is_same_v<T, double>) {
        if (std::any_of(items.begin(), items.end(), [](double item) { return std::isnan(item); })) {
            throw std::invalid_argument("sorted() of NaN");
        }
    }
    if (reverse) {
        std::stable_sort(items.begin(), items.end(),
                [](const T& left, const T& right) { return right < left; });
    } else {
        std::stable_sort(items.begin(), items.end());
    }
    return items;
}

/// The items in the order of what a function returns for them.
template <class T, class Key>
std::vector<T> sorted(const std::vector<T>& items, Key key, bool reverse) {
    using K = std::decay_t<decltype(key(items[0]))>;
    std::vector<std::pair<K, std::size_t>> keys;
    for (std::size_t index = 0; index < items.size(); ++index) {
        keys.emplace_back(key(items[index]), index);
        if constexpr (std::is_floating_point_v<K>) {
            if (std::isnan(keys.back().first)) {
                throw std::invalid_argument("sorted() by NaN");
            }
        }
    }
    std::stable_sort(keys.begin(), keys.end(), [reverse](const auto& left, const auto& right) {
        return reverse ? right.first < left.first : left.first < right.first;
    });
    std::vector<T> result;
    for (const auto& each : keys) {
        result.push_back(items[each.second]);
    }
    return result;
}

/// The first item for which a function returns the smallest value, or the largest.
template <class T, class Key>
T extreme(const std::vector<T>& items, Key key, bool largest) {
    if (items.empty()) {
        throw std::invalid_argument("min() or max() of no items");
    }
    std::size_t found = 0;
    auto best = key(items[0]);
    for (std::size_t index = 1; index < items.size(); ++index) {
        const auto value = key(items[index]);
        if (largest ? best < value : value < best) {
            found = index;
            best = value;
        }
    }
    return items[found];
}

/// The numbers of a range.
inline std::vector<std::int64_t> range(std::int64_t low, std::int64_t high, std::int64_t step) {
    if (step == 0) {
        throw std::invalid_argument("range() arg 3 must not be zero");
    }
    std::vector<std::int64_t> numbers;
    for (std::int64_t number = low; step > 0 ? number < high : number > high; number = add(number, step)) {
        numbers.push_back(number);
    }
    return numbers;
}

// -- None -------------------------------------------------------------------------------------------------------------

/// Whether an array is None, which is an empty cv::Mat.
inline bool is_none(const cv::Mat& image) { return image.rows == 0 && image.cols == 0; }

/// An array that must not be None.
inline const cv::Mat& required(const cv::Mat& image) {
    return is_none(image) ? throw std::invalid_argument("an array is needed, and there is None") : image;
}

}  // namespace python
