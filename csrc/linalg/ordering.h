#pragma once

#include <cstdint>
#include <vector>

#include "linalg/graph.h"

namespace diffcloth::linalg {

/// How an order that fills little is found.
enum class Ordering : std::uint8_t {
  kAutomatic,        ///< minimum degree on small graphs, nested dissection on large ones
  kMinimumDegree,    ///< approximate minimum degree
  kNestedDissection  ///< nested dissection down to small parts
};

const char* name(Ordering ordering);

/// Nodes in the order in which elimination should fill little: order[k] is the k-th.
std::vector<Index> fill_reducing_order(const Graph& graph,
                                       Ordering ordering = Ordering::kAutomatic);

/// Approximate minimum degree.
std::vector<Index> minimum_degree_order(const Graph& graph);

}  // namespace diffcloth::linalg
