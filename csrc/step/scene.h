#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "bodies/mechanisms.h"
#include "bodies/pose.h"
#include "contact/broad_phase.h"
#include "contact/collision_mesh.h"
#include "contact/contact_set.h"
#include "contact/feature_weights.h"
#include "contact/rest_measures.h"
#include "elastic/elastic.h"
#include "mesh/rest_shape.h"
#include "mesh/topology.h"
#include "projective/constant_matrix.h"
#include "projective/nodal_contact.h"
#include "solver/pattern_cache.h"
#include "solver/walk.h"

namespace diffcloth::step {

/// Schemes for a step.
enum class SchemeKind : std::uint8_t { kCoupled, kSplit, kProjective };

/// The integrators of `coupled`: see schemes/coupled.h and schemes/second_order.h.
enum class Integrator : std::uint8_t { kImplicitEuler, kSecondOrder };

/// Metric of the contact stage of `split`.
enum class Metric : std::uint8_t { kEnergy, kElastic, kMass, kIdentity };

/// Solvers of the elastic stage of `split` and `projective`.
enum class ElasticSolver : std::uint8_t { kNewton, kProjective };

/// A value that has a name in Python.
template <class Value>
struct Named {
  constexpr Named(const char* name_in, Value value_in) : name(name_in), value(value_in) {}

  const char* name;
  Value value;
};

/// A scheme: its name in Python and its capabilities.
struct SchemeRow {
  const char* name;
  SchemeKind value;
  bool has_barrier = true;         ///< if false, cloths touch bodies and each other at their nodes
  bool moves_bodies = false;       ///< cloths and dynamic bodies are solved together
  bool has_elastic_stage = false;  ///< elasticity is first solved alone, by one of kElasticSolvers
  bool has_metrics = false;        ///< nearness may be measured in each of kMetrics
};

/// All schemes in the order of SchemeKind, the default first.
inline constexpr std::array kSchemes{
    SchemeRow{.name = "coupled", .value = SchemeKind::kCoupled, .moves_bodies = true},
    SchemeRow{.name = "split",
              .value = SchemeKind::kSplit,
              .has_elastic_stage = true,
              .has_metrics = true},
    SchemeRow{.name = "projective",
              .value = SchemeKind::kProjective,
              .has_barrier = false,
              .has_elastic_stage = true},
};

/// All integrators, metrics and solvers, the defaults first.
inline constexpr std::array kIntegrators{
    Named<Integrator>{"implicit_euler", Integrator::kImplicitEuler},
    Named<Integrator>{"second_order", Integrator::kSecondOrder},
};
inline constexpr std::array kMetrics{
    Named<Metric>{"energy", Metric::kEnergy},
    Named<Metric>{"elastic", Metric::kElastic},
    Named<Metric>{"mass", Metric::kMass},
    Named<Metric>{"identity", Metric::kIdentity},
};
inline constexpr std::array kElasticSolvers{
    Named<ElasticSolver>{"newton", ElasticSolver::kNewton},
    Named<ElasticSolver>{"projective", ElasticSolver::kProjective},
};

/// Springs between points of cloths and bodies, or to targets: see elastic/springs.h.
struct AttachmentDescription {
  std::vector<Index> start{0};      ///< [A + 1] first point of each
  std::vector<Index> point;         ///< points of cloths, then of bodies
  std::vector<double> coefficient;  ///< coefficients of the points
  std::vector<double> rest_length;  ///< [A] [m]
  std::vector<Index> target_row;    ///< [A] row among the targets, -1: none
  Index target_count = 0;
};

/// Description of a scene and its options: the arguments of a simulator.
struct Description {
  std::vector<double> vertices;        ///< [3 N] initial positions [m]
  std::vector<double> rest_positions;  ///< [3 M] of the vertices of the rest mesh [m]
  /// [3 N] cloths at rest as they may be in space [m]: without seams the rest positions, else nearly
  std::vector<double> rest_embedding;
  std::vector<std::array<Index, 3>> faces;
  std::vector<std::array<Index, 3>> rest_faces;    ///< [F] see mesh::Topology
  std::vector<Index> cloth_vertex_start;           ///< [C + 1]
  std::vector<Index> cloth_face_start;             ///< [C + 1]
  std::vector<mesh::BendingModel> bending_models;  ///< [C]
  std::vector<double> material_axes;               ///< [2 F] see Scene; empty: no cloth is woven
  std::vector<Index> pins;                         ///< [P]
  std::vector<Index> soft_pins;                    ///< [Q]
  AttachmentDescription attachments;
  bodies::BodySet bodies;
  bodies::MechanismsDescription mechanisms;      ///< empty: every body is a tree of one link
  std::vector<std::array<Index, 3>> body_faces;  ///< indices into the bodies' vertices
  /// [surfaces of bodies] radii of round bodies, 0 for others; empty: all 0 [m]
  std::vector<double> body_radii;
  std::vector<std::array<Index, 2>> ignored_pairs;  ///< pairs of surfaces that never touch
  /// [surfaces of bodies] shapes of surfaces that cloths touch at their nodes, instead of by the
  /// barrier; empty: none
  std::vector<projective::Primitive> primitives;
  std::vector<std::string> surface_names;  ///< names in messages; empty: surfaces have numbers
  std::vector<std::string> pin_names;      ///< [P] group of each pin; empty: none
  bool self_contact = true;
  double dt = 0.01;
  SchemeKind scheme = SchemeKind::kCoupled;
  Integrator integrator = Integrator::kImplicitEuler;  ///< kSecondOrder: for kCoupled only
  Metric metric = Metric::kEnergy;
  ElasticSolver elastic = ElasticSolver::kNewton;
  int friction_iterations = 2;
  bool begins_at_state = false;  ///< solves begin at x_n, not at the inertial guess
  solver::Options options{};
};

/// Everything in a scene that is constant over steps. Immutable, except for caches.
struct Scene {
  explicit Scene(Description description);

  Index cloth_vertex_count() const { return topology.vertex_count; }
  Index rest_vertex_count() const { return topology.rest_vertex_count; }
  Index vertex_count() const { return collision_mesh.vertex_count; }
  Index cloth_count() const { return static_cast<Index>(given.bending_models.size()); }
  Index surface_count() const { return cloth_count() + given.bodies.count(); }
  Index point_count() const { return static_cast<Index>(prescribed.size()); }

  /// True if a spring is attached to a body.
  bool has_attached_bodies() const;

  const SchemeRow& scheme() const { return kSchemes[static_cast<std::size_t>(given.scheme)]; }

  Description given;
  mesh::Topology topology;
  std::vector<Index> face_cloth;    ///< [F]
  std::vector<Vec2> material_axes;  ///< [F] the warp in the rest frames; empty: no weft
  std::vector<Index> vertex_cloth;  ///< [N]
  mesh::BendingStencils stencils;
  mesh::RestShape rest;  ///< rest shape of given.rest_positions
  bodies::Mechanisms mechanisms;
  contact::CollisionMesh collision_mesh;
  std::vector<bodies::Mechanisms::FreeBody>
      free_bodies;                          ///< bodies without springs; surfaces of the scene
  double mean_edge;                         ///< mean edge of cloths at rest, else of bodies [m]
  std::vector<char> prescribed;             ///< [points] pins, bodies, ...: see solver::Coordinates
  contact::RestMeasures measures;           ///< measures of given.rest_embedding and the bodies
  contact::FeatureWeights feature_weights;  ///< likewise
  contact::BroadPhase broad_phase;
  std::vector<projective::FaceSearch> face_search;  ///< [surfaces of bodies] those that nodes touch
  projective::VertexSpheres vertex_spheres;         ///< if the scheme allows vertices to touch
  elastic::Slots slots;
  elastic::Elements held_elements;  ///< elements with a pinned corner

  mutable elastic::PreparedCache prepared;                    ///< models of `rest`
  mutable solver::PatternCache elastic_patterns;              ///< patterns over the elastic pattern
  mutable solver::PatternCache diagonal_patterns;             ///< patterns over isolated vertices
  mutable projective::ConstantMatrixCache constant_matrices;  ///< matrices over the elastic pattern
};

/// Rest quantities that weight contacts, for a rest shape of the cloths.
contact::RestMeasures rest_measures(const Scene& scene, const mesh::RestShape& rest);

/// Two primitives near each other, and their minimum distance [m].
struct ClosePair {
  double distance;
  double thickness;  ///< mean of both surfaces, plus the radii of round bodies
  contact::Candidate pair;
};

/// All pairs whose surfaces are within `reach` beyond their thickness, and some others.
///
/// @param thickness  [surfaces] [m]
std::vector<contact::Candidate> find_near(const Scene& scene,
                                          const double* x,
                                          const std::vector<double>& thickness,
                                          double reach,
                                          contact::BroadPhase::Scratch& scratch);

/// The candidate with the smallest gap up to `reach`.
std::optional<ClosePair> find_closest(const Scene& scene,
                                      const double* x,
                                      const std::vector<double>& thickness,
                                      double reach,
                                      const std::vector<contact::Candidate>& candidates);

/// "cloth 'shirt' vertex (4) and body 'table' face (0, 1, 3)".
std::string describe_pair(const Scene& scene, const contact::Candidate& pair);

/// "cloth 'shirt' (pins 'collar'), body 'table'": surfaces within `reach` beyond their thickness of
/// another primitive, including prescribed surfaces, and the pins among their vertices.
std::string describe_near(const Scene& scene,
                          const double* x,
                          const std::vector<double>& thickness,
                          double reach);

/// Description of two surfaces that overlap or are closer than their thickness; empty if there are none.
///
/// @param candidates  at least all pairs that are that close
std::string find_overlap(const Scene& scene,
                         const double* x,
                         const std::vector<double>& thickness,
                         const std::vector<contact::Candidate>& candidates,
                         contact::BroadPhase::Scratch& scratch);

}  // namespace diffcloth::step
