#pragma once

#include <cstdint>
#include <vector>

#include "linalg/graph.h"

namespace diffcloth::linalg {

/// Algorithm of the fill-reducing order.
enum class Ordering : std::uint8_t {
  kAutomatic,        ///< minimum degree on small graphs, nested dissection on large ones
  kMinimumDegree,    ///< approximate minimum degree
  kNestedDissection  ///< nested dissection down to small parts
};

const char* name(Ordering ordering);

/// Fill-reducing elimination order: order[k] is the k-th node.
std::vector<Index> fill_reducing_order(const Graph& graph,
                                       Ordering ordering = Ordering::kAutomatic);

/// Approximate minimum degree.
std::vector<Index> minimum_degree_order(const Graph& graph);

}  // namespace diffcloth::linalg
