#pragma once

#include <vector>

#include "linalg/graph.h"

namespace diffcloth::linalg {

/// Nodes in the order of a nested dissection: two halves first, then what separates them, and so in
/// each half until minimum degree takes over. It fills less than minimum degree alone on the graphs
/// of large surfaces, and costs more to find.
std::vector<Index> nested_dissection_order(const Graph& graph);

}  // namespace diffcloth::linalg
