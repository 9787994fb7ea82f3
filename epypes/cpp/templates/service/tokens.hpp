// @{mark}
// The tokens of the graph: how events and answers carry them.
#pragma once

#include <string>
#include <vector>

#include "codec.hpp"
#include "graph.hpp"

namespace service::tokens {

using Graph = @{ns}::Graph;
using Hyperparameters = @{ns}::Hyperparameters;
using Inputs = @{ns}::Inputs;
using Outputs = @{ns}::Outputs;

/// Of the bundle that the graph was exported from.
inline constexpr const char* bundle = @{settings.name | quoted};
inline constexpr const char* digest = @{recording.bundle.digest | quoted};
inline constexpr const char* epypes_version = @{epypes_version | quoted};

extern const std::vector<std::string> inputs;
extern const std::vector<std::string> outputs;
/// The inputs of each function, in the order of Graph::functions.
extern const std::vector<std::vector<std::string>> inputs_of_functions;
/// JSON: the hyperparameters with their ranges; the functions with their inputs and outputs.
extern const char* const hyperparameters;
extern const char* const func_io;

/// Throws MessageError for an event that brings something else.
Inputs read_inputs(const Reader& reader);

void write_outputs(const Outputs& outputs, epypes::v1::Envelope& answer, Writer& writer);

}  // namespace service::tokens
