#include "contact/feature_weights.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "contact/feature_areas.h"
#include "contact/rest_measures.h"
#include "contact/sharpness.h"

namespace diffcloth::contact {
namespace {

/// Sharpness of the segment of a round body: it gives edges a quarter of their area, the weight of
/// vertices against a face.
constexpr float kOfAxis = 0.5F;

double smoothstep(double t) {
  const double u = std::clamp(t, 0.0, 1.0);
  return u * u * (3.0 - 2.0 * u);
}

/// @param angle  dihedral angle, or square root of the solid angle [rad]
/// @param share  sharpness before clipping and smoothing
/// @param ratio  the cloth's edge length over the width of the feature
float sharpness(double angle, double share, double ratio) {
  if (angle == 0.0) return 0.0F;
  return static_cast<float>(std::clamp(share, 0.0, 1.0) * smoothstep(angle * std::max(1.0, ratio)));
}

/// [cloths] mean length of the edges.
std::vector<double> mean_edge_length(const CollisionMesh& mesh, const RestMeasures& rest) {
  std::vector<double> length(mesh.cloth_count, 0.0);
  std::vector<Index> count(mesh.cloth_count, 0);
  for (Index e = 0; e < mesh.cloth_edge_count; ++e) {
    length[mesh.edge_surface[e]] += std::sqrt(rest.edge_length_sq[e]);
    ++count[mesh.edge_surface[e]];
  }
  for (Index s = 0; s < mesh.cloth_count; ++s) length[s] /= std::max(count[s], 1);
  return length;
}

/// Continuation by another sharp edge, at both ends of every body edge.
std::vector<std::array<float, 2>> continuations(const CollisionMesh& mesh,
                                                const double* X,
                                                const std::vector<double>& edge_angle) {
  struct End {
    Index edge;
    int end;
    Vec3 away;
  };
  std::vector<std::vector<End>> ends(mesh.vertex_count - mesh.cloth_vertex_count);
  for (auto e = mesh.cloth_edge_count; e < static_cast<Index>(mesh.edges.size()); ++e) {
    if (edge_angle[e] == 0.0) continue;
    const auto& [i, j] = mesh.edges[e];
    const Vec3 along = (row(X, j) - row(X, i)).normalized();
    ends[i - mesh.cloth_vertex_count].push_back({.edge = e, .end = 0, .away = along});
    ends[j - mesh.cloth_vertex_count].push_back({.edge = e, .end = 1, .away = -along});
  }
  std::vector<std::array<float, 2>> result(mesh.edges.size() - mesh.cloth_edge_count, {0.0F, 0.0F});
  for (const std::vector<End>& at_vertex : ends) {
    for (const End& p : at_vertex) {
      double straightest = -1.0;
      for (const End& q : at_vertex) {
        if (q.edge != p.edge) straightest = std::max(straightest, -p.away.dot(q.away));
      }
      result[p.edge - mesh.cloth_edge_count][p.end] =
          static_cast<float>(smoothstep((straightest - 0.5) / 0.4));
    }
  }
  return result;
}

/// Feature weights of all faces, except cloth faces whose corners are all left out.
FeatureWeights::Features count_features(const CollisionMesh& mesh,
                                        const std::vector<char>& left_out) {
  FeatureWeights::Features w{.counts = std::vector<char>(mesh.faces.size(), 1),
                             .edge = std::vector<Index>(mesh.edges.size(), 1),
                             .vertex = std::vector<Index>(mesh.vertex_count, 1)};
  for (std::size_t f = 0; f < mesh.faces.size(); ++f) {
    const CollisionMesh::Face& face = mesh.faces[f];
    if (static_cast<Index>(f) < mesh.cloth_face_count) {
      w.counts[f] = std::ranges::any_of(face, [&](Index v) { return left_out[v] == 0; });
    }
    if (w.counts[f] == 0 || mesh.is_round_face(static_cast<Index>(f))) continue;
    for (const Index e : mesh.face_edges[f]) --w.edge[e];
    for (const Index v : face) --w.vertex[v];
  }
  // n_f - 1 of every edge that has faces is -edge.
  for (std::size_t e = 0; e < mesh.edges.size(); ++e) {
    if (w.edge[e] == 1) continue;
    for (const Index v : mesh.edges[e]) w.vertex[v] -= w.edge[e];
  }
  return w;
}

/// For every body its first vertex, the vertex farthest from it, and the vertex farthest from the line
/// through both.
std::vector<std::array<Index, 3>> carriers_of_bodies(const CollisionMesh& mesh, const double* X) {
  std::vector<std::array<Index, 3>> result;
  // Among equidistant vertices the first is chosen, whatever the rounding of a frame or unit.
  constexpr double kClearly = 1.0 + 1e-9;
  const auto farthest = [](Index first, Index last, auto&& distance_sq) {
    Index best = first;
    for (Index v = first + 1; v < last; ++v) {
      if (distance_sq(v) > kClearly * distance_sq(best)) best = v;
    }
    return best;
  };
  Index first = mesh.cloth_vertex_count;
  for (Index surface = mesh.cloth_count; surface < mesh.surface_count(); ++surface) {
    Index last = first;
    while (last < mesh.vertex_count && mesh.vertex_surface[last] == surface) ++last;
    const Vec3 a = row(X, first);
    const Index second =
        farthest(first, last, [&](Index v) { return (row(X, v) - a).squaredNorm(); });
    const Vec3 along = row(X, second) - a;
    const Index third =
        farthest(first, last, [&](Index v) { return along.cross(row(X, v) - a).squaredNorm(); });
    result.push_back({first, second, third});
    first = last;
  }
  return result;
}

}  // namespace

FeatureWeights::FeatureWeights(const CollisionMesh& mesh,
                               const double* X,
                               const std::vector<char>& prescribed)
    : cloth_count_(mesh.cloth_count),
      cloth_edge_count_(mesh.cloth_edge_count),
      cloth_vertex_count_(mesh.cloth_vertex_count),
      body_edge_count_(static_cast<Index>(mesh.edges.size()) - mesh.cloth_edge_count),
      body_vertex_count_(mesh.vertex_count - mesh.cloth_vertex_count),
      all_features_(count_features(mesh, std::vector<char>(mesh.vertex_count, 0))),
      free_features_(count_features(mesh, prescribed)),
      carriers_(carriers_of_bodies(mesh, X)) {
  const RestMeasures rest = measure(mesh, X);
  const Bulge angles = bulge(mesh, X);
  continuation_ = continuations(mesh, X, angles.edge);
  const FeatureAreas areas = feature_areas(mesh, X, angles);
  vertex_area_.assign(areas.vertex.begin() + mesh.cloth_vertex_count, areas.vertex.end());
  surface_area_.assign(areas.surface.begin(), areas.surface.end());
  for (auto e = static_cast<std::size_t>(mesh.cloth_edge_count); e < mesh.edges.size(); ++e) {
    const bool is_axis = mesh.is_round_edge(static_cast<Index>(e));
    is_axis_.push_back(is_axis ? 1 : 0);
    const double share =
        is_axis ? 1.0 : std::clamp(2.0 * angles.edge[e] / std::numbers::pi, 0.0, 1.0);
    body_edges_.push_back(
        {.sharpness = static_cast<float>(share), .area = static_cast<float>(areas.edge[e])});
  }
  for (const double length : mean_edge_length(mesh, rest)) {
    for (auto e = mesh.cloth_edge_count; e < static_cast<Index>(mesh.edges.size()); ++e) {
      if (mesh.is_round_edge(e)) {
        edge_sharpness_.push_back(kOfAxis);
        continue;
      }
      const double width = 2.0 * rest.edge_area[e] / std::sqrt(rest.edge_length_sq[e]);
      const double theta = angles.edge[e];
      edge_sharpness_.push_back(sharpness(theta, 2.0 * theta / std::numbers::pi, length / width));
    }
    for (Index v = mesh.cloth_vertex_count; v < mesh.vertex_count; ++v) {
      const double omega = angles.vertex[v];
      vertex_sharpness_.push_back(sharpness(std::sqrt(omega), 2.0 * omega / std::numbers::pi,
                                            length / std::sqrt(rest.vertex_area[v])));
    }
  }
}

}  // namespace diffcloth::contact
