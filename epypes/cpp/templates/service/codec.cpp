#include "codec.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <map>

namespace service {
namespace {

// Arrays of fewer bytes are sent inside the Envelope frame.
constexpr std::size_t inline_below = 8192;
constexpr std::int64_t longest_side = std::int64_t{1} << 48;
constexpr std::size_t most_axes = 32;

// The dtypes that OpenCV has, little-endian, by depth.
const std::map<std::string, int> depths = {{"|u1", CV_8U},  {"|i1", CV_8S},  {"<u2", CV_16U}, {"<i2", CV_16S},
                                           {"<i4", CV_32S}, {"<f4", CV_32F}, {"<f8", CV_64F}};
const char* const dtypes[] = {"|u1", "|i1", "<u2", "<i2", "<i4", "<f4", "<f8"};

struct Encoding {
    int channels;
    int depth;
};

const std::map<std::string, Encoding> encodings = {
    {"mono8", {1, CV_8U}}, {"mono16", {1, CV_16U}}, {"bgr8", {3, CV_8U}},  {"bgr16", {3, CV_16U}},
    {"rgb8", {3, CV_8U}},  {"rgb16", {3, CV_16U}},  {"bgra8", {4, CV_8U}}, {"bgra16", {4, CV_16U}},
    {"rgba8", {4, CV_8U}}, {"rgba16", {4, CV_16U}}};

std::string quoted(const std::string& name) { return "'" + name.substr(0, 80) + "'"; }

std::string join(const std::vector<std::string>& names) {
    std::string text;
    for (const auto& name : names) {
        text += (text.empty() ? "" : ", ") + quoted(name);
    }
    return text.empty() ? "none" : text;
}

MessageError another(const std::string& where, const char* wanted) {
    return MessageError(where + " is no " + wanted + ".");
}

// Rows, columns and channels that OpenCV takes an array of such a shape as: a third axis is the channels.
cv::Mat shaped(const std::vector<std::int64_t>& shape, int depth, void* data) {
    std::vector<int> sizes(shape.begin(), shape.end());
    int channels = 1;
    if (sizes.size() == 3 && sizes[2] >= 1 && sizes[2] <= CV_CN_MAX) {
        channels = sizes[2];
        sizes.pop_back();
    }
    sizes.resize(std::max<std::size_t>(sizes.size(), 2), 1);
    return cv::Mat(static_cast<int>(sizes.size()), sizes.data(), CV_MAKETYPE(depth, channels), data);
}

// A copy with memory of its own; of an empty array too, whose sizes cv::Mat::clone forgets.
cv::Mat copied(const cv::Mat& view) {
    return view.empty() ? cv::Mat(view.dims, view.size.p, view.type()) : view.clone();
}

// The elements of an array, side by side.
std::string bytes_of(const cv::Mat& array) {
    const cv::Mat whole = array.isContinuous() ? array : array.clone();
    const std::size_t size = whole.total() * whole.elemSize();
    return size == 0 ? std::string() : std::string(reinterpret_cast<const char*>(whole.data), size);
}

}  // namespace

void check_frames(const Frames& frames) {
    if (frames.size() < 2) {
        throw MessageError("A v1 message has a topic and an Envelope.");
    }
    if (frames.size() - 2 > limits::frames) {
        throw MessageError("A message may have " + std::to_string(limits::frames) + " payload frames.");
    }
    std::size_t total = 0;
    for (const auto& frame : frames) {
        total += frame.size();
    }
    if (total > limits::total_bytes || frames[1].size() > limits::header_bytes) {
        throw MessageError("The message has " + std::to_string(total) + " bytes, its Envelope " +
                           std::to_string(frames[1].size()) + "; that is too large.");
    }
    const auto& topic = frames[0];
    if (topic.size() == 0 || topic.size() > limits::topic_bytes || topic.data<char>()[topic.size() - 1] != '/') {
        throw MessageError("The first frame is no topic: it must be short and end in a slash.");
    }
}

Reader::Reader(const Frames& frames) : frames_(frames) {
    check_frames(frames);
    const auto& header = frames[1];
    if (!envelope_.ParseFromArray(header.data(), static_cast<int>(header.size()))) {
        throw MessageError("The second frame is no Envelope.");
    }
    if (envelope_.version() > newest_version) {
        throw MessageError("The Envelope is of version " + std::to_string(envelope_.version()) +
                           ", and this service reads version 1.");
    }
    if (std::max({envelope_.parts_size(), envelope_.attributes_size(), envelope_.timings_size()}) > limits::parts) {
        throw MessageError("A message may have " + std::to_string(limits::parts) + " parts, attributes and timings.");
    }
    std::set<std::string> names;
    for (const auto& part : envelope_.parts()) {
        if (!names.insert(part.name()).second) {
            throw MessageError("The message has " + quoted(part.name()) + " twice among its parts.");
        }
        ++values_;
        check(part.value(), part.name().substr(0, 80), 1);
    }
    for (const auto& attribute : envelope_.attributes()) {
        ++values_;
        check(attribute.value(), attribute.name().substr(0, 80), 1);
    }
    if (claimed_.size() != frames.size() - 2) {
        throw MessageError("Payload frames belong to no value.");
    }
}

void Reader::check(const Value& value, const std::string& where, std::size_t depth) {
    switch (value.kind_case()) {
        case Value::KIND_NOT_SET:
            throw MessageError(where + " has no value, or one of a newer kind.");
        case Value::kImage:
            return claim(value.image(), where);
        case Value::kTensor:
            return claim(value.tensor(), where);
        case Value::kEncoded:
            return claim(value.encoded(), where);
        case Value::kRecords:
            return claim(value.records().rows(), where);
        case Value::kTable:
        case Value::kArrowTable:
            throw MessageError(where + " is a table, which this service does not take.");
        case Value::kMap:
            enter(2 * value.map().entries_size(), where, depth);
            for (const auto& entry : value.map().entries()) {
                check(entry.key(), where, depth + 1);
                check(entry.value(), where, depth + 1);
            }
            return;
        case Value::kList:
        case Value::kTuple:
        case Value::kSet:
        case Value::kFrozenSet: {
            const auto& list = value.has_list()    ? value.list()
                               : value.has_tuple() ? value.tuple()
                               : value.has_set()   ? value.set()
                                                   : value.frozen_set();
            enter(list.items_size(), where, depth);
            for (const auto& item : list.items()) {
                check(item, where, depth + 1);
            }
            return;
        }
        default:
            return;
    }
}

void Reader::enter(int items, const std::string& where, std::size_t depth) {
    if (items > 0 && depth > limits::depth) {
        throw MessageError(where + " nests deeper than " + std::to_string(limits::depth) + " containers. Flatten it.");
    }
    values_ += static_cast<std::size_t>(items);
    if (values_ > limits::values) {
        throw MessageError(where + ": the message holds more than " + std::to_string(limits::values) + " values.");
    }
}

template <typename Holder>
void Reader::claim(const Holder& holder, const std::string& where) {
    if (holder.storage_case() == Holder::STORAGE_NOT_SET) {
        throw MessageError(where + " has neither inline data nor a frame.");
    }
    if (holder.storage_case() == Holder::kFrame) {
        if (holder.frame() >= frames_.size() - 2) {
            throw MessageError(where + " is in payload frame " + std::to_string(holder.frame()) + ", but there are " +
                               std::to_string(frames_.size() - 2) + ".");
        }
        if (!claimed_.insert(holder.frame()).second) {
            throw MessageError(where + " is in a payload frame that another value is in too.");
        }
    }
}

template <typename Holder>
Reader::Bytes Reader::stored(const Holder& holder) const {
    if (holder.storage_case() == Holder::kInline) {
        return {holder.inline_().data(), holder.inline_().size()};
    }
    const auto& frame = frames_[holder.frame() + 2];
    return {static_cast<const char*>(frame.data()), frame.size()};
}

std::vector<const Value*> Reader::parts(const std::vector<std::string>& names) const {
    std::vector<const Value*> found(names.size(), nullptr);
    std::vector<std::string> got;
    bool fits = true;
    for (const auto& part : envelope_.parts()) {
        const auto place = std::find(names.begin(), names.end(), part.name());
        got.push_back(part.name());
        if (place == names.end()) {
            fits = false;
        } else {
            found[static_cast<std::size_t>(place - names.begin())] = &part.value();
        }
    }
    if (!fits || got.size() != names.size()) {
        throw MessageError("The event must have the parts " + join(names) + "; it has " + join(got) + ".");
    }
    return found;
}

cv::Mat Reader::array(const Value& value, const std::string& where, int depth, int axes, int channels,
                      Order order) const {
    cv::Mat found;
    int found_axes = 0;
    if (value.has_image()) {
        found = image(value.image(), where, order);
        found_axes = found.channels() == 1 ? 2 : 3;
    } else if (value.has_tensor() && !value.tensor().scalar()) {
        found = tensor(value.tensor(), where);
        found_axes = value.tensor().shape_size();
    } else {
        throw another(where, "array");
    }
    if ((depth >= 0 && found.depth() != depth) || (axes > 0 && found_axes != axes) ||
        (channels > 0 && found.channels() != channels)) {
        const auto described = [](int its_depth, int its_axes, int its_channels) {
            return std::string(cv::depthToString(its_depth)) + ", " + std::to_string(its_axes) + " axes" +
                   (its_axes == 3 && its_channels != 0 ? " (" + std::to_string(its_channels) + " channels)" : "");
        };
        throw MessageError(where + " is an array of " + described(found.depth(), found_axes, found.channels()) +
                           "; this service takes " + described(depth, axes, channels) + ".");
    }
    return found;
}

cv::Mat Reader::image(const epypes::v1::Image& image, const std::string& where, Order order) const {
    const auto found = encodings.find(image.encoding());
    if (found == encodings.end()) {
        throw MessageError(where + " has encoding " + quoted(image.encoding()) + ", which is not known.");
    }
    const auto [channels, depth] = found->second;
    const auto data = stored(image);
    const int type = CV_MAKETYPE(depth, channels);
    const std::uint64_t row = std::uint64_t{image.width()} * CV_ELEM_SIZE(type);
    if (row == 0 || image.height() == 0 || image.step() < row || image.width() > INT32_MAX ||
        image.height() > INT32_MAX) {
        throw MessageError(where + " is " + std::to_string(image.width()) + " x " + std::to_string(image.height()) +
                           " " + image.encoding() + " with step " + std::to_string(image.step()) + ", which can't be.");
    }
    if (std::uint64_t{image.step()} * image.height() != data.size) {
        throw MessageError(where + " has " + std::to_string(data.size) + " bytes, but " +
                           std::to_string(image.height()) + " rows of " + std::to_string(image.step()) +
                           " take another number.");
    }
    const cv::Mat view(static_cast<int>(image.height()), static_cast<int>(image.width()), type,
                       const_cast<char*>(data.data), image.step());
    const Order own = image.encoding().compare(0, 3, "rgb") == 0 ? Order::rgb : Order::bgr;
    if (channels == 1 || own == order) {
        return copied(view);
    }
    cv::Mat swapped(view.size(), type);
    const int exchange[] = {0, 2, 1, 1, 2, 0, 3, 3};
    cv::mixChannels(&view, 1, &swapped, 1, exchange, static_cast<std::size_t>(channels));
    return swapped;
}

Reader::Elements Reader::checked(const epypes::v1::Tensor& tensor, const std::string& where,
                                 std::size_t item_size) const {
    const std::vector<std::int64_t> shape(tensor.shape().begin(), tensor.shape().end());
    const auto data = stored(tensor);
    std::uint64_t wanted = item_size;
    bool is_shape = shape.size() <= most_axes && (!tensor.scalar() || shape.empty());
    for (const auto side : shape) {
        is_shape = is_shape && side >= 0 && side <= INT32_MAX;
        // Sizes are compared before they can overflow: no side is above 2**31, and no message has 2**32 bytes.
        wanted = std::min(is_shape ? wanted * static_cast<std::uint64_t>(side) : 0, std::uint64_t{1} << 32);
    }
    if (!is_shape) {
        throw MessageError(where + " has a shape that no array has.");
    }
    if (wanted != data.size) {
        throw MessageError(where + " has " + std::to_string(data.size) + " bytes, and its shape of " + tensor.dtype() +
                           " takes another number.");
    }
    return {shape, data.data, data.size};
}

cv::Mat Reader::tensor(const epypes::v1::Tensor& tensor, const std::string& where) const {
    const auto found = depths.find(tensor.dtype());
    if (found == depths.end()) {
        throw MessageError(where + " has dtype " + quoted(tensor.dtype()) + ", which this service does not take.");
    }
    const auto elements = checked(tensor, where, static_cast<std::size_t>(CV_ELEM_SIZE1(found->second)));
    return copied(shaped(elements.shape, found->second, const_cast<char*>(elements.data)));
}

Reader::Elements Reader::elements(const Value& value, const std::string& where, const std::string& dtype,
                                  std::size_t axes) const {
    const auto& tensor = value.tensor();
    if (!value.has_tensor() || tensor.scalar() || tensor.dtype() != dtype ||
        static_cast<std::size_t>(tensor.shape_size()) != axes) {
        throw MessageError(where + " is no array of dtype " + dtype + " with " + std::to_string(axes) + " axes.");
    }
    const auto found = checked(tensor, where, static_cast<std::size_t>(dtype[2] - '0'));
    if (dtype == "|b1" &&
        std::any_of(found.data, found.data + found.size, [](char byte) { return (byte & ~1) != 0; })) {
        throw MessageError(where + " has booleans that are neither 0 nor 1.");
    }
    return found;
}

bool Reader::boolean(const Value& value, const std::string& where) const {
    if (value.kind_case() != Value::kBoolean) {
        throw another(where, "boolean");
    }
    return value.boolean();
}

std::int64_t Reader::integer(const Value& value, const std::string& where) const {
    if (value.kind_case() != Value::kInteger) {
        throw another(where, "whole number");
    }
    return value.integer();
}

double Reader::number(const Value& value, const std::string& where) const {
    if (value.kind_case() != Value::kNumber) {
        throw another(where, "number");
    }
    return value.number();
}

void Reader::read_scalar(const Value& value, const std::string& where, const char* dtype, void* number,
                         std::size_t size) const {
    const auto& tensor = value.tensor();
    const bool is_scalar = value.has_tensor() && tensor.scalar() && tensor.shape_size() == 0 && tensor.dtype() == dtype;
    const Bytes data = is_scalar ? stored(tensor) : Bytes{nullptr, 0};
    const bool is_boolean = std::strcmp(dtype, "|b1") != 0 || (data.size == 1 && (data.data[0] & ~1) == 0);
    if (data.size != size || !is_boolean) {
        throw MessageError(where + " is no number of dtype " + dtype + ".");
    }
    std::memcpy(number, data.data, size);
}

const std::string& Reader::text(const Value& value, const std::string& where) const {
    if (value.kind_case() != Value::kText) {
        throw another(where, "text");
    }
    return value.text();
}

std::nullptr_t Reader::none(const Value& value, const std::string& where) const {
    if (value.kind_case() != Value::kNone) {
        throw another(where, "None");
    }
    return nullptr;
}

const google::protobuf::RepeatedPtrField<Value>& Reader::items(const Value& value, const std::string& where,
                                                               int count) const {
    if (!value.has_list() && !value.has_tuple()) {
        throw another(where, "list or tuple");
    }
    const auto& found = value.has_list() ? value.list().items() : value.tuple().items();
    if (count >= 0 && found.size() != count) {
        throw MessageError(where + " has " + std::to_string(found.size()) + " items; this service takes " +
                           std::to_string(count) + ".");
    }
    return found;
}

cv::Mat Reader::records(const Value& value, const char* type, int columns, const std::string& where) const {
    if ((value.has_list() && value.list().items_size() == 0) ||
        (value.has_tuple() && value.tuple().items_size() == 0)) {
        return cv::Mat(0, columns, CV_64F);
    }
    if (!value.has_records() || value.records().type() != type || value.records().inner() != 0 ||
        value.records().counts_size() != 0) {
        throw MessageError(where + " is no sequence of " + type + ".");
    }
    const cv::Mat rows = tensor(value.records().rows(), where);
    if (rows.type() != CV_64FC1 || rows.dims != 2 || rows.cols != columns ||
        (value.records().outer() == 0 && rows.rows != 1)) {
        throw MessageError(where + " has rows that are no " + type + ".");
    }
    return rows;
}

namespace {

// A number of a row that is an int of OpenCV.
int whole(double number, const std::string& where) {
    if (!(number >= INT32_MIN && number <= INT32_MAX) || std::trunc(number) != number) {
        throw MessageError(where + " has a number that does not fit its field.");
    }
    return static_cast<int>(number);
}

// A number of a row that is a float of OpenCV; NaN and infinity are.
float real(double number, const std::string& where) {
    const auto found = std::abs(number) > std::numeric_limits<float>::max() && std::isfinite(number)
                           ? std::numeric_limits<float>::infinity()
                           : static_cast<float>(number);
    if (static_cast<double>(found) != number && !std::isnan(number)) {
        throw MessageError(where + " has a number that does not fit its field.");
    }
    return found;
}

}  // namespace

std::vector<cv::KeyPoint> Reader::keypoints(const Value& value, const std::string& where) const {
    const cv::Mat rows = records(value, "KeyPoint", 7, where);
    std::vector<cv::KeyPoint> found;
    for (int row = 0; row < rows.rows; ++row) {
        const auto* of = rows.ptr<double>(row);
        found.emplace_back(real(of[0], where), real(of[1], where), real(of[2], where), real(of[3], where),
                           real(of[4], where), whole(of[5], where), whole(of[6], where));
    }
    return found;
}

std::vector<cv::DMatch> Reader::matches(const Value& value, const std::string& where) const {
    const cv::Mat rows = records(value, "DMatch", 4, where);
    std::vector<cv::DMatch> found;
    for (int row = 0; row < rows.rows; ++row) {
        const auto* of = rows.ptr<double>(row);
        found.emplace_back(whole(of[0], where), whole(of[1], where), whole(of[2], where), real(of[3], where));
    }
    return found;
}

template <typename Storage>
void Writer::store(Storage& storage, std::string bytes) {
    if (bytes.size() < inline_below) {
        storage.set_inline_(std::move(bytes));
    } else {
        storage.set_frame(static_cast<std::uint32_t>(payloads_.size()));
        payloads_.push_back(std::move(bytes));
    }
}

void Writer::elements(Value& value, const std::string& dtype, const std::vector<std::int64_t>& shape, const char* data,
                      std::size_t size) {
    auto& tensor = *value.mutable_tensor();
    tensor.set_dtype(dtype);
    for (const auto side : shape) {
        tensor.add_shape(side);
    }
    store(tensor, size == 0 ? std::string() : std::string(data, size));
}

void Writer::array(Value& value, const cv::Mat& array, int axes, Order order) {
    const int channels = array.channels();
    const bool is_image = array.dims == 2 && array.total() > 0 && (array.depth() == CV_8U || array.depth() == CV_16U) &&
                          ((axes == 2 && channels == 1) || (axes == 3 && (channels == 3 || channels == 4)));
    if (is_image) {
        auto& image = *value.mutable_image();
        image.set_width(static_cast<std::uint32_t>(array.cols));
        image.set_height(static_cast<std::uint32_t>(array.rows));
        const std::string colours = order == Order::rgb ? "rgb" : "bgr";
        image.set_encoding((channels == 1   ? "mono"
                            : channels == 3 ? colours
                                            : colours + "a") +
                           (array.depth() == CV_8U ? "8" : "16"));
        image.set_step(static_cast<std::uint32_t>(static_cast<std::size_t>(array.cols) * array.elemSize()));
        store(image, bytes_of(array));
        return;
    }
    auto& tensor = *value.mutable_tensor();
    tensor.set_dtype(dtypes[array.depth()]);
    std::vector<int> shape(array.size.p, array.size.p + array.dims);
    if (axes > array.dims || channels > 1) {
        shape.push_back(channels);
    }
    if (axes == 1) {
        shape.assign(1, static_cast<int>(array.total()));
    }
    for (const int side : shape) {
        tensor.add_shape(side);
    }
    store(tensor, bytes_of(array));
}

void Writer::write_scalar(Value& value, const char* dtype, const void* number, std::size_t size) {
    auto& tensor = *value.mutable_tensor();
    tensor.set_dtype(dtype);
    tensor.set_scalar(true);
    tensor.set_inline_(number, size);
}

void Writer::records(Value& value, const char* type, const cv::Mat& rows, Holder holder) {
    auto& records = *value.mutable_records();
    records.set_type(type);
    records.set_outer(holder == Holder::list ? epypes::v1::Records::LIST : epypes::v1::Records::TUPLE);
    auto& tensor = *records.mutable_rows();
    tensor.set_dtype("<f8");
    tensor.add_shape(rows.rows);
    tensor.add_shape(rows.cols);
    store(tensor, bytes_of(rows));
}

void Writer::keypoints(Value& value, const std::vector<cv::KeyPoint>& keypoints, Holder holder) {
    cv::Mat rows(static_cast<int>(keypoints.size()), 7, CV_64F);
    for (int row = 0; row < rows.rows; ++row) {
        const auto& of = keypoints[static_cast<std::size_t>(row)];
        const double numbers[] = {of.pt.x,
                                  of.pt.y,
                                  of.size,
                                  of.angle,
                                  of.response,
                                  static_cast<double>(of.octave),
                                  static_cast<double>(of.class_id)};
        std::copy(std::begin(numbers), std::end(numbers), rows.ptr<double>(row));
    }
    records(value, "KeyPoint", rows, holder);
}

void Writer::matches(Value& value, const std::vector<cv::DMatch>& matches, Holder holder) {
    cv::Mat rows(static_cast<int>(matches.size()), 4, CV_64F);
    for (int row = 0; row < rows.rows; ++row) {
        const auto& of = matches[static_cast<std::size_t>(row)];
        const double numbers[] = {static_cast<double>(of.queryIdx), static_cast<double>(of.trainIdx),
                                  static_cast<double>(of.imgIdx), of.distance};
        std::copy(std::begin(numbers), std::end(numbers), rows.ptr<double>(row));
    }
    records(value, "DMatch", rows, holder);
}

}  // namespace service
