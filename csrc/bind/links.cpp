#include "bind/links.h"

#include <cstddef>
#include <span>
#include <stdexcept>
#include <utility>

namespace diffcloth::bind {

std::vector<bodies::Link> to_links(const LinkArrays& arrays, Index coordinates) {
  const std::size_t count = arrays.tree.size();
  for (const std::size_t size : {arrays.parent.size(), arrays.kind.size(), arrays.coordinate.size(),
                                 arrays.multiplier.size(), arrays.constant.size()}) {
    if (size != count) throw std::invalid_argument("trees: arrays must have one entry a link");
  }
  if (arrays.offset.size() != 16 * count || arrays.axis.size() != 3 * count) {
    throw std::invalid_argument("trees: arrays must have one entry a link");
  }
  const std::span<const bodies::JointKind> kinds = bodies::joint_kinds();
  std::vector<bodies::Link> links;
  for (std::size_t l = 0; l < count; ++l) {
    const Index kind = arrays.kind[l];
    const Index coordinate = arrays.coordinate[l];
    const bool known = kind >= 0 && std::cmp_less(kind, kinds.size());
    // The coordinate of a moving joint is read without a check later.
    if (!known || coordinate >= coordinates || (kinds[kind].moves() && coordinate < 0)) {
      throw std::invalid_argument("trees: kinds and coordinates must be in range");
    }
    const Eigen::Matrix<double, 4, 4, Eigen::RowMajor> frame(arrays.offset.data() + 16 * l);
    links.push_back({.tree = arrays.tree[l],
                     .parent = arrays.parent[l],
                     .kind = kinds[kind],
                     .offset = frame.topRows<3>(),
                     .axis = row(arrays.axis.data(), static_cast<Index>(l)),
                     .coordinate = coordinate,
                     .multiplier = arrays.multiplier[l],
                     .constant = arrays.constant[l]});
  }
  return links;
}

}  // namespace diffcloth::bind
