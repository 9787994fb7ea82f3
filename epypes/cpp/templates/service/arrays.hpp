// Arrays of array.hpp in messages.
#pragma once

#include <algorithm>
#include <cstring>
#include <string>
#include <vector>

#include "array.hpp"
#include "codec.hpp"

namespace service {

template <class T, int N>
numpy::Array<T, N> read_array(const Reader& reader, const Value& value, const std::string& where) {
    const auto elements = reader.elements(value, where, dtype_of<T>(), N);
    numpy::Shape<N> shape;
    std::copy(elements.shape.begin(), elements.shape.end(), shape.begin());
    auto array = numpy::empty<T, N>(shape);
    if (elements.size > 0) {
        std::memcpy(array.data, elements.data, elements.size);
    }
    return array;
}

template <class T, int N>
void write_array(Writer& writer, Value& value, const numpy::Array<T, N>& array) {
    const auto whole = numpy::contiguous(array);
    writer.elements(value, dtype_of<T>(), {whole.shape.begin(), whole.shape.end()}, whole.data,
                    static_cast<std::size_t>(whole.size()) * sizeof(T));
}

}  // namespace service
