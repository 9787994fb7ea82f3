// @{mark}
// Arrays as NumPy has them: elements of any type, any number of dimensions, views, and arithmetic that wraps.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <initializer_list>
#include <limits>
#include <stdexcept>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include <opencv2/core.hpp>

#include "python.hpp"

namespace numpy {

using Size = std::int64_t;
template <int N>
using Shape = std::array<Size, N>;

/// A view of memory that it shares with other views; a copy of an Array is another view.
template <class T, int N>
struct Array {
    static_assert(std::is_arithmetic_v<T>, "the elements of an array are numbers, as in numpy::Array<float, 2>");
    Shape<N> shape{};
    Shape<N> strides{};  // in bytes
    char* data = nullptr;
    cv::Mat owner;

    Size size() const {
        Size count = 1;
        for (const Size each : shape) {
            count *= each;
        }
        return count;
    }

    /// Whether the elements lie side by side, the last axis innermost.
    bool is_contiguous() const {
        Size step = sizeof(T);
        for (int axis = N - 1; axis >= 0; --axis) {
            if (shape[axis] != 1 && strides[axis] != step) {
                return size() == 0;
            }
            step *= shape[axis];
        }
        return true;
    }

    T& operator[](const Shape<N>& index) const {
        char* place = data;
        for (int axis = 0; axis < N; ++axis) {
            place += static_cast<Size>(python::place(index[axis], shape[axis])) * strides[axis];
        }
        return *reinterpret_cast<T*>(place);
    }
};

// -- making -----------------------------------------------------------------------------------------------------------

template <class T, int N>
Array<T, N> empty(const Shape<N>& shape) {
    Array<T, N> made;
    made.shape = shape;
    Size step = sizeof(T);
    for (int axis = N - 1; axis >= 0; --axis) {
        if (shape[axis] < 0) {
            throw std::invalid_argument("negative dimensions are not allowed");
        }
        made.strides[axis] = step;
        step *= shape[axis];
    }
    if (step > std::numeric_limits<int>::max()) {
        throw std::length_error("an array of more than 2 GB");
    }
    made.owner.create(1, std::max<int>(1, static_cast<int>(step)), CV_8U);
    made.data = reinterpret_cast<char*>(made.owner.data);
    return made;
}

template <class T, int N>
Array<T, N> full(const Shape<N>& shape, T value) {
    const Array<T, N> made = empty<T, N>(shape);
    std::fill_n(reinterpret_cast<T*>(made.data), made.size(), value);
    return made;
}

template <class T, int N>
Array<T, N> array(const Shape<N>& shape, std::initializer_list<T> values) {
    const Array<T, N> made = empty<T, N>(shape);
    std::copy(values.begin(), values.end(), reinterpret_cast<T*>(made.data));
    return made;
}

// -- elements ---------------------------------------------------------------------------------------------------------

/// A number as one of another type, as NumPy casts it: integers wrap, and what does not fit an int is its smallest.
template <class R, class T>
R cast(T value) {
    if constexpr (std::is_same_v<R, bool>) {
        return value != 0;
    } else if constexpr (std::is_floating_point_v<T> && std::is_integral_v<R>) {
        using Whole = std::conditional_t<(sizeof(R) < 4 ||
                std::is_same_v<R, std::int32_t>), std::int32_t, std::int64_t>;
        constexpr double limit = sizeof(Whole) == 4 ? 2147483648.0 : 9223372036854775808.0;
        const double whole = std::trunc(static_cast<double>(value));
        return static_cast<R>(whole >= -limit &&
                whole < limit ? static_cast<Whole>(whole) : std::numeric_limits<Whole>::min());
    } else {
        return static_cast<R>(value);
    }
}

template <class A>
struct Traits {
    using Element = A;
    static constexpr int rank = 0;
};

template <class T, int N>
struct Traits<Array<T, N>> {
    using Element = T;
    static constexpr int rank = N;
};

/// An operand of a calculation, stretched to a shape: axes of one element have a step of 0.
template <class T, int N>
struct Operand {
    const char* data = nullptr;
    Shape<N> strides{};
};

template <int N, class T, int M>
Operand<T, N> stretched(const Array<T, M>& array, const Shape<N>& shape) {
    Operand<T, N> operand{array.data, {}};
    for (int axis = 0; axis < M; ++axis) {
        const int place = N - M + axis;
        if (array.shape[axis] != 1 && array.shape[axis] != shape[place]) {
            throw std::invalid_argument("operands could not be broadcast together");
        }
        operand.strides[place] = array.shape[axis] == 1 ? 0 : array.strides[axis];
    }
    return operand;
}

template <int N, class T, class = std::enable_if_t<std::is_arithmetic_v<T>>>
Operand<T, N> stretched(const T& number, const Shape<N>&) {
    return {reinterpret_cast<const char*>(&number), {}};
}

template <int N, class T, int M>
void widen(Shape<N>& shape, const Array<T, M>& array) {
    for (int axis = 0; axis < M; ++axis) {
        Size& own = shape[N - M + axis];
        own = own == 1 ? array.shape[axis] : own;
    }
}

template <int N, class T, class = std::enable_if_t<std::is_arithmetic_v<T>>>
void widen(Shape<N>&, const T&) {}

/// Calls visit(pointers...) for each element of a shape, in order.
template <int N, class Visit, class... T>
void for_each(const Shape<N>& shape, Visit visit, Operand<T, N>... operands) {
    Size count = 1;
    for (const Size each : shape) {
        count *= each;
    }
    if (count == 0) {
        return;
    }
    Shape<N> index{};
    constexpr int last = N - 1;
    while (true) {
        for (Size inner = 0; inner < shape[last]; ++inner) {
            visit(*reinterpret_cast<const T*>(operands.data + inner * operands.strides[last])...);
        }
        int axis = last - 1;
        for (; axis >= 0; --axis) {
            ((operands.data += operands.strides[axis]), ...);
            if (++index[axis] < shape[axis]) {
                break;
            }
            ((operands.data -= operands.strides[axis] * shape[axis]), ...);
            index[axis] = 0;
        }
        if (axis < 0) {
            return;
        }
    }
}

/// The results of a function of one element of each operand: an array, or a number if all operands are.
template <class F, class... A>
auto apply(F function, const A&... operands) {
    constexpr int rank = std::max({Traits<A>::rank...});
    using R = std::decay_t<decltype(function(typename Traits<A>::Element{}...))>;
    if constexpr (rank == 0) {
        return function(operands...);
    } else {
        Shape<rank> shape;
        shape.fill(1);
        (widen<rank>(shape, operands), ...);
        const Array<R, rank> made = empty<R, rank>(shape);
        auto* next = reinterpret_cast<R*>(made.data);
        for_each<rank>(shape, [&](const auto&... values) { *next++ = function(values...); },
                stretched<rank>(operands, shape)...);
        return made;
    }
}

template <class R, class A>
auto astype(const A& array) {
    return apply([](auto value) { return cast<R>(value); }, array);
}

template <class T, int N>
Array<T, N> copy(const Array<T, N>& array) {
    return astype<T>(array);
}

/// An array that shares memory with no other.
template <class T, int N>
Array<T, N> owned(const Array<T, N>& array) {
    return copy(array);
}

template <class T, int N>
Array<T, N> contiguous(const Array<T, N>& array) {
    return array.is_contiguous() ? array : copy(array);
}

// -- images -----------------------------------------------------------------------------------------------------------

/// An image as an array that shares its memory; channels are the third dimension.
template <class T, int N>
Array<T, N> array(const cv::Mat& image) {
    static_assert(N == 2 || N == 3, "a cv::Mat becomes an array of 2 dimensions, or of 3 with its channels");
    // A list of points or lines is a column of several channels; newer versions of OpenCV for Python make rows of it.
    const bool is_list = N == 2 && image.channels() > 1 && image.cols == 1;
    const bool has_rank = (image.channels() == 1) == (N == 2) || is_list;
    if (python::required(image).depth() != cv::DataType<T>::depth || !has_rank || image.dims > 2) {
        throw std::invalid_argument("an array of another type is needed, not " + cv::typeToString(image.type()));
    }
    Array<T, N> made;
    made.shape[0] = image.rows;
    made.shape[1] = image.cols;
    made.strides[0] = static_cast<Size>(image.step[0]);
    made.strides[1] = static_cast<Size>(image.elemSize());
    if constexpr (N == 3) {
        made.shape[2] = image.channels();
        made.strides[2] = sizeof(T);
    }
    if (is_list) {
        made.shape[1] = image.channels();
        made.strides[1] = sizeof(T);
    }
    made.data = reinterpret_cast<char*>(image.data);
    made.owner = image;
    return made;
}

template <class T, int N>
Array<T, N> array(const Array<T, N>& whole) {
    return whole;
}

/// Whether a cv::Mat can share an array's memory.
template <class T, int N>
bool is_shareable(const Array<T, N>& array) {
    const Size channels = N == 3 ? array.shape[N - 1] : 1;
    const bool inner = N != 3 || channels == 1 || array.strides[N - 1] == sizeof(T);
    const Size row = N == 1 ? 1 : array.shape[1 % N];
    const Size element = channels * static_cast<Size>(sizeof(T));
    const bool outer = N == 1 || row <= 1 || array.strides[1 % N] == element;
    return inner && outer && (array.shape[0] <= 1 || array.strides[0] >= row * element);
}

/// An array as an image that shares its memory if it can; one of one dimension is a column.
template <class T, int N>
cv::Mat mat(const Array<T, N>& given) {
    static_assert(N >= 1 && N <= 3, "a cv::Mat is made of an array of 1, 2 or 3 dimensions");
    const Array<T, N> array = is_shareable(given) ? given : copy(given);
    const int channels = N == 3 ? static_cast<int>(array.shape[N - 1]) : 1;
    const int rows = static_cast<int>(array.shape[0]);
    const int columns = N == 1 ? 1 : static_cast<int>(array.shape[1 % N]);
    const int type = CV_MAKETYPE(cv::DataType<T>::depth, channels);
    if (rows == 0 || columns == 0) {
        return cv::Mat(rows, columns, type);
    }
    const Size row = columns * channels * static_cast<Size>(sizeof(T));
    cv::Mat image(rows, columns, type, array.data,
            static_cast<std::size_t>(rows == 1 ? row : array.strides[0]));
    image.u = array.owner.u;  // the image keeps the memory
    image.addref();
    return image;
}

/// Arrays as images that OpenCV reads.
template <class T, int N>
std::vector<cv::Mat> mat(const std::vector<Array<T, N>>& arrays) {
    std::vector<cv::Mat> images;
    for (const Array<T, N>& array : arrays) {
        images.push_back(mat(array));
    }
    return images;
}

/// An array as an image that OpenCV writes to.
template <class T, int N>
cv::Mat in_out(const Array<T, N>& array) {
    if (!is_shareable(array)) {
        throw std::invalid_argument("OpenCV can't write to an array of this layout");
    }
    return mat(array);
}

// -- arithmetic -------------------------------------------------------------------------------------------------------

/// An integer type in which the sum or product of two elements wraps and is not undefined.
template <class T>
using Wrapping = std::common_type_t<std::make_unsigned_t<std::conditional_t<std::is_same_v<T, bool>, int, T>>, unsigned>;

template <class R, class Sign>
R calculated(R left, R right, Sign sign) {
    if constexpr (std::is_integral_v<R>) {
        return static_cast<R>(sign(static_cast<Wrapping<R>>(left), static_cast<Wrapping<R>>(right)));
    } else {
        return sign(left, right);
    }
}

#define NUMPY_BINARY(name, expression)                                            \
    template <class R, class A, class B>                                          \
    auto name(const A& one, const B& other) {                                     \
        return apply(                                                             \
            [](auto a, auto b) -> R {                                             \
                [[maybe_unused]] const R left = cast<R>(a), right = cast<R>(b);   \
                return expression;                                                \
            },                                                                    \
            one, other);                                                          \
    }

NUMPY_BINARY(add, calculated(left, right, [](auto x, auto y) { return x + y; }))
NUMPY_BINARY(subtract, calculated(left, right, [](auto x, auto y) { return x - y; }))
NUMPY_BINARY(multiply, calculated(left, right, [](auto x, auto y) { return x * y; }))
NUMPY_BINARY(true_divide, left / right)
NUMPY_BINARY(hypot, std::hypot(left, right))
NUMPY_BINARY(bitwise_and, static_cast<R>(left & right))
NUMPY_BINARY(bitwise_or, static_cast<R>(left | right))
NUMPY_BINARY(bitwise_xor, static_cast<R>(left ^ right))
NUMPY_BINARY(minimum, left != left ? left : right != right ? right : left <= right ? left : right)
NUMPY_BINARY(maximum, left != left ? left : right != right ? right : left >= right ? left : right)
NUMPY_BINARY(logical_and, left && right)
NUMPY_BINARY(logical_or, left || right)

/// The quotient, rounded down; 0 for an integer by 0.
template <class R>
R floored(R left, R right) {
    if constexpr (std::is_floating_point_v<R>) {
        if (right == 0) {
            return left / right;
        }
        R rest = std::fmod(left, right);
        R quotient = (left - rest) / right;
        quotient -= rest != 0 && (right < 0) != (rest < 0) ? R{1} : R{0};
        if (quotient == 0) {
            return std::copysign(R{0}, left / right);
        }
        const R floor = std::floor(quotient);
        return quotient - floor > R{0.5} ? floor + R{1} : floor;
    } else if constexpr (std::is_signed_v<R>) {
        if (right == 0) {
            return 0;
        }
        if (right == -1) {
            return calculated(R{0}, left, [](auto x, auto y) { return x - y; });
        }
        return static_cast<R>(left / right - (left % right != 0 && (left < 0) != (right < 0) ? 1 : 0));
    } else {
        return right == 0 ? R{0} : static_cast<R>(left / right);
    }
}

/// The remainder, which has the sign of the divisor; 0 for an integer by 0.
template <class R>
R rest_of(R left, R right) {
    if constexpr (std::is_floating_point_v<R>) {
        const R rest = std::fmod(left, right);
        if (rest == 0) {
            return std::copysign(R{0}, right);
        }
        return (rest < 0) != (right < 0) ? rest + right : rest;
    } else {
        if (right == 0 || (std::is_signed_v<R> && right == static_cast<R>(-1))) {
            return 0;
        }
        const R rest = static_cast<R>(left % right);
        return rest != 0 && (rest < 0) != (right < 0) ? static_cast<R>(rest + right) : rest;
    }
}

NUMPY_BINARY(floor_divide, floored(left, right))
NUMPY_BINARY(remainder, rest_of(left, right))
#undef NUMPY_BINARY

/// Whether one number is less than another: exact for integers, else as floats of type C.
template <class C, class A, class B>
bool is_less(A left, B right) {
    if constexpr (std::is_integral_v<A> && std::is_integral_v<B>) {
        if constexpr (std::is_signed_v<A> && std::is_unsigned_v<B>) {
            return left < 0 || static_cast<std::uint64_t>(left) < static_cast<std::uint64_t>(right);
        } else if constexpr (std::is_unsigned_v<A> && std::is_signed_v<B>) {
            return right >= 0 && static_cast<std::uint64_t>(left) < static_cast<std::uint64_t>(right);
        } else {
            return left < right;
        }
    } else {
        return cast<C>(left) < cast<C>(right);
    }
}

template <class C, class A, class B>
bool is_equal(A left, B right) {
    if constexpr (std::is_integral_v<A> && std::is_integral_v<B>) {
        return !is_less<C>(left, right) && !is_less<C>(right, left);
    } else {
        return cast<C>(left) == cast<C>(right);
    }
}

#define NUMPY_COMPARE(name, expression)                                       \
    template <class C, class A, class B>                                      \
    auto name(const A& one, const B& other) {                                 \
        return apply([](auto a, auto b) -> bool { return expression; }, one, other); \
    }

NUMPY_COMPARE(less, is_less<C>(a, b))
NUMPY_COMPARE(greater, is_less<C>(b, a))
NUMPY_COMPARE(less_equal, is_less<C>(a, b) || is_equal<C>(a, b))
NUMPY_COMPARE(greater_equal, is_less<C>(b, a) || is_equal<C>(a, b))
NUMPY_COMPARE(equal, is_equal<C>(a, b))
NUMPY_COMPARE(not_equal, !is_equal<C>(a, b))
#undef NUMPY_COMPARE

#define NUMPY_UNARY(name, expression)                                                   \
    template <class R, class A>                                                         \
    auto name(const A& one) {                                                           \
        return apply([](auto a) -> R { const R value = cast<R>(a); return expression; }, one); \
    }

NUMPY_UNARY(negative, calculated(R{0}, value, [](auto x, auto y) { return x - y; }))
NUMPY_UNARY(positive, value)
NUMPY_UNARY(square, calculated(value, value, [](auto x, auto y) { return x * y; }))
NUMPY_UNARY(sqrt, std::sqrt(value))
NUMPY_UNARY(floor, std::floor(value))
NUMPY_UNARY(ceil, std::ceil(value))
NUMPY_UNARY(trunc, std::trunc(value))
NUMPY_UNARY(rint, std::nearbyint(value))
#undef NUMPY_UNARY

template <class A>
auto negated(const A& one) {
    return apply([](auto value) { return -value; }, one);
}

template <class R, class A>
auto absolute(const A& one) {
    return apply([](auto a) -> R {
        if constexpr (std::is_floating_point_v<R>) {
            return std::abs(a);
        } else if constexpr (std::is_unsigned_v<R>) {
            return a;
        } else {
            return a < 0 ? calculated(R{0}, a, [](auto x, auto y) { return x - y; }) : a;
        }
    }, one);
}

template <class R, class A>
auto invert(const A& one) {
    return apply([](auto a) -> R {
        if constexpr (std::is_same_v<R, bool>) {
            return !a;
        } else {
            return static_cast<R>(~a);
        }
    }, one);
}

template <class A>
auto logical_not(const A& one) {
    return apply([](auto a) -> bool { return a == 0; }, one);
}

template <class A>
auto isnan(const A& one) {
    return apply([](auto a) -> bool { return a != a; }, one);
}

template <class A>
auto isfinite(const A& one) {
    return apply([](auto a) -> bool { return std::isfinite(static_cast<double>(a)); }, one);
}

template <class R, class C, class A, class B>
auto where(const C& condition, const A& one, const B& other) {
    return apply([](auto c, auto a, auto b) -> R { return c != 0 ? cast<R>(a) : cast<R>(b); }, condition, one,
            other);
}

/// The numbers within two bounds; NaN stays, and a bound that is NaN gives it.
template <class R, class A, class L, class H>
auto clip(const A& array, const L& low, const H& high) {
    return apply([](auto a, auto l, auto h) -> R {
        const R least = cast<R>(l), most = cast<R>(h);
        const R value = cast<R>(a) < least || least != least ? least : cast<R>(a);
        return value > most || (most != most && value == value) ? most : value;
    }, array, low, high);
}

// -- views ------------------------------------------------------------------------------------------------------------

/// One step of a subscript: an index, a slice or a new axis.
struct Step {
    enum class Kind { index, slice, axis } kind = Kind::axis;
    Size low = 0;
    Size high = 0;
    Size step = 1;
    bool has_low = false;
    bool has_high = false;
};

inline Step at(Size index) { return {Step::Kind::index, index, 0, 1, true, true}; }

inline Step all() { return {Step::Kind::slice, 0, 0, 1, false, false}; }

inline Step from(Size low, Size step = 1) { return {Step::Kind::slice, low, 0, step, true, false}; }

inline Step to(Size high, Size step = 1) { return {Step::Kind::slice, 0, high, step, false, true}; }

inline Step between(Size low, Size high,
        Size step = 1) { return {Step::Kind::slice, low, high, step, true, true}; }

inline Step every(Size step) { return {Step::Kind::slice, 0, 0, step, false, false}; }

inline Step axis() { return {}; }

/// A view of M dimensions: an axis per slice, per new axis, and per axis of the array that no step names.
template <int M, class T, int N>
Array<T, M> view(const Array<T, N>& array, std::initializer_list<Step> steps) {
    Array<T, M> made;
    made.data = array.data;
    made.owner = array.owner;
    int source = 0;
    int target = 0;
    for (const Step& step : steps) {
        if (step.kind == Step::Kind::axis) {
            made.shape[target] = 1;
            made.strides[target++] = 0;
            continue;
        }
        const Size size = array.shape[source];
        const Size stride = array.strides[source++];
        if (step.kind == Step::Kind::index) {
            made.data += static_cast<Size>(python::place(step.low, size)) * stride;
            continue;
        }
        if (step.step == 0) {
            throw std::invalid_argument("slice step cannot be zero");
        }
        const Size least = step.step < 0 ? -1 : 0;
        const Size most = step.step < 0 ? size - 1 : size;
        const auto bound = [&](Size index) { return std::clamp(index < 0 ? index + size : index, least,
                most); };
        const Size low = step.has_low ? bound(step.low) : step.step < 0 ? most : least;
        const Size high = step.has_high ? bound(step.high) : step.step < 0 ? least : most;
        const Size away = step.step < 0 ? low - high : high - low;
        const Size pace = step.step < 0 ? -step.step : step.step;
        const Size count = away > 0 ? (away + pace - 1) / pace : 0;
        made.data += count > 0 ? low * stride : 0;
        made.shape[target] = count;
        made.strides[target++] = stride * step.step;
    }
    for (; source < N; ++source, ++target) {
        made.shape[target] = array.shape[source];
        made.strides[target] = array.strides[source];
    }
    return made;
}

/// The strides of the same memory in another shape, as NumPy finds them; whether there are any.
template <int M, class T, int N>
bool find_strides(const Array<T, N>& array, const Shape<M>& shape, Shape<M>& strides) {
    std::vector<Size> sizes;
    std::vector<Size> steps;
    for (int axis = 0; axis < N; ++axis) {
        if (array.shape[axis] != 1) {
            sizes.push_back(array.shape[axis]);
            steps.push_back(array.strides[axis]);
        }
    }
    std::size_t source = 0;
    int target = 0;
    while (target < M && source < sizes.size()) {
        // The axes of both that have as many elements.
        std::size_t source_end = source + 1;
        int target_end = target + 1;
        Size before = sizes[source];
        Size after = shape[target];
        while (before != after) {
            before < after ? before *= sizes[source_end++] : after *= shape[target_end++];
        }
        for (std::size_t axis = source; axis + 1 < source_end; ++axis) {
            if (steps[axis] != sizes[axis + 1] * steps[axis + 1]) {
                return false;
            }
        }
        Size step = steps[source_end - 1];
        for (int axis = target_end - 1; axis >= target; --axis) {
            strides[axis] = step;
            step *= shape[axis];
        }
        source = source_end;
        target = target_end;
    }
    for (; target < M; ++target) {
        strides[target] = target > 0 ? strides[target - 1] : static_cast<Size>(sizeof(T));
    }
    return true;
}

/// The same memory in another shape where strides say it, else a copy; one size may be -1.
template <int M, class T, int N>
Array<T, M> reshape(const Array<T, N>& array, Shape<M> shape) {
    Size known = 1;
    for (const Size each : shape) {
        known *= each < 0 ? 1 : each;
    }
    for (Size& each : shape) {
        if (each < 0) {
            if (known == 0 || array.size() % known != 0) {
                throw std::invalid_argument("cannot reshape array");
            }
            each = array.size() / known;
        }
    }
    Array<T, M> made;
    made.shape = shape;
    if (made.size() != array.size()) {
        throw std::invalid_argument("cannot reshape array");
    }
    if (!array.is_contiguous() && array.size() > 1 && find_strides<M>(array, shape, made.strides)) {
        made.data = array.data;
        made.owner = array.owner;
        return made;
    }
    const Array<T, N> source = contiguous(array);
    made.data = source.data;
    made.owner = source.owner;
    Size step = sizeof(T);
    for (int axis = M - 1; axis >= 0; --axis) {
        made.strides[axis] = step;
        step *= shape[axis];
    }
    return made;
}

template <class T, int N>
Array<T, 1> ravel(const Array<T, N>& array) {
    return reshape<1>(contiguous(array), {array.size()});
}

template <class T, int N>
Array<T, N> transpose(Array<T, N> array) {
    std::reverse(array.shape.begin(), array.shape.end());
    std::reverse(array.strides.begin(), array.strides.end());
    return array;
}

/// Writes values, stretched to its shape, to a view.
template <class T, int N, class V>
void assign(const Array<T, N>& target, const V& values) {
    if constexpr (Traits<V>::rank > 0) {
        // What is written may overlap with what is read.
        const auto source = copy(values);
        for_each<N>(target.shape,
                [](const T& place, const auto& value) { const_cast<T&>(place) = cast<T>(value); },
                    Operand<T, N>{target.data, target.strides}, stretched<N>(source, target.shape));
    } else {
        for_each<N>(target.shape, [&](const T& place) { const_cast<T&>(place) = cast<T>(values); },
                    Operand<T, N>{target.data, target.strides});
    }
}

/// The places where a mask is true, counted in the order of its elements.
template <int M>
std::vector<Size> places(const Array<bool, M>& mask) {
    std::vector<Size> found;
    Size place = 0;
    for_each<M>(mask.shape, [&](bool is_set) { is_set ? found.push_back(place++) : void(++place); },
            Operand<bool, M>{mask.data, mask.strides});
    return found;
}

template <int M, class T, int N>
void check_mask(const Array<T, N>& array, const Array<bool, M>& mask) {
    static_assert(M <= N);
    if (!std::equal(mask.shape.begin(), mask.shape.end(), array.shape.begin())) {
        throw std::out_of_range("boolean index did not match indexed array");
    }
}

/// The rows of an array: its first M axes as one.
template <int M, class T, int N>
Array<T, N - M + 1> rows(const Array<T, N>& array) {
    Shape<N - M + 1> shape;
    shape[0] = 1;
    for (int axis = 0; axis < N; ++axis) {
        axis < M ? void(shape[0] *= array.shape[axis]) : void(shape[axis - M + 1] = array.shape[axis]);
    }
    return reshape<N - M + 1>(array, shape);
}

/// The rows at some places, as a copy.
template <class T, int N>
Array<T, N> taken(const Array<T, N>& array, const std::vector<Size>& places) {
    const Array<T, N> source = contiguous(array);
    Shape<N> shape = array.shape;
    shape[0] = static_cast<Size>(places.size());
    const Array<T, N> made = empty<T, N>(shape);
    const std::size_t width = static_cast<std::size_t>(array.shape[0] == 0 ? 0 : array.size() / array.shape[0]) * sizeof(T);
    char* next = made.data;
    for (const Size place : places) {
        std::memcpy(next, source.data + place * static_cast<Size>(width), width);
        next += width;
    }
    return made;
}

template <class T, int N, int M>
Array<T, N - M + 1> take(const Array<T, N>& array, const Array<bool, M>& mask) {
    check_mask(array, mask);
    return taken(rows<M>(array), places(mask));
}

/// The rows at integer places.
template <class I, class T, int N, class = std::enable_if_t<!std::is_same_v<I, bool>>>
Array<T, N> take(const Array<T, N>& array, const Array<I, 1>& indices) {
    std::vector<Size> found;
    for_each<1>(indices.shape,
            [&](I index) { found.push_back(static_cast<Size>(python::place(static_cast<Size>(index),
            array.shape[0]))); },
                Operand<I, 1>{indices.data, indices.strides});
    return taken(array, found);
}

/// Writes to the elements or rows where a mask is true: one number or row to all of them, or to each the next one.
template <class T, int N, int M, class V>
void put(const Array<T, N>& array, const Array<bool, M>& mask, const V& values) {
    check_mask(array, mask);
    // What is written may overlap with what is read.
    const auto source = astype<typename Traits<V>::Element>(values);
    Operand<bool, N> wide{mask.data, {}};
    std::copy(mask.strides.begin(), mask.strides.end(), wide.strides.begin());
    if constexpr (Traits<V>::rank == N - M + 1) {
        const bool is_whole = std::equal(array.shape.begin() + M, array.shape.end(), source.shape.begin() + 1);
        const bool is_one = M == N && source.size() == 1;
        if (!is_one && (!is_whole || source.shape[0] != static_cast<Size>(places(mask).size()))) {
            throw std::invalid_argument("NumPy boolean array indexing assignment: other number of values");
        }
        const auto* next = reinterpret_cast<const typename Traits<V>::Element*>(source.data);
        const Size step = is_one ? 0 : 1;
        for_each<N>(array.shape, [&](const T& place, bool is_set) {
            if (is_set) {
                const_cast<T&>(place) = cast<T>(*next);
                next += step;
            }
        }, Operand<T, N>{array.data, array.strides}, wide);
    } else {
        for_each<N>(array.shape, [](const T& place, bool is_set, const auto& value) {
            if (is_set) {
                const_cast<T&>(place) = cast<T>(value);
            }
        }, Operand<T, N>{array.data, array.strides}, wide, stretched<N>(source, array.shape));
    }
}

// -- reductions -------------------------------------------------------------------------------------------------------

/// The sum of numbers as NumPy adds them: in pairs of blocks, so that the last digits are the same.
template <class T>
T pairwise(const char* data, Size count, Size stride) {
    const auto number = [&](Size index) { return *reinterpret_cast<const T*>(data + index * stride); };
    if (count < 8) {
        T total = T{-0.0};
        for (Size index = 0; index < count; ++index) {
            total += number(index);
        }
        return total;
    }
    if (count <= 128) {
        std::array<T, 8> part;
        for (Size index = 0; index < 8; ++index) {
            part[index] = number(index);
        }
        Size next = 8;
        for (; next < count - count % 8; next += 8) {
            for (Size index = 0; index < 8; ++index) {
                part[index] += number(next + index);
            }
        }
        T total = ((part[0] + part[1]) + (part[2] + part[3])) + ((part[4] + part[5]) + (part[6] + part[7]));
        for (; next < count; ++next) {
            total += number(next);
        }
        return total;
    }
    const Size half = count / 2 - count / 2 % 8;
    return pairwise<T>(data, half, stride) + pairwise<T>(data + half * stride, count - half, stride);
}

/// The sum along the last axis, of each row.
template <class R, class T, int N>
Array<R, N - 1> row_sums(const Array<T, N>& array) {
    Shape<N - 1> shape;
    std::copy_n(array.shape.begin(), N - 1, shape.begin());
    const Array<R, N - 1> made = full<R, N - 1>(shape, R{0});
    auto* next = reinterpret_cast<R*>(made.data);
    const Array<T, N> source = contiguous(array);
    const char* row = source.data;
    const Size length = array.shape[N - 1];
    for (Size index = 0; index < made.size(); ++index, row += length * static_cast<Size>(sizeof(T))) {
        if constexpr (std::is_floating_point_v<R>) {
            next[index] = R{0} + pairwise<R>(row, length, sizeof(R));
        } else {
            for (Size inner = 0; inner < length; ++inner) {
                const R value = cast<R>(reinterpret_cast<const T*>(row)[inner]);
                next[index] = calculated(next[index], value, [](auto x, auto y) { return x + y; });
            }
        }
    }
    return made;
}

template <class R, class T, int N>
R sum(const Array<T, N>& array) {
    if constexpr (std::is_floating_point_v<R>) {
        if (!array.is_contiguous()) {
            throw std::logic_error("the sum of floats that do not lie side by side");
        }
    }
    const Array<R, 1> flat = ravel(astype<R>(array));
    Array<R, 2> row = reshape<2>(flat, {1, flat.size()});
    return row_sums<R>(row)[{0}];
}

/// The part at one place of an axis: a view without that axis.
template <class T, int N>
Array<T, N - 1> part_at(const Array<T, N>& array, int axis, Size index) {
    Array<T, N - 1> part;
    part.data = array.data + index * array.strides[axis];
    part.owner = array.owner;
    for (int each = 0, target = 0; each < N; ++each) {
        if (each != axis) {
            part.shape[target] = array.shape[each];
            part.strides[target++] = array.strides[each];
        }
    }
    return part;
}

/// The sum along one axis.
template <class R, class T, int N>
Array<R, N - 1> sum(const Array<T, N>& array, int along) {
    const int axis = along < 0 ? along + N : along;
    // Axes of one element are none for NumPy: it adds in pairs along the last axis that is left.
    if (std::all_of(array.shape.begin() + axis + 1, array.shape.end(), [](Size size) { return size == 1; })) {
        Shape<N> rows = array.shape;
        std::rotate(rows.begin() + axis, rows.begin() + axis + 1, rows.end());
        return row_sums<R>(reshape<N>(astype<R>(array), rows));
    }
    Array<R, N - 1> total = full<R, N - 1>(part_at(array, axis, 0).shape, R{0});
    for (Size index = 0; index < array.shape[axis]; ++index) {
        total = add<R>(total, part_at(array, axis, index));
    }
    return total;
}

/// The mean; of integers, whose sum is exact, a double.
template <class T, int N>
auto mean(const Array<T, N>& array) {
    if constexpr (std::is_floating_point_v<T>) {
        return sum<T>(array) / static_cast<T>(array.size());
    } else {
        static_assert(sizeof(T) <= 4);
        return static_cast<double>(sum<std::int64_t>(array)) / static_cast<double>(array.size());
    }
}

template <class T, int N>
auto mean(const Array<T, N>& array, int along) {
    const Size count = array.shape[along < 0 ? along + N : along];
    if constexpr (std::is_floating_point_v<T>) {
        return true_divide<T>(sum<T>(array, along), static_cast<T>(count));
    } else {
        static_assert(sizeof(T) <= 4);
        return true_divide<double>(sum<std::int64_t>(array, along), static_cast<double>(count));
    }
}

template <class T, int N>
auto var(const Array<T, N>& array) {
    using R = decltype(mean(array));
    const auto away = subtract<R>(array, mean(array));
    return sum<R>(multiply<R>(away, away)) / static_cast<R>(array.size());
}

/// The place of the first element that is the largest, or the smallest; NaN is either.
template <bool largest, class T, int N>
Size extreme(const Array<T, N>& array) {
    const Array<T, N> whole = contiguous(array);
    const auto* values = reinterpret_cast<const T*>(whole.data);
    const Size count = array.size();
    if (count == 0) {
        throw std::invalid_argument("attempt to get the extreme of an empty sequence");
    }
    Size found = 0;
    for (Size index = 0; index < count; ++index) {
        if (values[index] != values[index]) {
            return index;
        }
        found = (largest ? values[found] < values[index] : values[index] < values[found]) ? index : found;
    }
    return found;
}

template <class T, int N>
Size argmax(const Array<T, N>& array) {
    return extreme<true>(array);
}

template <class T, int N>
Size argmin(const Array<T, N>& array) {
    return extreme<false>(array);
}

template <class T, int N>
T max(const Array<T, N>& array) {
    return reinterpret_cast<const T*>(contiguous(array).data)[argmax(array)];
}

template <class T, int N>
T min(const Array<T, N>& array) {
    return reinterpret_cast<const T*>(contiguous(array).data)[argmin(array)];
}

/// The largest or smallest elements along one axis.
template <class Choose, class T, int N>
Array<T, N - 1> along_axis(const Array<T, N>& array, int along, Choose choose) {
    const int axis = along < 0 ? along + N : along;
    if (array.shape[axis] == 0) {
        throw std::invalid_argument("zero-size array to reduction operation");
    }
    Array<T, N - 1> found;
    for (Size index = 0; index < array.shape[axis]; ++index) {
        const Array<T, N - 1> part = part_at(array, axis, index);
        found = index == 0 ? copy(part) : choose(found, part);
    }
    return found;
}

template <class T, int N>
Array<T, N - 1> max(const Array<T, N>& array, int along) {
    return along_axis(array, along,
            [](const auto& one, const auto& other) { return maximum<T>(one, other); });
}

template <class T, int N>
Array<T, N - 1> min(const Array<T, N>& array, int along) {
    return along_axis(array, along,
            [](const auto& one, const auto& other) { return minimum<T>(one, other); });
}

template <class T, int N>
Size count_nonzero(const Array<T, N>& array) {
    return sum<std::int64_t>(astype<bool>(array));
}

template <class T, int N>
bool any(const Array<T, N>& array) {
    return count_nonzero(array) > 0;
}

template <class T, int N>
bool all(const Array<T, N>& array) {
    return count_nonzero(array) == array.size();
}

/// A mean of a weighted sum.
inline double weighted(double total, double weight) {
    if (weight == 0.0) {
        throw std::domain_error("Weights sum to zero, can't be normalized");
    }
    return total / weight;
}

/// Throws if an array has not as many rows as are unpacked.
template <class T, int N>
void check_rows(const Array<T, N>& array, Size wanted) {
    if (array.shape[0] != wanted) {
        throw std::invalid_argument(std::to_string(array.shape[0]) + " values to unpack, and not " + std::to_string(wanted));
    }
}

// -- lists and orders -------------------------------------------------------------------------------------------------

/// A number of Python as an element; throws if an integer does not fit.
template <class T, class V>
T element(const V& value) {
    if constexpr (std::is_floating_point_v<T> || std::is_same_v<T, bool>) {
        return static_cast<T>(value);
    } else if constexpr (std::is_floating_point_v<V>) {
        return python::narrow<T>(python::integer(value));
    } else {
        return python::narrow<T>(value);
    }
}

template <class T, class V>
Array<T, 1> from_list(const std::vector<V>& items) {
    const Array<T, 1> made = empty<T, 1>({python::length(items)});
    auto* next = reinterpret_cast<T*>(made.data);
    for (const auto& item : items) {
        *next++ = element<T>(static_cast<V>(item));
    }
    return made;
}

/// A list of which NumPy makes an array of another dtype if it is empty.
template <class V>
const std::vector<V>& filled(const std::vector<V>& items) {
    return items.empty() ? throw std::logic_error("an array of an empty list has another dtype") : items;
}

/// An array with a row per tuple. Of no rows NumPy would make one of another shape: that is for `reshape` alone.
template <class T, class... V>
Array<T, 2> from_rows(const std::vector<std::tuple<V...>>& rows, bool is_reshaped = false) {
    if (rows.empty() && !is_reshaped) {
        throw std::logic_error("an array of no rows has one dimension");
    }
    const Array<T, 2> made = empty<T, 2>({python::length(rows), static_cast<Size>(sizeof...(V))});
    auto* next = reinterpret_cast<T*>(made.data);
    for (const auto& row : rows) {
        std::apply([&](const auto&... items) { ((*next++ = element<T>(items)), ...); }, row);
    }
    return made;
}

template <class T>
Array<T, 1> arange(Size low, Size high, Size step) {
    return from_list<T>(python::range(low, high, step));
}

/// Sorts along the last axis; NaN comes last.
template <class T, int N>
Array<T, N> sort(const Array<T, N>& array) {
    const Array<T, N> made = copy(array);
    const Size length = array.shape[N - 1];
    auto* row = reinterpret_cast<T*>(made.data);
    for (Size index = 0; length > 0 && index < made.size() / length; ++index, row += length) {
        std::sort(row, row + length,
                [](T left, T right) { return left < right || (right != right && left == left); });
    }
    return made;
}

/// The places of the elements in their order; equal ones stay in theirs.
template <class T>
Array<Size, 1> argsort(const Array<T, 1>& array) {
    const Array<Size, 1> made = arange<Size>(0, array.size(), 1);
    auto* places = reinterpret_cast<Size*>(made.data);
    std::stable_sort(places, places + made.size(), [&](Size left, Size right) {
        const T one = array[{left}];
        const T other = array[{right}];
        return one < other || (other != other && one == one);
    });
    return made;
}

/// The places where an array is not zero: an array per axis.
template <int axis, class T, int N>
Array<Size, 1> nonzero(const Array<T, N>& array) {
    std::vector<Size> found = places(astype<bool>(array));
    Size inner = 1;
    for (int each = axis + 1; each < N; ++each) {
        inner *= array.shape[each];
    }
    for (Size& place : found) {
        place = place / inner % array.shape[axis];
    }
    return from_list<Size>(found);
}

template <class T, int N>
Array<T, N> concatenate(const std::vector<Array<T, N>>& parts, int along) {
    const int axis = along < 0 ? along + N : along;
    Shape<N> shape = parts.at(0).shape;
    shape[axis] = 0;
    for (const auto& part : parts) {
        for (int each = 0; each < N; ++each) {
            if (each != axis && part.shape[each] != shape[each]) {
                throw std::invalid_argument("all the input array dimensions must match");
            }
        }
        shape[axis] += part.shape[axis];
    }
    const Array<T, N> made = empty<T, N>(shape);
    Array<T, N> window = made;
    for (const auto& part : parts) {
        window.shape[axis] = part.shape[axis];
        assign(window, part);
        window.data += window.strides[axis] * part.shape[axis];
    }
    return made;
}

/// An array with a new axis before the others.
template <class T, int N>
Array<T, N + 1> raised(const Array<T, N>& array, int axis) {
    Array<T, N + 1> made;
    made.data = array.data;
    made.owner = array.owner;
    for (int each = 0, source = 0; each <= N; ++each) {
        made.shape[each] = each == axis ? 1 : array.shape[source];
        made.strides[each] = each == axis ? 0 : array.strides[source++];
    }
    return made;
}

}  // namespace numpy
