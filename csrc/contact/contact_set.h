#pragma once

#include <utility>
#include <vector>

#include "common/types.h"
#include "contact/barrier.h"
#include "contact/broad_phase.h"
#include "contact/collision_mesh.h"
#include "contact/distance/closest.h"
#include "potential/potential.h"

namespace diffcloth::contact {

/// Rest quantities that weigh contacts, for every vertex and edge of the collision mesh.
///
/// A vertex' or an edge's area is a third of its adjacent rest faces; a body's come from its mesh.
struct RestMeasures {
  std::vector<double> vertex_area;     ///< [vertices] m^2
  std::vector<double> edge_area;       ///< [edges] m^2
  std::vector<double> edge_length_sq;  ///< [edges] m^2
  std::vector<double> face_area;       ///< [cloth faces] m^2
};

/// What a contact's energy depends on besides positions and rest shape.
struct Parameters {
  double kappa;                   ///< barrier stiffness [Pa]
  double d_hat;                   ///< barrier distance [m]
  double slip;                    ///< eps_v h: displacement over a step where sliding begins [m]
  std::vector<double> thickness;  ///< [S] full thickness of each surface [m]
  std::vector<double> friction;   ///< [S * S]; a pair uses the mean of its two entries
};

/// A pair of primitives within reach, with everything its barrier needs.
struct Contact {
  Candidate pair;
  double weight;     ///< w [m^2]
  double threshold;  ///< eps of the edge-edge mollifier [m^4]; 0 for point-triangle
  double xi;         ///< half the sum of the two thicknesses [m]
  Closest closest;
  Barrier barrier;
  double mollifier;  ///< m
  bool mollified;    ///< m < 1: its derivatives count
};

/// Barrier contacts of one configuration: sum over pairs of kappa w m b(D; xi, d_hat)  [J].
///
/// Positions are those of the whole collision mesh, cloth first, then bodies: 3 doubles a vertex.
/// `prescribed` marks vertices whose motion is given (pins, bodies): pairs made of them alone carry
/// no energy.
class ContactModel {
 public:
  ContactModel(const CollisionMesh& mesh,
               const RestMeasures& rest,
               Parameters parameters,
               const std::vector<char>& prescribed);

  const Parameters& parameters() const { return parameters_; }
  const CollisionMesh& mesh() const { return mesh_; }

  /// Largest distance at which a pair can interact: d_hat + max xi [m].
  double reach() const { return reach_; }

  /// Half the sum of the thicknesses of a pair's surfaces [m].
  double xi(const Candidate& pair) const;

  /// Friction coefficient of a pair.
  double mu(const Candidate& pair) const;

  /// The candidates that are within range at x, in their order.
  void find(const std::vector<Candidate>& candidates,
            const double* x,
            std::vector<Contact>& out) const;

  /// Energy of each candidate at x [J]; +infinity where d <= xi.
  void energies(const std::vector<Candidate>& candidates,
                const double* x,
                std::vector<double>& out) const;

  /// g += grad B.
  void add_gradient(const std::vector<Contact>& contacts, const double* x, double* g) const;

  /// 12x12 Hessian of one contact; kPositive is its positive part, up to the mollifier's terms.
  Mat12 hessian(const Contact& contact, const double* x, Curvature curvature) const;

  /// y += H z over all vertices, exact.
  void add_hessian_product(const std::vector<Contact>& contacts,
                           const double* x,
                           const double* z,
                           double* y) const;

  /// Cotangents of what the energy depends on.
  struct Bar {
    double kappa = 0.0;
    double d_hat = 0.0;
    double slip = 0.0;
    std::vector<double> thickness;  ///< [S]
    std::vector<double> friction;   ///< [S * S]
    RestMeasures rest;

    Bar(const CollisionMesh& mesh, const RestMeasures& like);
  };

  /// bar += scale * d/d(theta) of z . grad B, for every theta of Bar.
  void add_mixed(const std::vector<Contact>& contacts,
                 const double* x,
                 const double* z,
                 double scale,
                 Bar& bar) const;

  /// Pull cotangents of a pair's weight, mollifier threshold and xi back to rest and thickness.
  void pull_back(const Candidate& pair,
                 double weight_bar,
                 double threshold_bar,
                 double xi_bar,
                 Bar& bar) const;
  void pull_back_mu(const Candidate& pair, double mu_bar, Bar& bar) const;

  /// Vertices of both primitives prescribed.
  bool inert(const Candidate& pair) const;

  /// Whether some of these vertices are prescribed.
  bool has_prescribed(const std::array<Index, 4>& vertices) const;

 private:
  double weight(const Candidate& pair) const;
  double threshold(const Candidate& pair) const;
  Index surface_a(const Candidate& pair) const { return mesh_.vertex_surface[pair.vertices[0]]; }
  Index surface_b(const Candidate& pair) const { return mesh_.vertex_surface[pair.vertices[3]]; }

  const CollisionMesh& mesh_;
  const RestMeasures& rest_;
  Parameters parameters_;
  const std::vector<char>& prescribed_;
  double reach_;
};

/// The four corners of a pair.
Corners corners(const std::array<Index, 4>& vertices, const double* x);

/// z at the four corners, stacked.
Vec12 stacked(const std::array<Index, 4>& vertices, const double* z);

}  // namespace diffcloth::contact
