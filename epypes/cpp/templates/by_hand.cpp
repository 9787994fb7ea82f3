{% if text %}
@{text}
{% else %}
// The functions that are written by hand. EPypes changes nothing here: it adds what is missing at the end.
#include <stdexcept>

#include <opencv2/opencv.hpp>

#include "graph.hpp"
{% endif %}
{% for function in added %}

namespace @{ns} {

// By hand: @{function.reason_with_line}
//
{% for line in function.source.splitlines() %}
@{("//     " ~ line).rstrip()}
{% endfor %}
@{function.returns} @{function.name}(
{%- for kind, name in function.parameters %}@{kind} /*@{name}*/@{", " if not loop.last}{% endfor -%}
) {
    throw std::logic_error(@{(function.name ~ " is still to be written by hand: see " ~ by_hand) | quoted});
}

}  // namespace @{ns}
{% endfor %}
