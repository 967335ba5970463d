#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "common/friction_law.h"
#include "contact/contact_set.h"
#include "contact/direction_kernels.h"

namespace diffcloth::contact {

/// Whether the edges of a pair between cloths cross at an angle at x, so that they say how it turns.
bool crosses(const Candidate& pair, const double* x);

/// What a vector has across a unit normal.
inline Vec3 tangential(const Vec3& u, const Vec3& n) { return u - n.dot(u) * n; }

/// Lagged friction: sum over contacts of mu lambda f0(|w|; e)  [J],
///
///   w = (I - n n^T) s,   s = r(x) - Q(x) Q_L^-1 t - Q_L r',   r(x) = sum_i c_i x_i,   e = eps_v h,
///
/// with c, n, the gap t = r(x_L) and the normal force lambda = -kappa w m b'(D) 2 d [N] of the lag
/// configuration x_L held fixed. r is the vector from one contact point to the other, and Q(x) turns it, from the
/// start of the step, as the surface turns that its `frame` belongs to: what turns as one does not slide.
/// Obstacle vertices take part, so that a moving body drags the cloth.
///
/// At x_L, w is what is left across n of t - Q_L r', where r' = r(x_start) + l n is the gap at the start, as long
/// as to leave n . (t - Q_L r') = 0: that the gap opened or closed is not sliding. Around x_L, it is t that turns.
/// Both contact points get the force f1 w / |w|, and the frame the couple of -t with it, so that friction has no
/// moment there.
///
/// Between two round bodies the gap is the sum of both radii and the space between them: it splits by the
/// radii, and each share turns with its own body, so that they roll on each other.
///
/// Q comes from two edges e1 and e2: of three vertices of that surface, or, where the edges of two cloths
/// cross at an angle, these. With m = e1 x e2,
///
///   Q(x) Q_L^-1 t = a1 e1(x) + a2 e2(x) + a3 m(x),   where a makes it t at x_L,
///
/// or the sum of two such terms, one of each body, with a of its share of t; Q_L r' likewise.
class FrictionSet {
 public:
  FrictionSet() = default;

  /// @param contacts  the contacts of the lag configuration; they outlive this object
  /// @param x_start   positions at the start of the step; likewise
  /// @param x_lag     those of the lag configuration, which add_mixed() and add_tangents() read again
  FrictionSet(const ContactModel& model,
              const std::vector<Contact>& contacts,
              const double* x_start,
              const double* x_lag);

  const ContactModel& model() const { return *model_; }
  bool empty() const { return entries_.empty(); }

  /// A part of the gap that turns with a frame.
  struct GapPart {
    int first;                 ///< of the frame's vertices among the points
    int size;                  ///< how many there are: three or four
    std::array<int, 4> edges;  ///< start and end of e1, then of e2, among the points
    double share;              ///< of the gap
    bool turns = false;  ///< false where the frame is a line at x_start or x_L: Q is the identity
    /// Its share of t in the frame at x_L, and of r' in that at the start; zero if it does not turn.
    Vec3 a = Vec3::Zero();
    Vec3 b = Vec3::Zero();
    Mat3 turn = Mat3::Identity();  ///< Q from the start to x_L

    /// How often a point counts in e1 or e2: 1 at the end, -1 at the start.
    int sign(int e, int point) const {
      return static_cast<int>(point == edges[2 * e + 1]) - static_cast<int>(point == edges[2 * e]);
    }
  };

  struct Entry {
    /// A contact of the lag configuration, which nothing turns with yet.
    Entry(const Contact& contact, double coefficient);

    const Contact& lag;
    Vec3 n;               ///< unit normal at the lag configuration
    double lambda = 0.0;  ///< normal force at the lag configuration [N]
    double mu;
    double extension = 0.0;       ///< l, of the gap at the start along n [m]
    Vec3 s_start = Vec3::Zero();  ///< s at the start
    /// w there: nothing has slipped if the lag configuration is the start, to the last bit.
    Vec3 w_start = Vec3::Zero();
    /// Corners of the contact, then the vertices of the frames, which between cloths are corners too.
    std::array<Index, 7> points = {};
    std::array<double, 7> c = {};  ///< of the points
    int frame = 0;                 ///< where the frames' vertices begin
    int count = 0;                 ///< of the points: the frames' three to six are the last
    int part_count = 0;            ///< one or two
    std::array<GapPart, 2> parts = {};

    std::span<const Index> all_points() const {
      return {points.data(), static_cast<std::size_t>(count)};
    }

    /// e1 or e2 of a part, of some rows.
    Vec3 edge(const GapPart& part, int e, const double* rows) const {
      return row(rows, points[part.edges[2 * e + 1]]) - row(rows, points[part.edges[2 * e]]);
    }

    /// Q v from the start to x_L, and Q^T v.
    Vec3 turned(const Vec3& v) const;
    Vec3 turned_back(const Vec3& v) const;

    /// sum_i c_i of some rows, which no translation changes: from the first point, as that cancels less.
    Vec3 gap(const double* rows) const;

    /// Add cotangents of e1 and e2 of a part to those of the frame's vertices.
    void add_edges(const GapPart& part, const std::array<Vec3, 2>& bar, double* x_bar) const;
  };
  const std::vector<Entry>& entries() const { return entries_; }

  /// e1, e2 and m of a frame of an entry.
  struct Frame {
    Frame() = default;
    Frame(const Entry& k, const GapPart& part, const double* x);

    bool is_line() const;
    Vec3 operator*(const Vec3& a) const { return a[0] * e1 + a[1] * e2 + a[2] * m; }
    /// The coordinates of a vector.
    Vec3 coordinates(const Vec3& r) const;
    /// The dot products with a vector.
    Vec3 transposed(const Vec3& f) const;
    /// sum_k a_k of the dual vectors.
    Vec3 dual(const Vec3& a) const;
    /// The matrix that takes e1, e2 and m to those of another frame.
    Mat3 turn_to(const Frame& other) const;
    /// Cotangents of e1 and e2 where f is that of this * a.
    std::array<Vec3, 2> pull_back(const Vec3& a, const Vec3& f) const;

    Vec3 e1;
    Vec3 e2;
    Vec3 m;
  };

  /// The displacement s of an entry, its projection w and the law there.
  struct Slip {
    std::array<Frame, 2> frames;  ///< of the parts
    Vec3 s;
    Vec3 w;
    FrictionLaw law;

    /// Share of the largest force, as a vector: f1 w / |w|.
    Vec3 force() const { return law.f1_over_y * w; }
  };
  /// Those of all entries at one point.
  using Slips = std::vector<Slip>;

  /// The slips at x, which last until those of two other points are asked for.
  const Slips& slips(const double* x) const;

  double energy_change(const double* x0, const double* x1) const;
  void add_gradient(const double* x, double* g) const;
  /// Of one entry, where it has this slip.
  void add_gradient(const Entry& entry, const Slip& at, double* g) const;

  /// Hessian of one entry: B^T core B, where B dx is the change of s, and what a frame's own turning
  /// adds: the cross product with its `turn` between its vertices.
  class Hessian {
   public:
    void add_to(linalg::BlockMatrix& A) const;

    /// What products along several directions are made of; of this Hessian, its entry and `B`.
    FrictionProduct factors(std::array<Mat3, 6>& B) const;

   private:
    friend class FrictionSet;
    Hessian(const Entry& entry, const Slip& at) : entry_(&entry), at_(&at) {}

    /// B of the frames' vertices; of all others it is c I.
    std::array<Mat3, 6> frame_changes() const;

    /// What is between two points where a frame turns.
    Mat3 turning(int p, int q) const;

    const Entry* entry_;
    const Slip* at_;
    Mat3 core_ = Mat3::Zero();
    std::array<Vec3, 2> turn_{Vec3::Zero(), Vec3::Zero()};  // of the parts
  };

  /// Of the sign of lambda. kPositive is the quadratic majorant (f1/|w|) P, which does not lose its
  /// curvature where a sliding contact would come to rest, and zero where lambda is negative.
  ///
  /// kPrimalDual has the dual v in the place of one f1 w / |w|:  q (P + f2 / q^2 (v w^T + w v^T) / 2)  with
  /// q = f1 / |w|. Newton's method crosses the kink of |w| to and fro, as the curvature along w is zero on
  /// both sides; where v still has the direction from before, there is some. It is positive, as |v| <= 1
  /// (Chan, Golub and Mulet, 1999, for images; ours has the slip of Coulomb's law).
  ///
  /// @param at  slips(x); duals are those of has_duals(x)
  Hessian hessian(const Entry& entry, const Slips& at, Curvature curvature) const;

  /// y += the exact Hessian of one entry times z.
  void add_product(const Entry& entry, const Slips& at, const double* z, double* y) const;

  /// Expect the motion from x, where nothing has slipped yet, to another point. The Hessians at x but the
  /// exact one then have q of the slip there: that of a contact at rest knows nothing of sliding. Of bodies
  /// and pins that move, and of bodies and links whose motion is not given, nothing is expected: what they
  /// hold often sticks, and follows where they speed up.
  void expect(const double* x, const double* to);

  /// Keep the duals of a step: v + min(alpha, 1) (q (w + dw) + f2 / q (w . dw) v - v), no longer than 1. None
  /// where all are close to the forces at its end.
  ///
  /// @param p   direction of the step of all points, by the fraction alpha of it
  /// @param to  its end
  void update_duals(const double* x, const double* p, double alpha, const double* to);

  bool has_duals(const double* x) const;

  /// Largest change of a friction force along a small change p of all points, as a share of mu lambda: of
  /// what sticks the change of its slip over half of eps_v h.
  double force_change(const double* x, const double* p) const;

  /// The inputs of friction besides x by which add_mixed() differentiates.
  enum class DiffWrt : std::uint8_t {
    kPoints,               ///< x_start and x_lag
    kPointsAndParameters,  ///< and friction, slip and, through lambda, kappa, d_hat, thickness, rest shape
  };

  /// Cotangents of these inputs.
  struct Cotangents {
    double* start;                  ///< of x_start, all vertices
    double* lag;                    ///< of x_lag, likewise
    ContactModel::Bar* parameters;  ///< not read if only points are asked for
  };

  /// out += scale * d/d(theta) of z . grad D, for the inputs theta that are chosen.
  void add_mixed(
      const double* x, const double* z, double scale, DiffWrt inputs, const Cotangents& out) const;

  /// Tangents of what friction depends on besides x, along a direction.
  struct Tangents {
    const ContactModel::Bar* parameters;  ///< null where none changes
    const double* start;                  ///< of x_start, all vertices
    const double* lag;                    ///< of the lag configuration
  };

  /// y += d/d(theta) (grad D) theta_dot along each direction: add_mixed(), transposed.
  void add_tangents(const double* x,
                    std::span<const Tangents> directions,
                    std::span<double* const> y) const;

  /// How the extension of an entry's gap changes: the dot products of all these with the changes of the gap
  /// t of the lag configuration, of n, of r(x_start), and of the edges of the parts.
  struct ExtensionDerivative {
    Vec3 by_t;
    Vec3 by_n;
    Vec3 by_r;
    std::array<std::array<Vec3, 2>, 2> by_lag_edges;
    std::array<std::array<Vec3, 2>, 2> by_start_edges;
  };

 private:
  /// What is kept of a point.
  struct Kept {
    std::vector<Vec3> place;  ///< of points_; empty where nothing is known
    Slips slips;
  };
  ExtensionDerivative extension_derivative(const Entry& entry) const;
  bool is_at(const std::vector<Vec3>& place, const double* x) const;
  void take_place(const double* x, std::vector<Vec3>& place) const;
  Slip slip(const Entry& entry, const double* x) const;
  /// q of the Hessians that are not exact.
  double stiffness(std::size_t entry, const Slip& at) const;

  const ContactModel* model_ = nullptr;
  const double* x_start_ = nullptr;
  const double* x_lag_ = nullptr;
  std::vector<Entry> entries_;
  mutable std::array<Kept, 2> kept_;
  mutable std::size_t last_ = 0;  // of these
  std::vector<Index> points_;     // of all entries, ascending
  std::vector<Vec3> duals_at_;    // place of the duals; empty where there are none
  std::vector<Vec3> duals_;       // of the entries
  std::vector<double> expected_;  // q of the entries; empty where nothing is expected
};

}  // namespace diffcloth::contact
