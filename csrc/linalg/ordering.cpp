#include "linalg/ordering.h"

#include <stdexcept>

#include <Eigen/OrderingMethods>
#include <Eigen/SparseCore>

#include "linalg/nested_dissection.h"

namespace diffcloth::linalg {

namespace {

/// Graph size from which nested dissection saves more than it costs.
constexpr Index kLargeGraph = 5000;

}  // namespace

const char* name(Ordering ordering) {
  switch (ordering) {
    case Ordering::kAutomatic:
      return "automatic";
    case Ordering::kMinimumDegree:
      return "minimum degree";
    case Ordering::kNestedDissection:
      return "nested dissection";
  }
  throw std::invalid_argument("unknown ordering");
}

std::vector<Index> fill_reducing_order(const Graph& graph, Ordering ordering) {
  const bool dissect = ordering == Ordering::kNestedDissection ||
                       (ordering == Ordering::kAutomatic && graph.size() >= kLargeGraph);
  return dissect ? nested_dissection_order(graph) : minimum_degree_order(graph);
}

std::vector<Index> minimum_degree_order(const Graph& graph) {
  const Index n = graph.size();
  std::vector<Index> order(n);
  if (n == 0) return order;
  // Eigen's AMD treats nodes without a diagonal entry as dense ones, which come last.
  std::vector<Index> start(graph.start);
  std::vector<Index> row;
  row.reserve(graph.neighbor.size() + order.size());
  for (Index k = 0; k < n; ++k) {
    start[k] += k;
    row.push_back(k);
    row.insert(row.end(), graph.neighbor.begin() + graph.start[k],
               graph.neighbor.begin() + graph.start[k + 1]);
  }
  start[n] += n;
  const std::vector<double> values(row.size(), 0.0);
  const Eigen::Map<const Eigen::SparseMatrix<double, Eigen::ColMajor, Index>> matrix(
      n, n, static_cast<Index>(row.size()), start.data(), row.data(), values.data());
  Eigen::PermutationMatrix<Eigen::Dynamic, Eigen::Dynamic, Index> permutation;
  Eigen::AMDOrdering<Index>()(matrix.selfadjointView<Eigen::Lower>(), permutation);
  for (Index k = 0; k < n; ++k) order[k] = permutation.indices()[k];
  return order;
}

}  // namespace diffcloth::linalg
