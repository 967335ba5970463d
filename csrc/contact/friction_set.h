#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "common/friction_law.h"
#include "contact/contact_set.h"
#include "contact/direction_kernels.h"
#include "contact/friction_lanes.h"

namespace diffcloth::contact {

/// True if the edges of a pair between cloths cross at a sufficient angle at x to define its
/// orientation.
bool crosses(const Candidate& pair, const double* x);

/// Component of a vector orthogonal to a unit normal.
inline Vec3 tangential(const Vec3& u, const Vec3& n) { return u - n.dot(u) * n; }

/// Lagged friction: sum over contacts of mu lambda f0(|w|; e)  [J],
///
///   w = (I - n n^T) s,   s = r(x) - Q(x) Q_L^-1 t - Q_L r',   r(x) = sum_i c_i x_i,   e = eps_v h,
///
/// with c, n, the gap t = r(x_L) and the normal force lambda = -kappa w m b'(D) 2 d [N] of the lag
/// configuration x_L held fixed. r is the vector from one contact point to the other, and Q(x) is its
/// rotation since the start of the step with the surface that `frame` belongs to: a common rotation is
/// not sliding. Obstacle vertices contribute, so that a moving body drags the cloth.
///
/// At x_L, w is the tangential part of t - Q_L r', where r' = r(x_start) + l n is the gap at the start,
/// extended such that n . (t - Q_L r') = 0: opening or closing of the gap is not sliding. Around x_L, t
/// rotates with the frame. Both contact points receive the force f1 w / |w|, and the frame receives the
/// couple of -t with it, so that friction exerts no moment.
///
/// Between two round bodies the gap is the sum of both radii and the space between them: it splits in
/// proportion to the radii, and each part rotates with its own body, so that the bodies roll on each
/// other.
///
/// Q is defined by two edges e1 and e2: of three vertices of that surface, or of the pair itself, if it
/// consists of edges of two cloths that cross at an angle. With m = e1 x e2,
///
///   Q(x) Q_L^-1 t = a1 e1(x) + a2 e2(x) + a3 m(x),   with a such that the sum is t at x_L,
///
/// or the sum of two such terms, one per body, with a from its fraction of t; Q_L r' likewise.
class FrictionSet {
 public:
  FrictionSet() = default;

  /// @param contacts  contacts of the lag configuration; must outlive this object
  /// @param x_start   positions at the start of the step; likewise
  /// @param x_lag     positions of the lag configuration, which add_mixed() and add_tangents() read
  /// again
  FrictionSet(const ContactModel& model,
              const std::vector<Contact>& contacts,
              const double* x_start,
              const double* x_lag);

  const ContactModel& model() const { return *model_; }
  bool empty() const { return entries_.empty(); }

  /// Part of the gap that rotates with a frame.
  struct GapPart {
    int first;                 ///< index of the frame's first vertex among the points
    int size;                  ///< number of the frame's vertices: three or four
    std::array<int, 4> edges;  ///< start and end of e1, then of e2, among the points
    double share;              ///< fraction of the gap
    bool turns = false;  ///< false if the frame is degenerate at x_start or x_L: Q is the identity
    /// Coordinates of the fraction of t in the frame at x_L, and of r' in the frame at the start; zero
    /// if `turns` is false.
    Vec3 a = Vec3::Zero();
    Vec3 b = Vec3::Zero();
    Mat3 turn = Mat3::Identity();  ///< Q from the start to x_L

    /// Coefficient of a point in e1 or e2: 1 at the end, -1 at the start, else 0.
    int sign(int e, int point) const {
      return static_cast<int>(point == edges[2 * e + 1]) - static_cast<int>(point == edges[2 * e]);
    }
  };

  struct Entry {
    /// A contact of the lag configuration, without frames yet.
    Entry(const Contact& contact, double coefficient);

    const Contact& lag;
    Vec3 n;               ///< unit normal at the lag configuration
    double lambda = 0.0;  ///< normal force at the lag configuration [N]
    double mu;
    double extension = 0.0;       ///< l: extension of the gap at the start along n [m]
    Vec3 s_start = Vec3::Zero();  ///< s at the start
    /// w at the start; exactly zero if the lag configuration is the start.
    Vec3 w_start = Vec3::Zero();
    /// Corners of the contact, then the vertices of the frames; between cloths a vertex may be both.
    std::array<Index, 7> points = {};
    std::array<double, 7> c = {};  ///< of the points
    int frame = 0;                 ///< index of the frames' first vertex
    int count = 0;                 ///< number of points; the frames' three to six are the last
    int part_count = 0;            ///< one or two
    std::array<GapPart, 2> parts = {};

    std::span<const Index> all_points() const {
      return {points.data(), static_cast<std::size_t>(count)};
    }

    /// e1 or e2 of a part, for given rows.
    Vec3 edge(const GapPart& part, int e, const double* rows) const {
      return row(rows, points[part.edges[2 * e + 1]]) - row(rows, points[part.edges[2 * e]]);
    }

    /// Q v from the start to x_L, and Q^T v.
    Vec3 turned(const Vec3& v) const;
    Vec3 turned_back(const Vec3& v) const;

    /// sum_i c_i row_i, invariant to translation: computed relative to the first point, with less
    /// cancellation.
    Vec3 gap(const double* rows) const;

    /// Add cotangents of e1 and e2 of a part to the cotangents of the frame's vertices.
    void add_edges(const GapPart& part, const std::array<Vec3, 2>& bar, double* x_bar) const;
  };
  const std::vector<Entry>& entries() const { return entries_; }

  /// Vectors e1, e2 and m of a frame of an entry.
  struct Frame {
    Frame() = default;
    Frame(const Entry& k, const GapPart& part, const double* x);

    bool is_line() const;
    Vec3 operator*(const Vec3& a) const { return a[0] * e1 + a[1] * e2 + a[2] * m; }
    /// Coordinates of a vector in the frame.
    Vec3 coordinates(const Vec3& r) const;
    /// Dot products of e1, e2 and m with a vector.
    Vec3 transposed(const Vec3& f) const;
    /// sum_k a_k of the dual vectors.
    Vec3 dual(const Vec3& a) const;
    /// The matrix that maps e1, e2 and m to the vectors of another frame.
    Mat3 turn_to(const Frame& other) const;
    /// Cotangents of e1 and e2, where f is the cotangent of this * a.
    std::array<Vec3, 2> pull_back(const Vec3& a, const Vec3& f) const;

    Vec3 e1;
    Vec3 e2;
    Vec3 m;
  };

  /// Displacement s of an entry, its projection w, and the friction law at |w|.
  struct Slip {
    std::array<Frame, 2> frames;  ///< of the parts
    Vec3 s;
    Vec3 w;
    FrictionLaw law;

    /// Force as a fraction of the largest one: f1 w / |w|.
    Vec3 force() const { return law.f1_over_y * w; }
  };
  /// Slips of all entries at one point.
  using Slips = std::vector<Slip>;

  /// Slips at x; the reference is valid until slips at two other points are computed.
  const Slips& slips(const double* x) const;

  /// Slips at x by given kernels, which are not kept.
  Slips slips(const double* x, const FrictionKernels& by) const;

  /// Slip of one entry at x: the same bits, one operation after the other.
  Slip slip(const Entry& entry, const double* x) const;

  /// Changes of w of all entries with a small motion p of all points.
  ///
  /// @param at  slips at the start of the motion
  std::vector<Vec3> changes(const Slips& at, const double* p, const FrictionKernels& by) const;

  double energy_change(const double* x0, const double* x1) const;
  void add_gradient(const double* x, double* g) const;
  /// Add the gradient of one entry, which has this slip.
  void add_gradient(const Entry& entry, const Slip& at, double* g) const;

  /// Hessian of one entry: B^T core B, where B dx is the change of s, plus the second derivative of a
  /// frame's rotation: the cross product with its `turn` between its vertices.
  class Hessian {
   public:
    void add_to(linalg::BlockMatrix& A) const;

    /// Factors for products along several directions; pointers into this Hessian, its entry and `B`.
    FrictionProduct factors(std::array<Mat3, 6>& B) const;

   private:
    friend class FrictionSet;
    Hessian(const Entry& entry, const Slip& at) : entry_(&entry), at_(&at) {}

    /// B of the frames' vertices; for all other points B is c I.
    std::array<Mat3, 6> frame_changes() const;

    /// Contribution of a rotating frame to the block of two points.
    Mat3 turning(int p, int q) const;

    const Entry* entry_;
    const Slip* at_;
    Mat3 core_ = Mat3::Zero();
    std::array<Vec3, 2> turn_{Vec3::Zero(), Vec3::Zero()};  // of the parts
  };

  /// Hessian of one entry; its sign is the sign of lambda. kPositive is the quadratic majorant (f1/|w|)
  /// P, whose curvature does not vanish for a sliding contact that would come to rest; it is zero if
  /// lambda is negative.
  ///
  /// kPrimalDual replaces one f1 w / |w| by the dual v:  q (P + f2 / q^2 (v w^T + w v^T) / 2)  with q =
  /// f1 / |w|. Newton's method alone oscillates across the kink of |w|, because the curvature along w is
  /// zero on both sides; a dual v that keeps the previous direction adds curvature. The matrix is
  /// positive, as |v| <= 1 (Chan, Golub and Mulet, 1999, for images; here with the slip of Coulomb's
  /// law).
  ///
  /// @param at  slips(x); duals are used if has_duals(x)
  Hessian hessian(const Entry& entry, const Slips& at, Curvature curvature) const;

  /// y += the exact Hessian of one entry times z.
  void add_product(const Entry& entry, const Slips& at, const double* z, double* y) const;

  /// Set the expected motion from x, where no contact has slipped yet, to another point. All Hessians at
  /// x except the exact one then use q of the expected slip, because the q of a contact at rest does not
  /// anticipate sliding. The expected slip is the smallest over all fractions of the motion of bodies
  /// and pins, and zero for contacts with dynamic bodies and links: objects that these hold often stick,
  /// and follow when they accelerate.
  void expect(const double* x, const double* to);

  /// Update the duals after a step: v + min(alpha, 1) (q (w + dw) + f2 / q (w . dw) v - v), clipped to
  /// length 1. No duals are kept if all are close to the forces at the end of the step.
  ///
  /// @param p   direction of the step for all points; alpha is the fraction taken
  /// @param to  end of the step
  void update_duals(const double* x, const double* p, double alpha, const double* to);

  bool has_duals(const double* x) const;

  /// Largest change of a friction force along a small change p of all points, relative to mu lambda: for
  /// a sticking contact, the change of its slip over half of eps_v h.
  double force_change(const double* x, const double* p) const;

  /// The inputs of friction besides x by which add_mixed() differentiates.
  enum class DiffWrt : std::uint8_t {
    kPoints,               ///< x_start and x_lag
    kPointsAndParameters,  ///< and friction, slip and, through lambda, kappa, d_hat, thickness, rest shape
  };

  /// Cotangents of these inputs.
  struct Cotangents {
    double* start;                  ///< cotangent of x_start, all vertices
    double* lag;                    ///< cotangent of x_lag, likewise
    ContactModel::Bar* parameters;  ///< null if only cotangents of points are computed
  };

  /// out += scale * d/d(theta) of z . grad D, for the chosen inputs theta.
  void add_mixed(
      const double* x, const double* z, double scale, DiffWrt inputs, const Cotangents& out) const;

  /// Tangents of the inputs of friction besides x, along one direction.
  struct Tangents {
    const ContactModel::Bar* parameters;  ///< null: no change
    const double* start;                  ///< tangent of x_start, all vertices
    const double* lag;                    ///< tangent of the lag configuration
  };

  /// y += d/d(theta) (grad D) theta_dot along each direction: the transpose of add_mixed().
  void add_tangents(const double* x,
                    std::span<const Tangents> directions,
                    std::span<double* const> y) const;

  /// Derivative of the extension of an entry's gap: vectors whose dot products with the changes of the
  /// gap t of the lag configuration, of n, of r(x_start), and of the edges of the parts are summed.
  struct ExtensionDerivative {
    Vec3 by_t;
    Vec3 by_n;
    Vec3 by_r;
    std::array<std::array<Vec3, 2>, 2> by_lag_edges;
    std::array<std::array<Vec3, 2>, 2> by_start_edges;
  };

 private:
  /// Cached slips of one point.
  struct Kept {
    std::vector<Vec3> place;  ///< positions of points_; empty: not valid
    Slips slips;
  };
  ExtensionDerivative extension_derivative(const Entry& entry) const;
  bool is_at(const std::vector<Vec3>& place, const double* x) const;
  void take_place(const double* x, std::vector<Vec3>& place) const;
  void make_batches();
  void find_slips(const double* x,
                  const std::vector<Vec3>& place,
                  const FrictionKernels& by,
                  Slips& out) const;
  /// q of the Hessians other than kExact.
  double stiffness(std::size_t entry, const Slip& at) const;

  const ContactModel* model_ = nullptr;
  const double* x_start_ = nullptr;
  const double* x_lag_ = nullptr;
  std::vector<Entry> entries_;
  mutable std::array<Kept, 2> kept_;
  mutable std::size_t last_ = 0;        // index of the last entry used
  std::vector<Index> points_;           // of all entries, ascending
  std::vector<Vec3> start_;             // their positions at x_start
  std::vector<FrictionBatch> batches_;  // entries with one frame
  std::vector<std::size_t> alone_;      // entries with two frames
  std::vector<Vec3> duals_at_;          // positions of points_ for the duals; empty: no duals
  std::vector<Vec3> duals_;             // of the entries
  std::vector<double> expected_;        // q of the entries; empty: no expectation
};

}  // namespace diffcloth::contact
