// @MARK@
#include "tokens.hpp"
@INCLUDES@
namespace service::tokens {

const std::vector<std::string> inputs = {
@INPUTS@};
const std::vector<std::string> outputs = {
@OUTPUTS@};
const std::vector<std::vector<std::string>> inputs_of_functions = {
@INPUTS_OF_FUNCTIONS@};
const char* const hyperparameters = @HYPERPARAMETERS@;
const char* const func_io = @FUNC_IO@;

Inputs read_inputs([[maybe_unused]] const Reader& reader) {
    const std::vector<const Value*> values = reader.parts(inputs);
    Inputs found;
@READ@    return found;
}

void write_outputs(const Outputs& outputs, epypes::v1::Envelope& answer, [[maybe_unused]] Writer& writer) {
    const auto part = [&answer](const char* name) -> Value& {
        auto& added = *answer.add_parts();
        added.set_name(name);
        return *added.mutable_value();
    };
@WRITE@}

}  // namespace service::tokens
