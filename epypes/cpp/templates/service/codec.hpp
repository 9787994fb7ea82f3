// Values of the v1 envelope as C++ values, and back; see envelope.proto.
//
// Nothing in a message is trusted before it is checked: whatever the bytes are, only MessageError is thrown.
#pragma once

#include <cstddef>
#include <cstdint>
#include <opencv2/core.hpp>
#include <set>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>
#include <zmq.hpp>

#include "envelope.pb.h"

namespace service {

using epypes::v1::Value;

// What a message may hold.
namespace limits {
constexpr std::size_t total_bytes = 256u << 20;
constexpr std::size_t header_bytes = 16u << 20;
constexpr std::size_t topic_bytes = 1024;
constexpr std::size_t frames = 1024;
constexpr int parts = 1024;
constexpr std::size_t values = 1'000'000;
constexpr std::size_t depth = 24;
}  // namespace limits

// The version that is written, and the greatest that is read.
constexpr std::uint32_t newest_version = 1;

// A message that can't be understood, or a value that can't be sent.
class MessageError : public std::runtime_error {
  public:
    using std::runtime_error::runtime_error;
};

enum class Order { bgr, rgb };

// Topic, Envelope, payloads.
using Frames = std::vector<zmq::message_t>;

// The dtype of NumPy that a type of C++ is.
template <typename T>
constexpr const char* dtype_of() {
    constexpr const char* of_floats[] = {"<f4", "<f8"};
    constexpr const char* of_signed[] = {"|i1", "<i2", "<i4", "<i8"};
    constexpr const char* of_unsigned[] = {"|u1", "<u2", "<u4", "<u8"};
    constexpr int place = sizeof(T) == 1 ? 0 : sizeof(T) == 2 ? 1 : sizeof(T) == 4 ? 2 : 3;
    if constexpr (std::is_same_v<T, bool>) {
        return "|b1";
    } else if constexpr (std::is_floating_point_v<T>) {
        return of_floats[place - 2];
    } else {
        return std::is_signed_v<T> ? of_signed[place] : of_unsigned[place];
    }
}

// Checks the number and the sizes of the frames of a message, and its topic; MessageError for what is no v1 message.
void check_frames(const Frames& frames);

// Reads the parts of one message, whose frames have to stay. Arrays are copies: a function may keep one.
class Reader {
  public:
    // Parses and checks the whole message, with its limits.
    explicit Reader(const Frames& frames);
    Reader(const Reader&) = delete;
    Reader& operator=(const Reader&) = delete;

    const epypes::v1::Envelope& envelope() const { return envelope_; }

    // The value of each input token, in the order of the names; the message must have these parts and no others.
    std::vector<const Value*> parts(const std::vector<std::string>& names) const;

    // An array of a depth, -1 for any, and a number of axes, 0 for any; of three axes the last one is the channels, 0
    // for any number of them.
    cv::Mat array(const Value& value, const std::string& where, int depth, int axes, int channels, Order order) const;

    struct Elements {
        std::vector<std::int64_t> shape;
        const char* data;
        std::size_t size;
    };

    // The elements of an array of a dtype and a number of axes, whatever they are.
    Elements elements(const Value& value, const std::string& where, const std::string& dtype, std::size_t axes) const;
    bool boolean(const Value& value, const std::string& where) const;
    std::int64_t integer(const Value& value, const std::string& where) const;
    double number(const Value& value, const std::string& where) const;
    // A number of NumPy, of the dtype that is this type.
    template <typename T>
    T scalar(const Value& value, const std::string& where) const {
        T number;
        read_scalar(value, where, dtype_of<T>(), &number, sizeof number);
        return number;
    }
    const std::string& text(const Value& value, const std::string& where) const;
    std::nullptr_t none(const Value& value, const std::string& where) const;
    std::vector<cv::KeyPoint> keypoints(const Value& value, const std::string& where) const;
    std::vector<cv::DMatch> matches(const Value& value, const std::string& where) const;

    // The items of a list or a tuple, each read by a function.
    template <typename Read>
    auto list(const Value& value, const std::string& where, Read read) const {
        const auto& found = items(value, where);
        std::vector<decltype(read(found[0]))> result;
        result.reserve(static_cast<std::size_t>(found.size()));
        for (const auto& item : found) {
            result.push_back(read(item));
        }
        return result;
    }

    // The items of a list or a tuple, of which there are so many.
    const google::protobuf::RepeatedPtrField<Value>& items(const Value& value, const std::string& where,
                                                           int count = -1) const;

  private:
    struct Bytes {
        const char* data;
        std::size_t size;
    };

    void check(const Value& value, const std::string& where, std::size_t depth);
    void enter(int items, const std::string& where, std::size_t depth);
    template <typename Holder>
    void claim(const Holder& holder, const std::string& where);
    template <typename Holder>
    Bytes stored(const Holder& holder) const;
    cv::Mat image(const epypes::v1::Image& image, const std::string& where, Order order) const;
    Elements checked(const epypes::v1::Tensor& tensor, const std::string& where, std::size_t item_size) const;
    cv::Mat tensor(const epypes::v1::Tensor& tensor, const std::string& where) const;
    void read_scalar(const Value& value, const std::string& where, const char* dtype, void* number,
                     std::size_t size) const;
    cv::Mat records(const Value& value, const char* type, int columns, const std::string& where) const;

    const Frames& frames_;
    epypes::v1::Envelope envelope_;
    std::set<std::uint32_t> claimed_;
    std::size_t values_ = 0;
};

// How a sequence is held in Python.
enum class Holder { list, tuple };

// Writes values, and collects the payload frames beside them.
class Writer {
  public:
    // With as many axes as the array has in Python, whose last one is the channels for OpenCV.
    void array(Value& value, const cv::Mat& array, int axes, Order order);
    // The bytes of the elements of an array, side by side.
    void elements(Value& value, const std::string& dtype, const std::vector<std::int64_t>& shape, const char* data,
                  std::size_t size);
    // A number of NumPy, of the dtype that is its type.
    template <typename T>
    void scalar(Value& value, T number) {
        write_scalar(value, dtype_of<T>(), &number, sizeof number);
    }
    void keypoints(Value& value, const std::vector<cv::KeyPoint>& keypoints, Holder holder);
    void matches(Value& value, const std::vector<cv::DMatch>& matches, Holder holder);

    // The items of a list or a tuple, each written by a function.
    template <typename T, typename Write>
    void list(Value& value, const std::vector<T>& items, Holder holder, Write write) {
        auto& list = *(holder == Holder::list ? value.mutable_list() : value.mutable_tuple());
        for (const auto& item : items) {
            write(*list.add_items(), item);
        }
    }

    // The payload frames, in order.
    std::vector<std::string> take() { return std::move(payloads_); }

  private:
    template <typename Storage>
    void store(Storage& storage, std::string bytes);
    void write_scalar(Value& value, const char* dtype, const void* number, std::size_t size);
    void records(Value& value, const char* type, const cv::Mat& rows, Holder holder);

    std::vector<std::string> payloads_;
};

}  // namespace service
