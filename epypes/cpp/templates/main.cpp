{% filter wrapped %}
// @{mark}
// Runs the graph on one image, or on values in a file of cv::FileStorage, and writes its outputs.
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <iostream>
#include <stdexcept>
#include <string>
#include <type_traits>

#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "graph.hpp"
#include "values.hpp"

namespace {

constexpr const char* usage = R"(Usage: @{ns} INPUT [--out FOLDER] [--HYPERPARAMETER VALUE ...] [-h | --help]

INPUT is an image, or a file of cv::FileStorage with a value for each input, as those in samples/. Images are written to
FOLDER as PNG, all other outputs to results.yml there. Hyperparameters:
)";

/// A command line that can't be understood.
class UsageError : public std::runtime_error {
  public:
    using std::runtime_error::runtime_error;
};

template <class T>
constexpr bool is_plain = std::is_arithmetic_v<T> || std::is_same_v<T, std::string>;

void print_usage(std::ostream& stream) {
    stream << usage;
    @{ns}::Hyperparameters hyperparameters;
    @{ns}::Hyperparameters::each(hyperparameters, [&](const char* name, const auto& member) {
        if constexpr (is_plain<std::decay_t<decltype(member)>>) {
            stream << "  --" << name << " " << values::text(member) << "\n";
        }
    });
}

/// Changes the hyperparameter that has a name.
void change(@{ns}::Hyperparameters& hyperparameters, const std::string& name, const std::string& value) {
    @{ns}::Hyperparameters::each(hyperparameters, [&](const char* own, auto& member) {
        if (name == own) {
            using T = std::decay_t<decltype(member)>;
            if constexpr (is_plain<T>) {
                try {
                    member = values::parse<T>(value);
                } catch (const std::invalid_argument& error) {
                    throw std::invalid_argument("--" + name + ": " + error.what());
                }
            } else {
                throw std::invalid_argument(name + " can only be changed in the program");
            }
        }
    });
}

bool is_option(const std::string& argument) {
    bool found = argument == "--out";
    const @{ns}::Hyperparameters hyperparameters;
    @{ns}::Hyperparameters::each(hyperparameters, [&](const char* own, const auto&) {
        found = found || argument == std::string("--") + own;
    });
    return found;
}

void read_inputs(const std::string& path, @{ns}::Inputs& inputs) {
{% set kind = inputs[0].type if inputs | length == 1 %}
{% if kind is ArrayType and kind.is_mat %}
    {# As cv2.imread reads what was recorded. #}
    {% set colour = {2: "cv::IMREAD_GRAYSCALE", 3: "cv::IMREAD_COLOR"}.get(kind.ndim, "cv::IMREAD_ANYCOLOR") %}
    {% set flags = colour if kind.dtype == "uint8" else colour ~ " | cv::IMREAD_ANYDEPTH" %}
    cv::Mat image = cv::imread(path, @{flags if kind.channels in (0, 1, 3) else "cv::IMREAD_UNCHANGED"});
    if (!image.empty()) {
    {% set depth = "image.depth() != " ~ depths[kind.dtype] if kind.dtype %}
    {% set channels = "image.channels() != " ~ (kind.channels or 1) if kind.ndim == 2 or kind.channels %}
        if (@{[depth, channels] | select | join(" || ") or "false"}) {
            throw std::invalid_argument("@{inputs[0].name} has to be an array of @{about(inputs[0])}; " + path + " is read as " +
                                        cv::typeToString(image.type()));
        }
    {% if inputs[0].token in settings.rgb and kind.ndim != 2 %}
    {% set code = "COLOR_BGRA2RGBA" if kind.channels == 4 else "COLOR_BGR2RGB" %}
        cv::cvtColor(image, image, cv::@{code});  // the graph takes RGB
    {% endif %}
        inputs.@{inputs[0].name} = image;
        return;
    }
{% endif %}
    const cv::FileStorage file(path, cv::FileStorage::READ);
    if (!file.isOpened()) {
        throw std::invalid_argument(path + " can't be read");
    }
    @{ns}::Inputs::each(inputs, [&](const char* name, auto& member) {
        if (file[name].empty()) {
            throw std::invalid_argument(path + " has no value for " + name);
        }
        values::read_value(file[name], member);
    });
}

void write_outputs(const std::string& folder, const @{ns}::Outputs& outputs) {
    cv::FileStorage file(folder + "/results.yml", cv::FileStorage::WRITE);
    if (!file.isOpened()) {
        throw std::invalid_argument(folder + " is no folder that can be written to");
    }
    @{ns}::Outputs::each(outputs, [&](const char* name, const auto& member) {
        if constexpr (std::is_same_v<std::decay_t<decltype(member)>, cv::Mat>) {
            const std::string picture = folder + "/" + name + ".png";
            const bool is_image = (member.depth() == CV_8U || member.depth() == CV_16U) && member.channels() != 2;
            if (is_image && member.channels() <= 4 && !member.empty()) {
                cv::imwrite(picture, member);
                std::cout << name << ": " << picture << "\n";
                return;
            }
            std::remove(picture.c_str());  // of an earlier run
        }
        file << name;
        values::write_value(file, member);
        std::cout << name << ": " << folder << "/results.yml\n";
    });
}

int run(int count, char** arguments) {
    @{ns}::Hyperparameters hyperparameters;
    std::string input;
    std::string folder = ".";
    for (int index = 1; index < count; ++index) {
        const std::string argument = arguments[index];
        if (argument == "-h" || argument == "--help") {
            print_usage(std::cout);
            return 0;
        }
        if (argument.rfind('-', 0) != 0) {
            if (!input.empty()) {
                throw UsageError("there is a second input, " + argument + ": it takes one");
            }
            input = argument;
            continue;
        }
        if (!is_option(argument)) {
            throw UsageError("there is no option " + argument);
        }
        if (index + 1 == count) {
            throw UsageError("the option " + argument + " needs a value");
        }
        const std::string value = arguments[++index];
        if (argument == "--out") {
            folder = value;
        } else {
            change(hyperparameters, argument.substr(2), value);
        }
    }
    if (input.empty()) {
        throw UsageError("there is no input");
    }
    @{ns}::Inputs inputs;
    read_inputs(input, inputs);
    @{ns}::Graph graph(hyperparameters);
    @{ns}::Outputs outputs;
    try {
        outputs = graph.run(inputs);
    } catch (const std::exception& error) {
        throw std::runtime_error(std::string(@{ns}::Graph::functions[graph.running()]) + ": " + error.what());
    }
    write_outputs(folder, outputs);
    for (std::size_t index = 0; index < graph.seconds().size(); ++index) {
        std::cout << @{ns}::Graph::functions[index] << ": " << 1e3 * graph.seconds()[index] << " ms\n";
    }
    return 0;
}

}  // namespace

int main(int count, char** arguments) {
    try {
        return run(count, arguments);
    } catch (const UsageError& error) {
        std::cerr << error.what() << "\n\n";
        print_usage(std::cerr);
        return 2;
    } catch (const std::exception& error) {
        std::cerr << error.what() << "\n";
        return 1;
    }
}
{% endfilter %}
