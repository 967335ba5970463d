#include "step/surface_groups.h"

#include <algorithm>
#include <numeric>

namespace diffcloth::step {

SurfaceGroups::SurfaceGroups(const Scene& scene)
    : scene_(scene),
      earlier_(static_cast<std::size_t>(scene.surface_count())),
      held_(earlier_.size(), 0) {
  std::iota(earlier_.begin(), earlier_.end(), Index{0});
}

void SurfaceGroups::connect(const std::vector<contact::Contact>& contacts) {
  const Index cloths = scene_.cloth_count();
  const auto moves = [&](Index s) {
    return s < cloths || scene_.mechanisms.is_dynamic(s - cloths);
  };
  for (const contact::Contact& k : contacts) {
    // The first corner is of the one side, the last of the other.
    const Index a = scene_.collision_mesh.vertex_surface[k.pair.vertices[0]];
    const Index b = scene_.collision_mesh.vertex_surface[k.pair.vertices[3]];
    if (moves(a) && moves(b)) {
      const Index i = find(a);
      const Index j = find(b);
      earlier_[std::max(i, j)] = std::min(i, j);
    } else {
      held_[a] = held_[b] = 1;
    }
  }
}

std::vector<Index> SurfaceGroups::numbers() const {
  std::vector<Index> result;
  std::vector<char> held(held_.size(), 0);
  for (Index s = 0; s < scene_.surface_count(); ++s) {
    result.push_back(find(s));
    if (held_[s] != 0) held[result.back()] = 1;
  }
  for (Index& number : result) {
    if (held[number] != 0) number = -1 - number;
  }
  return result;
}

Index SurfaceGroups::find(Index surface) const {
  while (earlier_[surface] != surface) surface = earlier_[surface];
  return surface;
}

}  // namespace diffcloth::step
