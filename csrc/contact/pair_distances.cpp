#include "contact/pair_distances.h"

#include <algorithm>

#include "contact/separation_lanes.h"

namespace diffcloth::contact {

std::ptrdiff_t first_of_edges(const std::vector<Candidate>& pairs) {
  const auto is_of_point = [](const Candidate& pair) { return pair.kind != PairKind::kEdgeEdge; };
  return std::ranges::partition_point(pairs, is_of_point) - pairs.begin();
}

std::vector<double> distances_sq(const std::vector<Candidate>& pairs, const double* x) {
  static const SquaredDistances measure = squared_distances(linalg::chosen_level());
  constexpr std::ptrdiff_t kStride = sizeof(Candidate) / sizeof(Index);
  static_assert(sizeof(Candidate) % sizeof(Index) == 0);
  std::vector<double> result(pairs.size());
  const auto run = [&](std::ptrdiff_t first, std::ptrdiff_t last) {
    if (first == last) return;
    const Candidate& head = pairs[first];
    measure(head.kind == PairKind::kEdgeEdge, x, head.vertices.data(), kStride, last - first,
            result.data() + first);
  };
  const std::ptrdiff_t middle = first_of_edges(pairs);
  run(0, middle);
  run(middle, static_cast<std::ptrdiff_t>(pairs.size()));
  return result;
}

}  // namespace diffcloth::contact
