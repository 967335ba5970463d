#pragma once

#include <vector>

#include "linalg/graph.h"

namespace diffcloth::linalg {

/// Nodes in the order in which elimination should fill little: order[k] is the k-th.
std::vector<Index> fill_reducing_order(const Graph& graph);

/// Approximate minimum degree.
std::vector<Index> minimum_degree_order(const Graph& graph);

}  // namespace diffcloth::linalg
