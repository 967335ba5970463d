#pragma once

#include <array>
#include <optional>
#include <span>
#include <tuple>
#include <vector>

#include "common/types.h"
#include "contact/barrier.h"
#include "contact/broad_phase.h"
#include "contact/collision_mesh.h"
#include "contact/direction_kernels.h"
#include "contact/distance/closest.h"
#include "contact/feature_weights.h"
#include "contact/merge.h"
#include "contact/rest_measures.h"
#include "potential/potential.h"

namespace diffcloth::contact {

/// Parameters of a contact's energy, besides positions and rest shape.
struct Parameters {
  double d_hat;                   ///< barrier distance [m]
  double slip;                    ///< eps_v h: displacement over a step where sliding begins [m]
  std::vector<double> thickness;  ///< [S] full thickness of each surface [m]
  std::vector<double> kappa;      ///< [S * S] barrier stiffness [Pa]
  std::vector<double> friction;   ///< [S * S]; a pair uses the mean of its two entries
};

/// A pair of primitives within reach, with everything its barrier needs.
struct Contact {
  Candidate pair;      ///< against bodies: nearest features, see Term
  double coefficient;  ///< fraction of the area, or between bodies the area [m^2]; may be negative
  double weight;       ///< w: coefficient times area [m^2]
  double threshold;    ///< eps of the edge-edge mollifier [m^4]; 0: no mollifier
  double xi;           ///< touching distance: half the sum of the thicknesses, plus the radii [m]
  double kappa;        ///< barrier stiffness of the two surfaces [Pa]
  Closest closest;
  Barrier barrier;
  double mollifier;  ///< m
  bool mollified;    ///< true if m < 1: the derivatives of m contribute
};

/// Pairs of one configuration that are within reach, with their distances: sufficient for the energy,
/// and the start of its derivatives.
///
/// Depends on the configuration alone, not on the candidates that were searched.
struct Near {
  /// Energy of candidates that act together: a single one, or all of a point or an edge and a body.
  struct Energy {
    PairKind kind;
    Index a;
    Index surface;
    Index b;       ///< -1 for a body as a whole
    double value;  ///< [J], not zero; +infinity where d <= xi
  };
  std::vector<Term> terms;       ///< in the order of the candidates
  std::vector<Energy> energies;  ///< likewise

  /// Sum of the energies [J].
  double energy() const;
};

/// Visit the energies of pairs in two configurations side by side; 0 if a pair has none.
template <class Visit>
void for_each_energy(const Near& p, const Near& q, Visit&& visit) {
  const auto key = [](const Near::Energy& e) { return std::tie(e.kind, e.a, e.surface, e.b); };
  auto i = p.energies.begin();
  auto j = q.energies.begin();
  while (i != p.energies.end() || j != q.energies.end()) {
    const bool in_p = i != p.energies.end() && (j == q.energies.end() || key(*i) <= key(*j));
    const bool in_q = j != q.energies.end() && (i == p.energies.end() || key(*j) <= key(*i));
    visit(in_p ? i->value : 0.0, in_q ? j->value : 0.0);
    if (in_p) ++i;
    if (in_q) ++j;
  }
}

/// Energy of q minus energy of p, summed pair by pair [J].
double energy_change(const Near& p, const Near& q);

/// Hessian of one contact by its 3x3 blocks:  sum_k left_k right_k^T + c c^T (x) along I + rest.  `rest`
/// is the contribution of mollifiers.
class ContactHessian {
 public:
  Mat3 operator()(int p, int q) const;
  Vec12 operator*(const Vec12& z) const;

  /// Add the Hessian to a matrix.
  void add_to(linalg::BlockMatrix& A, const std::array<Index, 4>& points) const;

  /// Factors for products along several directions; pointers into this Hessian.
  ContactProduct factors(const std::array<Index, 4>& points) const;

 private:
  friend class ContactModel;
  Mat12 dense() const;
  void add(const Vec12& left, const Vec12& right);

  int count_ = 0;  ///< number of outer products
  std::array<Vec12, 3> left_;
  std::array<Vec12, 3> right_;
  Vec4 c_ = Vec4::Zero();
  double along_ = 0.0;
  std::optional<Mat12> rest_;
};

/// Barrier contacts of one configuration: sum of kappa w m b(D; xi, d_hat)  [J].
///
/// Between cloths the sum is over all pairs of a vertex p and a face, w = A_p / 4, and of two edges, w =
/// (A_a + A_b) / 4. Between a cloth and a body it is over features (see FeatureWeights), so that it does
/// not depend on the triangulation of the body:
///
///   cloth vertex p:  w = A_p / 4            times the sum over the body's features,
///   cloth edge c:    w = A_c / 2            times the sum over the body's sharp edges,
///   body vertex v:   w = s_v mean(A_f) / 4  times the sum over the cloth's features, with the mean
///                                           area of the cloth's faces.
///
/// Between two bodies the sum is over the features of each that a corner of the other meets, and over
/// pairs of ridges; areas are defined by FeatureWeights.
///
/// Round bodies (see CollisionMesh) are larger by their radius than the skeleton that is in the pairs.
/// They meet faces of cloths, w = A_f / 4, and edges: see FeatureWeights.
///
/// Terms with identical nearest features are merged into one contact, whose coefficient is the sum of
/// theirs.
///
/// Positions cover the whole collision mesh, cloths first, then bodies: 3 doubles per vertex.
/// `prescribed` marks vertices with prescribed motion (pins, bodies that dynamics does not move): pairs
/// of such vertices alone carry no energy.
class ContactModel {
 public:
  ContactModel(const CollisionMesh& mesh,
               const FeatureWeights& weights,
               const RestMeasures& rest,
               Parameters parameters,
               const std::vector<char>& prescribed);

  const Parameters& parameters() const { return parameters_; }
  const CollisionMesh& mesh() const { return mesh_; }

  /// Half of the distance at which a surface interacts with its own kind: (d_hat + thickness) / 2 +
  /// radius [m]. Two surfaces interact up to the sum of their reaches, d_hat + xi.
  const std::vector<double>& reach() const { return reach_; }

  /// Half the sum of the thicknesses of a pair's surfaces, plus their radii [m].
  double xi(const Candidate& pair) const;

  /// Barrier stiffness of a pair's surfaces [Pa].
  double kappa(const Candidate& pair) const { return mean_entry(parameters_.kappa, pair); }

  /// Friction coefficient of a pair.
  double mu(const Candidate& pair) const { return mean_entry(parameters_.friction, pair); }

  /// Compute the terms and energies within reach at x.
  ///
  /// @param candidates  sorted; must include all pairs within reach
  void measure(const std::vector<Candidate>& candidates, const double* x, Near& out) const;

  /// The contacts at x, in the order of the terms.
  void find(const Near& near, const double* x, std::vector<Contact>& out) const;

  /// True for each surface that has vertices without prescribed motion [surfaces].
  std::vector<char> moving_surfaces() const;

  /// True if any of the points is not a free vertex of a cloth.
  bool is_held(std::span<const Index> points) const;

  /// True if any of the points belongs to a body or a link that is dynamic.
  bool is_of_moving_body(std::span<const Index> points) const;

  bool between_cloths(const Candidate& pair) const;

  /// Three vertices of one surface of a pair, with which the gap between both rotates. If a body is
  /// involved: its carriers, of a round body before one that is not, of a prescribed one before a moving
  /// one. Between cloths: the triangle, or, for edges that do not cross, a face at the second edge.
  std::array<Index, 3> frame(const Candidate& pair) const;

  /// Fraction of the gap that rotates with the pair's first surface, the rest with the second: for two
  /// round bodies by their radii, so that each rolls independently; negative if the whole gap rotates
  /// with frame().
  double first_share(const Candidate& pair) const;

  /// Three vertices that define the orientation of a body.
  const std::array<Index, 3>& carriers(Index surface) const { return weights_.carriers(surface); }

  /// g += grad B.
  void add_gradient(const std::vector<Contact>& contacts, const double* x, double* g) const;

  /// Hessian of one contact. kPositive: its positive part, which is zero if the weight is negative.
  ContactHessian hessian(const Contact& contact, const double* x, Curvature curvature) const;

  /// Cotangents of parameters and rest shape.
  struct Bar {
    double d_hat = 0.0;
    double slip = 0.0;
    std::vector<double> thickness;  ///< [S]
    std::vector<double> kappa;      ///< [S * S]
    std::vector<double> friction;   ///< [S * S]
    RestMeasures rest;

    explicit Bar(const CollisionMesh& mesh);
  };

  /// bar += scale * dB/d(theta), for every theta of Bar.
  void add_energy_bars(const std::vector<Contact>& contacts,
                       const double* x,
                       double scale,
                       Bar& bar) const;

  /// bar += scale * d/d(theta) of z . grad B, for every theta of Bar.
  void add_mixed(const std::vector<Contact>& contacts,
                 const double* x,
                 const double* z,
                 double scale,
                 Bar& bar) const;

  /// y += d/d(theta) (grad B) theta_dot along each direction, for tangents of every theta of Bar: the
  /// transpose of add_mixed().
  void add_tangents(const std::vector<Contact>& contacts,
                    const double* x,
                    std::span<const Bar* const> directions,
                    std::span<double* const> y) const;

  /// Tangents of a contact's kappa, weight, mollifier threshold and xi.
  struct ContactTangent {
    double kappa;
    double weight;
    double threshold;
    double xi;
  };
  ContactTangent push_forward(const Contact& contact, const Bar& dot) const;
  double push_forward_mu(const Candidate& pair, const Bar& dot) const {
    return mean_entry(dot.friction, pair);
  }

  /// Pull cotangents of a contact's weight, mollifier threshold and xi back to rest shape and thickness.
  void pull_back(const Contact& contact,
                 double weight_bar,
                 double threshold_bar,
                 double xi_bar,
                 Bar& bar) const;
  void pull_back_kappa(const Candidate& pair, double kappa_bar, Bar& bar) const {
    pull_back_mean_entry(pair, kappa_bar, bar.kappa);
  }
  void pull_back_mu(const Candidate& pair, double mu_bar, Bar& bar) const {
    pull_back_mean_entry(pair, mu_bar, bar.friction);
  }

 private:
  /// True if a pair joins a point of a skeleton and a face of a cloth.
  bool is_round_on_cloth(const Candidate& pair) const {
    return pair.kind == PairKind::kPointTriangle && mesh_.is_round_vertex(pair.vertices[0]) &&
           surface_b(pair) < mesh_.cloth_count;
  }
  /// True if a candidate forms a term by itself.
  bool is_alone(const Candidate& pair) const {
    return between_cloths(pair) || is_round_on_cloth(pair);
  }
  std::vector<Candidate> near_ones(const std::vector<Candidate>& candidates, const double* x) const;
  void add_skeleton_term(const Candidate& pair, const double* x, std::vector<Term>& out) const;
  /// End of the group of candidates that act together: a single one, or all of a point or an edge and a
  /// body.
  std::size_t group_end(const std::vector<Candidate>& candidates, std::size_t first) const;
  bool between_bodies(const Candidate& pair) const;
  void find_terms(std::span<const Candidate> group,
                  const double* x,
                  MergeScratch& scratch,
                  std::vector<Term>& out) const;
  void add_own_term(const Candidate& pair, const double* x, std::vector<Term>& out) const;
  /// Mean of the two entries of a pair's surfaces in values [S * S].
  double mean_entry(const std::vector<double>& values, const Candidate& pair) const;
  void pull_back_mean_entry(const Candidate& pair, double mean_bar, std::vector<double>& bar) const;
  double area(const Candidate& pair) const;
  /// Area from rest measures, or its tangent from their tangents; not between bodies.
  double area(const Candidate& pair, const RestMeasures& rest) const;
  void pull_back_area(const Contact& contact, double area_bar, RestMeasures& rest) const;
  double threshold(const Candidate& pair) const;
  Contact contact(const Term& term, const double* x) const;

  Index surface_a(const Candidate& pair) const { return mesh_.vertex_surface[pair.vertices[0]]; }
  Index surface_b(const Candidate& pair) const { return mesh_.vertex_surface[pair.vertices[3]]; }

  const CollisionMesh& mesh_;
  const FeatureWeights& weights_;
  const RestMeasures& rest_;
  Parameters parameters_;
  const std::vector<char>& prescribed_;
  std::vector<double> reach_;  // [S]
};

/// The four corners of a pair.
Corners corners(const std::array<Index, 4>& vertices, const double* x);

/// z at the four corners, stacked.
Vec12 stacked(const std::array<Index, 4>& vertices, const double* z);

}  // namespace diffcloth::contact
