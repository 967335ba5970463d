#pragma once

#include <vector>

#include "linalg/graph.h"

namespace diffcloth::linalg {

/// Nodes in the order of a nested dissection: two halves first, then their separator, recursively until
/// minimum degree is used. On the graphs of large surfaces the fill is smaller than by minimum degree
/// alone, at a higher cost of the ordering.
std::vector<Index> nested_dissection_order(const Graph& graph);

}  // namespace diffcloth::linalg
