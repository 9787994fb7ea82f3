// @{mark}
#include "tokens.hpp"
{% if has_served_arrays %}
#include "arrays.hpp"
{% endif %}

namespace service::tokens {

const std::vector<std::string> inputs = {
{% for token in settings.inputs %}
    @{token | quoted},
{% endfor %}
};
const std::vector<std::string> outputs = {
{% for token in settings.outputs %}
    @{token | quoted},
{% endfor %}
};
const std::vector<std::vector<std::string>> inputs_of_functions = {
{% for name in cg.functions %}
    {@{cg.func_inputs(name) | map("quoted") | join(", ")}},
{% endfor %}
};
const char* const hyperparameters = R"json({
{% for name, entry in entries.items() %}
 @{name | json}: @{entry | json}@{"," if not loop.last}
{% endfor %}
})json";
const char* const func_io = R"json({
{% for name in cg.functions %}
 @{name | json}: @{cg.func_io[name] | json}@{"," if not loop.last}
{% endfor %}
})json";

Inputs read_inputs([[maybe_unused]] const Reader& reader) {
    const std::vector<const Value*> values = reader.parts(inputs);
    Inputs found;
{% for token in inputs %}
    found.@{token.name} = @{token | reading("*values[" ~ loop.index0 ~ "]")};
{% endfor %}
    return found;
}

void write_outputs(const Outputs& outputs, epypes::v1::Envelope& answer, [[maybe_unused]] Writer& writer) {
    const auto part = [&answer](const char* name) -> Value& {
        auto& added = *answer.add_parts();
        added.set_name(name);
        return *added.mutable_value();
    };
{% for token in outputs %}
    @{token | writing}
{% endfor %}
}

}  // namespace service::tokens
