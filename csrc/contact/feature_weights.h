#pragma once

#include <algorithm>
#include <array>
#include <vector>

#include "common/types.h"
#include "contact/collision_mesh.h"

namespace diffcloth::contact {

/// Weights of the features of a surface in its contact with a point or an edge.
///
/// A point interacts with every feature of the other surface (its closed faces, edges and vertices):
///
///   sum over features of w b(D(p, feature)),   w = 1                                 of a face,
///                                                  1 - n_f                           of an edge,
///                                                  1 - n_f + sum_e (n_f(e) - 1)      of a vertex,
///
/// with n_f the number of faces at the feature. The weights of features that share their nearest point
/// then sum to one for the nearest feature of the surface, and, above a flat or convex surface, to zero
/// for all others: the sum does not depend on the triangulation.
///
/// Edges and vertices of bodies act by themselves only if a cloth can rest on them. `edge_sharpness` s_e
/// and `vertex_sharpness` s_v measure this between 0 (flat, hollow) and 1:
///
///   s_e = clip(2 theta / pi) smoothstep(theta max(1, L / h_e)),
///   s_v = clip(2 Omega / pi) smoothstep(sqrt(Omega) max(1, L / sqrt(A_v))),
///
/// with the exterior dihedral angle theta (pi at a boundary), the width h_e of the faces at an edge, the
/// solid angle Omega of the normals at a vertex, its area A_v, and the mean edge length L of the cloth.
/// The sign of theta matters on closed parts whose faces are oriented outward; elsewhere (open, inward
/// or inconsistently oriented parts) its absolute value is used.
///
/// Between two bodies every corner and every ridge acts, with the areas A_v and A_e of FeatureAreas,
/// limited by the area of the other body or ridge, and a ridge with its angle, s = clip(2 theta / pi):
///
///   corner v of body a against body b:    w = min(A_v, area of b) / 4,
///   ridges c and e of two bodies:         w = s_c s_e min(A_c, A_e) / 2,
///
/// so that the forces between bodies do not depend on either triangulation.
///
/// Against the skeleton of a round body, a point p or a segment e = pq, a cloth has the same pressure as
/// against a face, regardless of its triangulation. The triangles lie across the round body as chords,
/// and touch it with their interior; all together have
///
///   faces f against the points:     w = A_f / 4   times b(D(p, f))           and the same with q,
///   edges c against the segment:    w = A_c / 4   times m(c, e) [b(D(c, e)) - b(D(c, p)) - b(D(c, q))],
///
/// The second line is zero beyond the ends; between them it replaces the first line. Per face the energy
/// is at least a sum of m b(D(c, e)), because no edge is nearer to a point than the face. Against
/// meshes, and against other skeletons, the ends of a skeleton are corners and the segment is a ridge.
/// Between a sphere and another skeleton only the center of one sphere acts.
///
/// All weights are constants, computed once from the rest meshes. Sharpnesses are rounded to single
/// precision, so that sums of a few of their products are exact, and cancel exactly.
class FeatureWeights {
 public:
  /// Weights w of the features that contribute to a sum.
  struct Features {
    std::vector<char> counts;   ///< [faces] true if the face contributes
    std::vector<Index> edge;    ///< [edges] 1 - n_f
    std::vector<Index> vertex;  ///< [vertices] 1 - n_f + sum_e (n_f(e) - 1)
  };

  /// @param X           rest positions, 3 * vertex_count; each surface may be in its own frame
  /// @param prescribed  [vertices] true if the motion of the vertex is prescribed
  FeatureWeights(const CollisionMesh& mesh, const double* X, const std::vector<char>& prescribed);

  /// Features that act on a point, by whether its motion is prescribed. Cloth faces with only prescribed
  /// corners act on free points alone.
  const Features& features(bool prescribed_point) const {
    return prescribed_point ? free_features_ : all_features_;
  }

  /// Three vertices of a body, far from each other, that define its orientation.
  const std::array<Index, 3>& carriers(Index surface) const {
    return carriers_[surface - cloth_count_];
  }

  /// s_e of a body's edge against a cloth.
  double edge_sharpness(Index cloth, Index e) const {
    return edge_sharpness_[cloth * body_edge_count_ + (e - cloth_edge_count_)];
  }
  /// s_v of a body's vertex against a cloth.
  double vertex_sharpness(Index cloth, Index v) const {
    return vertex_sharpness_[cloth * body_vertex_count_ + (v - cloth_vertex_count_)];
  }
  /// Continuation of a body's edge by another sharp edge at its end 0 or 1, between 0 and 1: smoothstep
  /// of (-u1 . u2 - 1/2) / 0.4, with unit vectors u from the end. 0 for edges of cloths.
  double continuation(Index e, int end) const {
    return e < cloth_edge_count_ ? 0.0 : continuation_[e - cloth_edge_count_][end];
  }

  /// Fraction of an end's contribution that does not belong to a body's edge e itself, against an edge
  /// c: half of the continuation. For the segment of a round body: 1 against cloths, because their faces
  /// are paired with the ends, else 0.
  double end_share(bool against_cloth, Index e, int end) const {
    if (e >= cloth_edge_count_ && is_axis_[e - cloth_edge_count_] != 0)
      return against_cloth ? 1.0 : 0.0;
    return 0.5 * continuation(e, end);
  }

  /// min(A_v, area of the surface) of a body's vertex against another body [m^2].
  double vertex_area(Index v, Index surface) const {
    return std::min(vertex_area_[v - cloth_vertex_count_], surface_area_[surface]);
  }
  /// s_c s_e min(A_c, A_e) of the edges of two bodies [m^2].
  float edge_pair_area(Index c, Index e) const {
    const Edge& p = body_edges_[c - cloth_edge_count_];
    const Edge& q = body_edges_[e - cloth_edge_count_];
    return static_cast<float>(double{p.sharpness} * q.sharpness * std::min(p.area, q.area));
  }

 private:
  /// A body's edge in contact with other bodies.
  struct Edge {
    float sharpness;
    float area;  ///< [m^2]
  };

  Index cloth_count_;
  Index cloth_edge_count_;
  Index cloth_vertex_count_;
  Index body_edge_count_;
  Index body_vertex_count_;
  Features all_features_;
  Features free_features_;                          // without prescribed cloth faces
  std::vector<std::array<Index, 3>> carriers_;      // [bodies]
  std::vector<float> edge_sharpness_;               // [cloths * body edges]
  std::vector<float> vertex_sharpness_;             // [cloths * body vertices]
  std::vector<std::array<float, 2>> continuation_;  // [body edges]
  std::vector<Edge> body_edges_;                    // [body edges]
  std::vector<char> is_axis_;                       // [body edges] segments of round bodies
  std::vector<float> vertex_area_;                  // [body vertices]
  std::vector<float> surface_area_;                 // [surfaces]
};

}  // namespace diffcloth::contact
