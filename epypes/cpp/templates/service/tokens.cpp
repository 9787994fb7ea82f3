{# How an event brings a value of a type: an expression. #}
{% macro read(kind, value, token) -%}
    {% set where = token.token | quoted -%}
    {% if kind is Int -%}
        reader.integer(@{value}, @{where})
    {%- elif kind is Plain and kind.name in readers -%}
        reader.@{readers[kind.name]}(@{value}, @{where})
    {%- elif kind is Plain -%}
        reader.scalar<@{kind.cpp}>(@{value}, @{where})
    {%- elif kind is ArrayType and kind.is_mat -%}
        {% set order = "Order::" ~ settings.order(token.token) -%}
        @{"(" ~ value ~ ").has_none() ? cv::Mat() : " if kind.is_nullable -}
        reader.array(@{value}, @{where}, @{depths.get(kind.dtype, -1)}, @{[kind.ndim, 0] | max}, @{kind.channels}, @{order})
    {%- elif kind is ArrayType -%}
        read_array<@{elements[kind.dtype]}, @{kind.ndim}>(reader, @{value}, @{where})
    {%- elif kind is ListType and kind.item is RecordType -%}
        reader.@{records[kind.item.name]}(@{value}, @{where})
    {%- elif kind is ListType -%}
        reader.list(@{value}, @{where}, [&](const Value& item) { return @{read(kind.item, "item", token)}; })
    {%- elif kind is TupleType -%}
        [&](const Value& of) { const auto& items = reader.items(of, @{where}, @{kind.items | length}); return @{kind.cpp}(
        {%- for item in kind.items -%}
            @{read(item, "items[" ~ loop.index0 ~ "]", token)}@{", " if not loop.last}
        {%- endfor -%}
        ); }(@{value})
    {%- elif kind is OptionalType -%}
        (@{value}).has_none() ? @{kind.cpp}() : @{kind.cpp}(@{read(kind.item, value, token)})
    {%- endif %}
{%- endmacro %}
{# How an answer carries a value of a type: a statement. #}
{% macro write(kind, target, value, token) -%}
    {% if kind is Int -%}
        @{target}.set_integer(@{value});
    {%- elif kind is Plain and kind.name == "None" -%}
        @{target}.set_none(true);
    {%- elif kind is Plain and kind.name in readers -%}
        @{target}.set_@{readers[kind.name]}(@{value});
    {%- elif kind is Plain -%}
        writer.scalar(@{target}, @{value});
    {%- elif kind is ArrayType and kind.is_mat -%}
        {% set axes = kind.ndim if kind.ndim > 0 else value ~ ".channels() > 1 ? 3 : 2" -%}
        {% set array = "writer.array(%s, %s, %s, Order::%s);" % (target, value, axes, settings.order(token.token)) -%}
        {% if kind.is_nullable -%}
            if (@{value}.empty()) { @{target}.set_none(true); } else { @{array} }
        {%- else -%}
            @{array}
        {%- endif %}
    {%- elif kind is ArrayType -%}
        write_array(writer, @{target}, @{value});
    {%- elif kind is ListType -%}
        {% set holder = "Holder::tuple" if kind.is_tuple else "Holder::list" -%}
        {% if kind.item is RecordType -%}
            writer.@{records[kind.item.name]}(@{target}, @{value}, @{holder});
        {%- else -%}
            writer.list(@{target}, @{value}, @{holder}, [&](Value& item, const auto& each) { @{write(kind.item, "item", "each", token)} });
        {%- endif %}
    {%- elif kind is TupleType -%}
        { const auto& of = @{value}; auto& items = *@{target}.mutable_tuple();
        {%- for item in kind.items %} @{write(item, "(*items.add_items())", "std::get<" ~ loop.index0 ~ ">(of)", token)}{% endfor %} }
    {%- elif kind is OptionalType -%}
        if (@{value}) { @{write(kind.item, target, "(*" ~ value ~ ")", token)} } else { @{target}.set_none(true); }
    {%- endif %}
{%- endmacro %}
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
    found.@{token.name} = @{read(token.type, "*values[" ~ loop.index0 ~ "]", token)};
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
    @{write(token.type, "part(" ~ token.token | quoted ~ ")", "outputs." ~ token.name, token)}
{% endfor %}
}

}  // namespace service::tokens
