#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "common/types.h"
#include "contact/broad_phase.h"
#include "contact/collision_mesh.h"
#include "contact/feature_weights.h"

namespace diffcloth::contact {

/// One term of the action of a surface on a point or an edge: a coefficient times m b(D).
struct Term {
  /// If the nearest feature is an edge or a vertex, corners repeat ({p, e0, e1, e1}, {p, v, v, v}, {c0,
  /// c1, v, v}, {u, u, e0, e1}), so that irrelevant corners are not part of the pair, and b is -1.
  Candidate pair;
  double coefficient;
  double d_sq;  ///< [m^2]
  /// For each edge of an edge-edge pair: 0 or 1 if D is the distance of that end, -1 if D is the
  /// distance of the whole edge. The mollifier always refers to the two edges.
  std::array<std::int8_t, 2> ends = {-1, -1};
};

/// Scratch lists of the functions below, reused to avoid allocation.
struct MergeScratch {
  struct NearEdge {
    Index edge;
    Index vertex;  ///< The nearest end, or -1 inside the edge.
    double d_sq;
  };
  /// Contribution of a feature to the sum, before contributions of one feature merge.
  struct Part {
    std::int8_t kind;  ///< identifies the feature, with id and ends
    std::array<std::int8_t, 2> ends;
    Index id;
    double coefficient;
    double d_sq;
  };
  std::vector<Index> faces;
  std::vector<NearEdge> edges;
  std::vector<Index> vertices;
  std::vector<Part> parts;
};

/// Terms of a point against a surface. Terms with the same nearest feature are merged, and terms with
/// coefficient zero are dropped: see FeatureWeights.
///
/// @param features  features of the surface that act on the point
/// @param group     candidates of one point and one surface
/// @param range     terms of a larger distance are left out [m]
/// @param out       appended to, in the order of the features
void add_point_terms(const CollisionMesh& mesh,
                     const FeatureWeights::Features& features,
                     std::span<const Candidate> group,
                     const double* x,
                     double range,
                     double scale,
                     MergeScratch& scratch,
                     std::vector<Term>& out);

/// Terms of an edge c against the sharp edges e of a body,
///
///   w_ce m(c, e) [b(D(c, e)) - 1/2 sum over the ends v of e of gamma_ev b(D(c, v))],
///
/// so that an edge that is cut into pieces acts as one: pieces that continue each other meet in a
/// vertex, and each has half of it. Terms at one vertex that are not mollified merge. If c is an edge of
/// a body too, b(D(c, .)) is likewise replaced by b(D(c, .)) - 1/2 sum over its ends u of gamma_cu
/// b(D(u, .)).
///
/// @param group           candidates of one edge and one body
/// @param edge_length_sq  [edges] of the rest shapes [m^2], for the mollifier
void add_edge_terms(const CollisionMesh& mesh,
                    const FeatureWeights& weights,
                    std::span<const Candidate> group,
                    std::span<const double> edge_length_sq,
                    const double* x,
                    double range,
                    double scale,
                    MergeScratch& scratch,
                    std::vector<Term>& out);

/// Merge the terms that begin with an end of an edge, {u, u, ...}: edges that continue each other share
/// the end, but are different groups. The merged terms are moved to the end, in the order of their
/// corners; terms that cancel are dropped.
void merge_shared_ends(std::vector<Term>& terms);

}  // namespace diffcloth::contact
