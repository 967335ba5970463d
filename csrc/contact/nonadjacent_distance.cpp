#include "contact/nonadjacent_distance.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>
#include <vector>

#include "contact/broad_phase.h"
#include "contact/distance/separation.h"

namespace diffcloth::contact {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

/// One cloth of a mesh with self-contact; vertices keep their order.
struct Cloth {
  CollisionMesh mesh;
  std::vector<double> x;
};

Cloth one_cloth(const CollisionMesh& mesh, Index surface, const double* x) {
  const auto& owner = mesh.vertex_surface;
  const auto first = std::lower_bound(owner.begin(), owner.end(), surface) - owner.begin();
  const auto last = std::upper_bound(owner.begin(), owner.end(), surface) - owner.begin();
  std::vector<CollisionMesh::Face> faces;
  for (std::size_t f = 0; f < mesh.faces.size(); ++f) {
    if (mesh.face_surface[f] != surface) continue;
    faces.push_back(mesh.faces[f]);
    for (Index& v : faces.back()) v -= static_cast<Index>(first);
  }
  SurfacePairs itself(1);
  itself.set(0, 0, true);
  return {.mesh = CollisionMesh(std::move(faces), std::vector<Index>(last - first, 0), 1,
                                std::move(itself)),
          .x = std::vector<double>(x + 3 * first, x + 3 * last)};
}

double mean_edge_length(const Cloth& cloth) {
  double sum = 0;
  for (const auto& [i, j] : cloth.mesh.edges) {
    sum += (row(cloth.x.data(), i) - row(cloth.x.data(), j)).norm();
  }
  return sum / static_cast<double>(cloth.mesh.edges.size());
}

double diameter_bound(const Cloth& cloth) {
  const auto [lo, hi] = std::minmax_element(cloth.x.begin(), cloth.x.end());
  return std::numbers::sqrt3 * (*hi - *lo);
}

/// Increase the search radius until a pair is found; the distance of that pair, as the next radius,
/// cannot miss the smallest.
double smallest_distance(const Cloth& cloth) {
  if (cloth.mesh.edges.empty()) return kInfinity;
  const BroadPhase broad_phase(cloth.mesh, cloth.x.data());
  BroadPhase::Scratch scratch;
  std::vector<Candidate> candidates;
  const double largest = diameter_bound(cloth);
  double radius = std::max(0.25 * mean_edge_length(cloth), 1e-3 * largest);
  while (true) {
    const std::array<double, 1> reach{0.5 * radius};
    broad_phase.find(cloth.x.data(), cloth.x.data(), reach, scratch, candidates);
    double smallest_sq = kInfinity;
    for (const Candidate& candidate : candidates) {
      Corners corners;
      for (int i = 0; i < 4; ++i) corners[i] = row(cloth.x.data(), candidate.vertices[i]);
      smallest_sq = std::min(smallest_sq, distance_sq(candidate.kind, corners));
    }
    const double smallest = std::sqrt(smallest_sq);
    if (smallest <= radius || !(radius < largest)) return smallest;
    radius = std::min(smallest, 2 * radius);
  }
}

}  // namespace

double smallest_nonadjacent_distance(const CollisionMesh& mesh, const double* x) {
  double smallest = kInfinity;
  for (Index surface = 0; surface < mesh.cloth_count; ++surface) {
    smallest = std::min(smallest, smallest_distance(one_cloth(mesh, surface, x)));
  }
  return smallest;
}

}  // namespace diffcloth::contact
