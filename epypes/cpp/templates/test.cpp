{% filter wrapped %}
// @{mark}
// Replays the recorded samples: each function with its recorded inputs, and the graph as a whole.
//
//   replay [--only FUNCTION] [--tolerance TOKEN=ABSOLUTE[,RELATIVE]] [--samples FOLDER]
//
// A tolerance that is given here also holds for integers. A line per token says that it is bit-identical, or where it
// differs first, with what was expected and what was got.
#include <algorithm>
#include <exception>
#include <iostream>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

#include "graph.hpp"
#include "values.hpp"

namespace {

/// Compares tokens with what was recorded, and prints what it finds.
class Report {
  public:
    std::map<std::string, values::Tolerance> tolerances{
{%- for token, bound in settings.tolerances.items() %}
{@{recording.tokens[token].name | quoted}, {@{bound.absolute}, @{bound.relative}}}@{", " if not loop.last}
{%- endfor %}
};

    void begin(const std::string& name, const std::string& sample) { where_ = "sample " + sample + ", " + name + ", "; }

    template <class T>
    void compare(const char* token, const cv::FileNode& recorded, const T& got) {
        T expected{};
        values::read_value(recorded, expected);
        values::Difference found;
        values::compare(expected, got, tolerances[token], "", found);
        std::cout << where_ << token << found.index << ": ";
        if (found.count != 0) {
            std::cout << (found.is_shape ? "the shape or the type differs: " : "") << "expected " << found.expected
                      << ", got " << found.got;
            if (found.largest) {
                std::cout << "; " << found.count << " differ, by at most " << *found.largest;
            }
            std::cout << "\n";
            ++failed;
            differs = true;
        } else if (found.tolerated != 0) {
            std::cout << "within the tolerance; " << found.tolerated << " are not bit-identical\n";
        } else {
            std::cout << "bit-identical\n";
        }
    }

    void fail(const std::string& reason) {
        std::cout << where_ << reason << "\n";
        ++failed;
    }

    int failed = 0;
    bool differs = false;  // whether a value does

  private:
    std::string where_;
};

template <class T>
T read(const cv::FileNode& node) {
    T value{};
    values::read_value(node, value);
    return value;
}

{% for function in functions %}
{% set given, made = recording.inputs_of(function.function), recording.outputs_of(function.function) %}
void test_@{function.name}(const cv::FileNode& sample, Report& report) {
{% for token in given | reject("in", hyperparameters) | unique | sort(attribute="name", case_sensitive=true) %}
    const auto @{token.name} = read<@{token.cpp}>(sample[@{token.name | quoted}]);
{% endfor %}
{% if given | select("in", hyperparameters) | list %}
    const @{ns}::Hyperparameters h;
{% endif %}
{% set call = ns ~ "::" ~ function.name ~ "(" ~ given | map("source", is_recorded=true) | join(", ") ~ ")" %}
{% if cg.has_single_output(function.function) %}
    report.compare(@{made[0].name | quoted}, sample[@{made[0].name | quoted}], @{call});
{% else %}
    const auto results = @{call};
{% for token in made %}
    report.compare(@{token.name | quoted}, sample[@{token.name | quoted}], std::get<@{loop.index0}>(results));
{% endfor %}
{% endif %}
}

{% endfor %}
void test_whole_graph(const cv::FileNode& sample, Report& report) {
    @{ns}::Inputs inputs;
    @{ns}::Inputs::each(inputs, [&](const char* name, auto& member) { values::read_value(sample[name], member); });
    @{ns}::Graph graph;
{% if states %}
    @{ns}::State state;
    @{ns}::State::each(state, [&](const char* name, auto& member) { values::read_value(sample[name], member); });
    graph.set_state(state);
{% endif %}
    const @{ns}::Outputs outputs = graph.run(inputs);
    @{ns}::Outputs::each(outputs, [&](const char* name, const auto& got) { report.compare(name, sample[name], got); });
}

struct Case {
    const char* name;
    void (*run)(const cv::FileNode& sample, Report& report);
};

const std::vector<Case> cases{
{%- for function in functions %}
{@{function.name | quoted}, test_@{function.name}}, @{""}
{%- endfor %}
{"whole_graph", test_whole_graph}};

const std::vector<std::string> tokens{
{%- for function in functions %}
@{recording.outputs_of(function.function) | map(attribute="name") | map("quoted") | join(", ")}@{", " if not loop.last}
{%- endfor %}
};

constexpr const char* usage = R"(Usage: replay [--only FUNCTION] [--tolerance TOKEN=ABSOLUTE[,RELATIVE] ...] [--samples FOLDER]
)";

void set_tolerance(Report& report, const std::string& text) {
    const std::size_t equal = text.find('=');
    const std::string token = text.substr(0, equal);
    if (equal == std::string::npos || std::find(tokens.begin(), tokens.end(), token) == tokens.end()) {
        std::string listed;
        for (const std::string& each : tokens) {
            listed += (listed.empty() ? "" : ", ") + each;
        }
        throw std::invalid_argument("--tolerance takes TOKEN=ABSOLUTE[,RELATIVE], not " + text + "; there are " + listed);
    }
    const std::string numbers = text.substr(equal + 1);
    const std::size_t comma = numbers.find(',');
    values::Tolerance& tolerance = report.tolerances[token];
    tolerance = {values::parse<double>(numbers.substr(0, comma))};
    tolerance.has_integers = true;
    if (comma != std::string::npos) {
        tolerance.relative = values::parse<double>(numbers.substr(comma + 1));
    }
}

int run(int count, char** arguments) {
    Report report;
    std::string only;
    std::string folder = SAMPLES;
    for (int index = 1; index < count; index += 2) {
        const std::string option = arguments[index];
        if (option == "-h" || option == "--help") {
            std::cout << usage;
            return 0;
        }
        const std::string value = index + 1 < count ? arguments[index + 1] : "";
        if (value.empty() || (option != "--only" && option != "--samples" && option != "--tolerance")) {
            std::cerr << "there is no option " << option << ", or it needs a value\n" << usage;
            return 2;
        }
        if (option == "--only") {
            only = value;
        } else if (option == "--samples") {
            folder = value;
        } else {
            set_tolerance(report, value);
        }
    }
    int compared = 0;
    for (const char* sample : {@{recording.runs | map("quoted") | join(", ")}}) {
        const cv::FileStorage file(folder + "/" + sample + ".yml.gz", cv::FileStorage::READ);
        if (!file.isOpened()) {
            std::cerr << folder << "/" << sample << ".yml.gz can't be read\n";
            return 2;
        }
        for (const Case& each : cases) {
            if (!only.empty() && only != each.name) {
                continue;
            }
            ++compared;
            report.begin(each.name, sample);
            try {
                each.run(file.root(), report);
            } catch (const std::exception& error) {
                report.fail(error.what());
            }
        }
    }
    if (compared == 0) {
        std::cerr << "nothing was compared: there is no function " << only << "; there are";
        for (const Case& each : cases) {
            std::cerr << " " << each.name;
        }
        std::cerr << "\n";
        return 2;
    }
{% if opencv_version %}
    if (report.differs) {
        std::cout << "recorded with OpenCV @{opencv_version}, this is OpenCV " << CV_VERSION << "\n";
    }
{% endif %}
    return report.failed == 0 ? 0 : 1;
}

}  // namespace

int main(int count, char** arguments) {
    try {
        return run(count, arguments);
    } catch (const std::exception& error) {
        std::cerr << error.what() << "\n";
        return 2;
    }
}
{% endfilter %}
