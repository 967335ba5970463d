#include "contact/friction_set.h"

#include <algorithm>
#include <cmath>
#include <type_traits>

#include "contact/distance/mollifier.h"

namespace diffcloth::contact {
namespace {

using Entry = FrictionSet::Entry;
using Frame = FrictionSet::Frame;
using GapPart = FrictionSet::GapPart;

/// Bound of |m|^2 over |e1|^2 |e2|^2 below which a frame is degenerate: its edges are parallel to
/// rounding.
constexpr double kLine = 1e-24;
/// Duals that all differ from the forces at the point by at most this are dropped: Newton's method
/// converges without duals.
constexpr double kClose = 0.1;
/// Lower bound of n . Q n in the extension of the gap: the gap is extended at most by twice its missing
/// length, however its frame rotates in a step. The slip has a kink at this bound in x_start and x_lag.
constexpr double kLeastAlong = 0.5;
/// Squared sine of the angle above which two edges cross.
constexpr double kCrossing = 0.2;

void add_part(const GapPart& part, Entry& entry) { entry.parts[entry.part_count++] = part; }

/// Append three vertices as a frame; a vertex that is also a corner of the pair gets the corner's
/// coefficient.
void append_frame(const std::array<Index, 3>& frame, double share, Entry& entry) {
  const auto& v = entry.lag.pair.vertices;
  const Vec4& c = entry.lag.closest.c;
  const int first = entry.count;
  for (int e = 0; e < 3; ++e) {
    const int p = first + e;
    entry.points[p] = frame[e];
    for (int i = 0; i < 4; ++i) {
      if (v[i] == frame[e]) entry.c[p] += c[i];
    }
  }
  entry.count += 3;
  add_part(
      {.first = first, .size = 3, .edges = {first, first + 1, first, first + 2}, .share = share},
      entry);
}

/// Use the edges of a pair as the frame.
void turn_with_edges(Entry& entry) {
  const auto& v = entry.lag.pair.vertices;
  const Vec4& c = entry.lag.closest.c;
  entry.points = {v[2], v[3], v[0], v[1]};
  entry.c = {c[2], c[3], c[0], c[1]};
  entry.frame = 0;
  entry.count = 4;
  add_part({.first = 0, .size = 4, .edges = {0, 1, 2, 3}, .share = 1.0}, entry);
}

/// Use three vertices as the frame.
void turn_with(const std::array<Index, 3>& frame, Entry& entry) {
  const auto& v = entry.lag.pair.vertices;
  const Vec4& c = entry.lag.closest.c;
  for (int i = 0; i < 4; ++i) {
    if (std::ranges::find(frame, v[i]) != frame.end()) continue;
    entry.points[entry.frame] = v[i];
    entry.c[entry.frame++] = c[i];
  }
  entry.count = entry.frame;
  append_frame(frame, 1.0, entry);
}

/// Use a frame of each of two round bodies; their skeletons are among its vertices.
void turn_with_both(const ContactModel& model, double share, Entry& entry) {
  const auto& v = entry.lag.pair.vertices;
  const std::vector<Index>& surface = model.mesh().vertex_surface;
  append_frame(model.carriers(surface[v[0]]), share, entry);
  append_frame(model.carriers(surface[v[3]]), 1.0 - share, entry);
}

/// Change of s with z, at given frames.
Vec3 change_of_slip(const Entry& k, const std::array<Frame, 2>& frames, const double* z) {
  Vec3 change = k.gap(z);
  for (int l = 0; l < k.part_count; ++l) {
    const GapPart& part = k.parts[l];
    const Frame& frame = frames[l];
    const Frame edges(k, part, z);
    change = change - part.a[0] * edges.e1 - part.a[1] * edges.e2 -
             part.a[2] * (edges.e1.cross(frame.e2) + frame.e1.cross(edges.e2));
  }
  return change;
}

std::array<Vec3, 2> sum(const std::array<Vec3, 2>& a, const std::array<Vec3, 2>& b) {
  return {a[0] + b[0], a[1] + b[1]};
}

/// Matrix of v -> u x v.
Mat3 cross_matrix(const Vec3& u) {
  return Mat3{{0.0, -u[2], u[1]}, {u[2], 0.0, -u[0]}, {-u[1], u[0], 0.0}};
}

const FrictionKernels& kernels() {
  static const FrictionKernels& best = friction_kernels(linalg::chosen_level());
  return best;
}

static_assert(sizeof(Frame) == 9 * sizeof(double));
static_assert(sizeof(FrictionSet::Slip) == SlipLayout::kSize * sizeof(double));

/// The numbers of vectors or slips, one after the other.
template <class Values>
auto numbers(Values& values) {
  using Number = std::conditional_t<std::is_const_v<Values>, const double, double>;
  return reinterpret_cast<Number*>(values.data());
}

/// Point of the segment from a to b that is nearest to the origin.
Vec3 nearest_to_origin(const Vec3& a, const Vec3& b) {
  const Vec3 along = b - a;
  const double length_sq = along.squaredNorm();
  const double t = length_sq > 0.0 ? std::clamp(-a.dot(along) / length_sq, 0.0, 1.0) : 0.0;
  return a + t * along;
}

}  // namespace

Vec3 FrictionSet::Entry::gap(const double* rows) const {
  const Vec3 origin = row(rows, points[0]);
  Vec3 r = Vec3::Zero();
  for (int i = 1; i < count; ++i) {
    if (c[i] != 0.0) r += c[i] * (row(rows, points[i]) - origin);
  }
  return r;
}

Vec3 FrictionSet::Entry::turned(const Vec3& v) const {
  Vec3 result = Vec3::Zero();
  for (int l = 0; l < part_count; ++l) result += parts[l].share * (parts[l].turn * v);
  return result;
}

Vec3 FrictionSet::Entry::turned_back(const Vec3& v) const {
  Vec3 result = Vec3::Zero();
  for (int l = 0; l < part_count; ++l) result += parts[l].share * (parts[l].turn.transpose() * v);
  return result;
}

void FrictionSet::Entry::add_edges(const GapPart& part,
                                   const std::array<Vec3, 2>& bar,
                                   double* x_bar) const {
  for (int e = 0; e < 2; ++e) {
    Eigen::Map<Vec3>(x_bar + 3 * points[part.edges[2 * e + 1]]) += bar[e];
    Eigen::Map<Vec3>(x_bar + 3 * points[part.edges[2 * e]]) -= bar[e];
  }
}

bool crosses(const Candidate& pair, const double* x) {
  if (pair.kind != PairKind::kEdgeEdge) return false;
  const auto& v = pair.vertices;
  const Vec3 a = row(x, v[1]) - row(x, v[0]);
  const Vec3 b = row(x, v[3]) - row(x, v[2]);
  return a.cross(b).squaredNorm() > kCrossing * a.squaredNorm() * b.squaredNorm();
}

FrictionSet::Frame::Frame(const Entry& k, const GapPart& part, const double* x)
    : e1(k.edge(part, 0, x)), e2(k.edge(part, 1, x)), m(e1.cross(e2)) {}

bool FrictionSet::Frame::is_line() const {
  return !(m.squaredNorm() > kLine * e1.squaredNorm() * e2.squaredNorm());
}

Vec3 FrictionSet::Frame::coordinates(const Vec3& r) const {
  return Vec3(e2.cross(m).dot(r), m.cross(e1).dot(r), m.dot(r)) / m.squaredNorm();
}

Vec3 FrictionSet::Frame::dual(const Vec3& a) const {
  return (a[0] * e2.cross(m) + a[1] * m.cross(e1) + a[2] * m) / m.squaredNorm();
}

Vec3 FrictionSet::Frame::transposed(const Vec3& f) const {
  return {e1.dot(f), e2.dot(f), m.dot(f)};
}

Mat3 FrictionSet::Frame::turn_to(const Frame& other) const {
  return (other.e1 * e2.cross(m).transpose() + other.e2 * m.cross(e1).transpose() +
          other.m * m.transpose()) /
         m.squaredNorm();
}

std::array<Vec3, 2> FrictionSet::Frame::pull_back(const Vec3& a, const Vec3& f) const {
  return {a[0] * f + a[2] * e2.cross(f), a[1] * f + a[2] * f.cross(e1)};
}

FrictionSet::Entry::Entry(const Contact& contact, double coefficient)
    : lag(contact), mu(coefficient) {
  const double d = std::sqrt(lag.closest.d_sq);
  n = lag.closest.t / d;
  lambda = -lag.kappa * lag.weight * lag.mollifier * lag.barrier.b1 * 2.0 * d;
}

FrictionSet::FrictionSet(const ContactModel& model,
                         const std::vector<Contact>& contacts,
                         const double* x_start,
                         const double* x_lag)
    : model_(&model), x_start_(x_start), x_lag_(x_lag) {
  entries_.reserve(contacts.size());
  Index last = -1;
  for (const Contact& k : contacts) {
    Entry& entry = entries_.emplace_back(k, model.mu(k.pair));
    const double share = model.first_share(k.pair);
    if (share > 0.0) {
      turn_with_both(model, share, entry);
    } else if (model.between_cloths(k.pair) && crosses(k.pair, x_start) && crosses(k.pair, x_lag)) {
      turn_with_edges(entry);
    } else {
      turn_with(model.frame(k.pair), entry);
    }
    std::array<Frame, 2> starts;
    for (int l = 0; l < entry.part_count; ++l) {
      GapPart& part = entry.parts[l];
      const Frame lag(entry, part, x_lag);
      const Frame& start = starts[l] = Frame(entry, part, x_start);
      part.turns = !start.is_line() && !lag.is_line();
      if (!part.turns) continue;
      part.a = part.share * lag.coordinates(k.closest.t);
      part.turn = start.turn_to(lag);
    }
    const Vec3 r = entry.gap(x_start);
    const double along = entry.n.dot(entry.turned(entry.n));
    entry.extension =
        (std::sqrt(k.closest.d_sq) - entry.n.dot(entry.turned(r))) / std::max(along, kLeastAlong);
    const Vec3 longer = r + entry.extension * entry.n;
    entry.s_start = r - entry.turned(longer);
    for (int l = 0; l < entry.part_count; ++l) {
      GapPart& part = entry.parts[l];
      if (!part.turns) continue;
      part.b = part.share * starts[l].coordinates(longer);
      entry.s_start -= starts[l] * part.a;
    }
    const bool is_start = std::ranges::all_of(
        entry.all_points(), [&](Index v) { return row(x_lag, v) == row(x_start, v); });
    if (!is_start) entry.w_start = tangential(entry.s_start, entry.n);
    last = std::max(last, std::ranges::max(entry.all_points()));
  }
  std::vector<char> takes_part(static_cast<std::size_t>(last) + 1, 0);
  for (const Entry& k : entries_) {
    for (const Index v : k.all_points()) takes_part[v] = 1;
  }
  for (Index v = 0; v <= last; ++v) {
    if (takes_part[v] != 0) points_.push_back(v);
  }
  take_place(x_start, start_);
  make_batches();
}

void FrictionSet::make_batches() {
  std::vector<std::int32_t> own(points_.empty() ? 0 : points_.back() + std::size_t{1});
  for (std::size_t i = 0; i < points_.size(); ++i) own[points_[i]] = static_cast<std::int32_t>(i);
  const auto put = [&](std::size_t e, int l, FrictionBatch& batch) {
    const Entry& k = entries_[e];
    const GapPart& part = k.parts[0];
    const Vec3 e1_start = k.edge(part, 0, x_start_);
    batch.entry[l] = static_cast<std::int32_t>(e);
    for (int i = 0; i < kFrictionPoints; ++i) {
      const bool exists = i < k.count;
      batch.point[i][l] = own[k.points[exists ? i : 0]];
      batch.c[i][l] = exists ? k.c[i] : 0.0;
    }
    for (int i = 0; i < 4; ++i) batch.edge[i][l] = own[k.points[part.edges[i]]];
    for (int i = 0; i < 3; ++i) {
      batch.a[i][l] = part.a[i];
      batch.e1_start[i][l] = e1_start[i];
      batch.n[i][l] = k.n[i];
      batch.s_start[i][l] = k.s_start[i];
      batch.w_start[i][l] = k.w_start[i];
    }
  };
  batches_.reserve(entries_.size() / kFrictionLanes + 1);
  for (std::size_t e = 0; e < entries_.size(); ++e) {
    if (entries_[e].part_count != 1) {
      alone_.push_back(e);
      continue;
    }
    if (batches_.empty() || batches_.back().size == kFrictionLanes) batches_.emplace_back();
    FrictionBatch& batch = batches_.back();
    batch.points = std::max(batch.points, entries_[e].count);
    put(e, batch.size++, batch);
  }
  if (batches_.empty()) return;
  FrictionBatch& last = batches_.back();
  const std::int32_t repeated = last.entry[last.size - 1];
  for (int l = last.size; l < kFrictionLanes; ++l) {
    put(static_cast<std::size_t>(repeated), l, last);
  }
}

bool FrictionSet::is_at(const std::vector<Vec3>& place, const double* x) const {
  return !place.empty() &&
         std::ranges::equal(place, points_, [&](const Vec3& p, Index v) { return p == row(x, v); });
}

void FrictionSet::take_place(const double* x, std::vector<Vec3>& place) const {
  place.clear();
  place.reserve(points_.size());
  for (const Index v : points_) place.emplace_back(row(x, v));
}

const FrictionSet::Slips& FrictionSet::slips(const double* x) const {
  if (is_at(kept_[last_].place, x)) return kept_[last_].slips;
  last_ = 1 - last_;
  Kept& here = kept_[last_];
  if (is_at(here.place, x)) return here.slips;
  take_place(x, here.place);
  find_slips(x, here.place, kernels(), here.slips);
  return here.slips;
}

FrictionSet::Slips FrictionSet::slips(const double* x, const FrictionKernels& by) const {
  std::vector<Vec3> place;
  take_place(x, place);
  Slips result;
  find_slips(x, place, by, result);
  return result;
}

void FrictionSet::find_slips(const double* x,
                             const std::vector<Vec3>& place,
                             const FrictionKernels& by,
                             Slips& out) const {
  out.resize(entries_.size());
  std::vector<Vec3> delta(points_.size());
  for (std::size_t i = 0; i < delta.size(); ++i) delta[i] = place[i] - start_[i];
  by.find_slips(batches_.data(), batches_.size(), numbers(place), numbers(delta),
                model_->parameters().slip, numbers(out));
  for (const std::size_t e : alone_) out[e] = slip(entries_[e], x);
}

std::vector<Vec3> FrictionSet::changes(const Slips& at,
                                       const double* p,
                                       const FrictionKernels& by) const {
  std::vector<Vec3> motion;
  take_place(p, motion);
  std::vector<Vec3> result(entries_.size());
  by.find_changes(batches_.data(), batches_.size(), numbers(motion), numbers(at), numbers(result));
  for (const std::size_t e : alone_) {
    result[e] = tangential(change_of_slip(entries_[e], at[e].frames, p), entries_[e].n);
  }
  return result;
}

FrictionSet::Slip FrictionSet::slip(const Entry& k, const double* x) const {
  Slip at;
  // From displacements, which avoids cancellation: sum_i c_i delta_i minus the change of E a.
  std::array<Vec3, 7> delta;
  Vec3 s = Vec3::Zero();
  for (int i = 0; i < k.count; ++i) {
    delta[i] = row(x, k.points[i]) - row(x_start_, k.points[i]);
    s += k.c[i] * delta[i];
  }
  for (int l = 0; l < k.part_count; ++l) {
    const GapPart& part = k.parts[l];
    const Frame& frame = at.frames[l] = Frame(k, part, x);
    if (!part.turns) continue;
    const Vec3 change_1 = delta[part.edges[1]] - delta[part.edges[0]];
    const Vec3 change_2 = delta[part.edges[3]] - delta[part.edges[2]];
    const Vec3 e1_start = k.edge(part, 0, x_start_);
    s -= part.a[0] * change_1 + part.a[1] * change_2 +
         part.a[2] * (change_1.cross(frame.e2) + e1_start.cross(change_2));
  }
  at.s = k.s_start + s;
  at.w = k.w_start + tangential(s, k.n);
  at.law = friction_law(at.w.norm(), model_->parameters().slip);
  return at;
}

double FrictionSet::energy_change(const double* x0, const double* x1) const {
  const Slips& end = slips(x1);
  const Slips& start = slips(x0);  // both are cached
  double change = 0.0;
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    change += entries_[i].mu * entries_[i].lambda * (end[i].law.f0 - start[i].law.f0);
  }
  return change;
}

void FrictionSet::add_gradient(const double* x, double* g) const {
  const Slips& here = slips(x);
  for (std::size_t e = 0; e < entries_.size(); ++e) add_gradient(entries_[e], here[e], g);
}

void FrictionSet::add_gradient(const Entry& k, const Slip& at, double* g) const {
  const Vec3 force = (k.mu * k.lambda) * at.force();
  for (int i = 0; i < k.count; ++i) {
    Eigen::Map<Vec3>(g + 3 * k.points[i]) += k.c[i] * force;
  }
  for (int l = 0; l < k.part_count; ++l) {
    const GapPart& part = k.parts[l];
    k.add_edges(part, at.frames[l].pull_back(-part.a, force), g);
  }
}

void FrictionSet::expect(const double* x, const double* to) {
  // Prescribed points may complete any fraction t of their motion while the cloth slips: the slip is
  // w(t) = w(0) + t (w(1) - w(0)).
  std::vector<double> held(points_.empty() ? 0
                                           : 3 * (static_cast<std::size_t>(points_.back()) + 1));
  for (const Index v : points_) {
    Eigen::Map<Vec3>(held.data() + 3 * v) = row(model_->is_held({&v, 1}) ? x : to, v);
  }
  const double slip_scale = model_->parameters().slip;
  const FrictionLaw at_rest = friction_law(0.0, slip_scale);
  bool any = false;
  for (const Entry& k : entries_) {
    if (model_->is_of_moving_body(k.lag.pair.vertices)) {
      expected_.push_back(at_rest.f1_over_y);
      continue;
    }
    const Vec3 w = nearest_to_origin(slip(k, held.data()).w, slip(k, to).w);
    const FrictionLaw there = friction_law(w.norm(), slip_scale);
    expected_.push_back(there.f1_over_y);
    any = any || there.f1_over_y * w.norm() > kClose;
  }
  if (!any) return expected_.clear();
  duals_.assign(entries_.size(), Vec3::Zero());
  take_place(x, duals_at_);
}

double FrictionSet::stiffness(std::size_t entry, const Slip& at) const {
  return expected_.empty() || !at.w.isZero(0.0) ? at.law.f1_over_y : expected_[entry];
}

void FrictionSet::update_duals(const double* x, const double* p, double alpha, const double* to) {
  const Slips& end = slips(to);
  const Slips& start = slips(x);  // both are cached
  const bool go_on = has_duals(x);
  const std::vector<Vec3> change = changes(start, p, kernels());
  std::vector<Vec3> duals(entries_.size());
  bool any = false;
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    const FrictionLaw& law = start[i].law;
    const Vec3& w = start[i].w;
    const Vec3 v = go_on ? duals_[i] : start[i].force();
    const Vec3& dw = change[i];
    const Vec3 linear =
        stiffness(i, start[i]) * (w + dw) + (law.f2 / law.f1_over_y * w.dot(dw)) * v;
    duals[i] = v + std::min(alpha, 1.0) * (linear - v);
    duals[i] /= std::max(duals[i].norm(), 1.0);
    if (entries_[i].lambda < 0.0) duals[i] = end[i].force();
    any = any || (duals[i] - end[i].force()).norm() > kClose;
  }
  expected_.clear();
  duals_at_.clear();
  if (!any) return;
  duals_ = std::move(duals);
  take_place(to, duals_at_);
}

double FrictionSet::force_change(const double* x, const double* p) const {
  const Slips& here = slips(x);
  const std::vector<Vec3> change = changes(here, p, kernels());
  double largest = 0.0;
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    largest = std::max(largest, here[i].law.f1_over_y * change[i].norm());
  }
  return largest;
}

bool FrictionSet::has_duals(const double* x) const { return is_at(duals_at_, x); }

FrictionSet::Hessian FrictionSet::hessian(const Entry& k,
                                          const Slips& slips,
                                          Curvature curvature) const {
  const auto i = static_cast<std::size_t>(&k - entries_.data());
  const Slip& at = slips[i];
  Hessian h(k, at);
  const Mat3 identity = Mat3::Identity();
  if (curvature == Curvature::kPositive && k.lambda < 0.0) return h;
  const double strength = k.mu * k.lambda;
  const double q = curvature == Curvature::kExact ? at.law.f1_over_y : stiffness(i, at);
  h.core_ = (strength * q) * (identity - k.n * k.n.transpose());
  if (curvature == Curvature::kPositive) return h;
  if (curvature == Curvature::kPrimalDual && !duals_at_.empty()) {
    const Mat3 outer = duals_[i] * at.w.transpose();
    h.core_ += (0.5 * strength * at.law.f2 / at.law.f1_over_y) * (outer + outer.transpose());
    for (int l = 0; l < k.part_count; ++l) h.turn_[l] = (k.parts[l].a[2] * strength) * duals_[i];
    return h;
  }
  h.core_ += (strength * at.law.f2) * at.w * at.w.transpose();
  for (int l = 0; l < k.part_count; ++l) h.turn_[l] = (k.parts[l].a[2] * strength) * at.force();
  return h;
}

std::array<Mat3, 6> FrictionSet::Hessian::frame_changes() const {
  const Entry& k = *entry_;
  const Mat3 identity = Mat3::Identity();
  std::array<Mat3, 6> B;
  for (int l = 0; l < k.part_count; ++l) {
    const GapPart& part = k.parts[l];
    const Frame& frame = at_->frames[l];
    const Mat3 of_e1 = part.a[2] * cross_matrix(frame.e2) - part.a[0] * identity;
    const Mat3 of_e2 = -part.a[2] * cross_matrix(frame.e1) - part.a[1] * identity;
    for (int p = part.first; p < part.first + part.size; ++p) {
      B[p - k.frame] = k.c[p] * identity + part.sign(0, p) * of_e1 + part.sign(1, p) * of_e2;
    }
  }
  return B;
}

Mat3 FrictionSet::Hessian::turning(int p, int q) const {
  // Block of (e1, e2): cross product with `turn`; block of (e2, e1): its negative.
  const auto in = [](const GapPart& part, int i) {
    return i >= part.first && i < part.first + part.size;
  };
  for (int l = 0; l < entry_->part_count; ++l) {
    const GapPart& part = entry_->parts[l];
    if (!in(part, p) || !in(part, q)) continue;
    return (part.sign(0, p) * part.sign(1, q) - part.sign(1, p) * part.sign(0, q)) *
           cross_matrix(turn_[l]);
  }
  return Mat3::Zero();
}

void FrictionSet::Hessian::add_to(linalg::BlockMatrix& A) const {
  const Entry& k = *entry_;
  const int first = k.frame;
  const std::span<const Index> others = k.all_points().first(static_cast<std::size_t>(first));
  if (!A.has_any(k.all_points().subspan(others.size())) && !A.any_attached(others)) {
    // All frames belong to bodies with prescribed motion.
    A.add_rows(others, [&](int p, int q) -> Mat3 { return (k.c[p] * k.c[q]) * core_; });
    return;
  }
  const std::array<Mat3, 6> B = frame_changes();
  if (k.count > linalg::kStencilPoints || A.any_attached(k.all_points())) {
    std::array<Mat3, 7> jacobians;
    for (int p = 0; p < first; ++p) jacobians[p] = k.c[p] * Mat3::Identity();
    std::copy_n(B.begin(), k.count - first, jacobians.begin() + first);
    A.add_congruence(k.all_points(), jacobians, core_);
    for (int l = 0; l < k.part_count; ++l) {
      if (turn_[l].isZero(0.0)) continue;
      const GapPart& part = k.parts[l];
      std::array<Index, 4> frame{};
      for (int e = 0; e < 4; ++e) frame[e] = k.points[part.first + std::min(e, part.size - 1)];
      A.add_stencil(frame, [&](int p, int q) -> Mat3 {
        return p >= part.size || q >= part.size ? Mat3::Zero()
                                                : turning(part.first + p, part.first + q);
      });
    }
    return;
  }
  // Case of two cloths: one part of the gap, which rotates with vertices of one cloth.
  const GapPart& part = k.parts[0];
  Eigen::Matrix<double, 3, 16, Eigen::RowMajor> change;  // change of s with the points
  change.setZero();
  linalg::StencilTerms of;
  for (int p = 0; p < k.count; ++p) {
    if (p < first) {
      change.block<3, 3>(0, 3 * p).diagonal().setConstant(k.c[p]);
      continue;
    }
    change.block<3, 3>(0, 3 * p) = B[p - first];
    for (int e = 0; e < 2; ++e) of.sign[e][p] = part.sign(e, p);
  }
  of.count = k.count;
  of.terms = 3;
  for (int b = 0; b < 3; ++b) of.left[b] = change.row(b).data();
  of.core = core_.data();
  of.turn = turn_[0].data();
  A.add_terms(k.all_points(), of);
}

FrictionProduct FrictionSet::Hessian::factors(std::array<Mat3, 6>& B) const {
  B = frame_changes();
  FrictionProduct result{.point = entry_->points.data(),
                         .c = entry_->c.data(),
                         .frame = entry_->frame,
                         .count = entry_->count,
                         .B = {},
                         .core = core_.data(),
                         .part_count = entry_->part_count,
                         .edge = {},
                         .turn = {}};
  for (std::size_t p = 0; p < B.size(); ++p) result.B[p] = B[p].data();
  for (int l = 0; l < entry_->part_count; ++l) {
    result.edge[l] = entry_->parts[l].edges.data();
    result.turn[l] = turn_[l].data();
  }
  return result;
}

void FrictionSet::add_product(const Entry& k,
                              const Slips& slips,
                              const double* z,
                              double* y) const {
  const Slip& at = slips[static_cast<std::size_t>(&k - entries_.data())];
  const double strength = k.mu * k.lambda;
  const Vec3 change = change_of_slip(k, at.frames, z);
  const Vec3 force = strength * (at.law.f1_over_y * tangential(change, k.n) +
                                 (at.law.f2 * at.w.dot(change)) * at.w);
  for (int p = 0; p < k.count; ++p) {
    if (k.c[p] != 0.0) Eigen::Map<Vec3>(y + 3 * k.points[p]) += k.c[p] * force;
  }
  for (int l = 0; l < k.part_count; ++l) {
    const GapPart& part = k.parts[l];
    if (!part.turns) continue;
    auto [e1_bar, e2_bar] = at.frames[l].pull_back(-part.a, force);
    // Second derivative of the frame's rotation.
    const Vec3 turn = (part.a[2] * strength) * at.force();
    const Frame turned(k, part, z);
    e1_bar += turn.cross(turned.e2);
    e2_bar += turned.e1.cross(turn);
    k.add_edges(part, {e1_bar, e2_bar}, y);
  }
}

namespace {

/// Pull the cotangent of a normal force back. Returns the cotangents of the corners; if parameters are
/// chosen, adds the cotangents of the parameters, times scale, to `bar`.
///
///   d(lambda) = -kappa w (2 d b' dm + m (2 d b'' + b'/d) dD)
Vec12 pull_back_lambda(const ContactModel& model,
                       const Contact& lag,
                       const double* x_lag,
                       double lambda_bar,
                       double scale,
                       FrictionSet::DiffWrt inputs,
                       ContactModel::Bar* bar) {
  const double kappa = lag.kappa;
  const double d = std::sqrt(lag.closest.d_sq);
  const double area = lag.weight;
  const double m = lag.mollifier;
  const double b1 = lag.barrier.b1;
  const double per_lambda = -2.0 * d * lambda_bar;
  Vec12 x_bar = (lambda_bar * -kappa * area * m * (2.0 * d * lag.barrier.b2 + b1 / d)) *
                distance_sq_gradient(lag.closest);
  double threshold_bar = 0.0;
  if (lag.mollified) {
    const Mollifier mol = mollifier_derivatives(corners(lag.pair.vertices, x_lag), lag.threshold);
    threshold_bar = per_lambda * kappa * area * mol.m_eps * b1;
    x_bar += (per_lambda * kappa * area * b1) * mol.gradient;
  }
  if (inputs == FrictionSet::DiffWrt::kPoints) return x_bar;
  model.pull_back_kappa(lag.pair, scale * per_lambda * area * m * b1, *bar);
  bar->d_hat += scale * per_lambda * kappa * area * m * lag.barrier.b1_d_hat;
  const double xi_bar = per_lambda * kappa * area * m * lag.barrier.b1_xi;
  model.pull_back(lag, scale * per_lambda * kappa * m * b1, scale * threshold_bar, scale * xi_bar,
                  *bar);
  return x_bar;
}

/// Pull cotangents of the gap t and the coefficients c of a contact back to its corners.
void pull_back_gap(const Closest& geometry, const Vec3& t_bar, const Vec4& c_bar, Vec12& x_bar) {
  for (int i = 0; i < 4; ++i) x_bar.segment<3>(3 * i) += geometry.c[i] * t_bar;
  if (geometry.parameter_count == 0) return;
  Vec2 beta_bar = geometry.s.transpose() * t_bar + geometry.c_beta.transpose() * c_bar;
  if (geometry.parameter_count == 1) beta_bar[1] = 0.0;
  x_bar += beta_jacobian(geometry).transpose() * beta_bar;
}

}  // namespace

// With L marking the lag configuration, Q = E_L E(x_start)^-1 for each part, and r" = r', or r" =
// r(x_start) if the frame rotates so far that n . Q n is clamped:
//
//   l max(n . Q n, 1/2) = d - n . Q r(x_start)
//   dl = (n . dt - dn . (Q r" + l Q^T n) - n . Q dr - n . dQ r") / (n . Q n),   dr of r(x_start),
//   n . dQ r" = n . dE_L b" - Q^T n . dE(x_start) b",   b" = E(x_start)^-1 share r",
//
// without the term l Q^T n in the clamped case.
FrictionSet::ExtensionDerivative FrictionSet::extension_derivative(const Entry& k) const {
  const Vec3& n = k.n;
  const Vec3 turned = k.turned(n);
  const Vec3 back = k.turned_back(n);
  const bool is_exact = n.dot(turned) >= kLeastAlong;
  const double scale = 1.0 / std::max(n.dot(turned), kLeastAlong);
  const double extension = is_exact ? k.extension : 0.0;

  ExtensionDerivative by;
  for (int l = 0; l < k.part_count; ++l) {
    const GapPart& part = k.parts[l];
    by.by_lag_edges[l].fill(Vec3::Zero());
    by.by_start_edges[l].fill(Vec3::Zero());
    if (!part.turns) continue;
    const Frame start(k, part, x_start_);
    Vec3 b = part.b;
    if (!is_exact) b -= part.share * start.coordinates(k.extension * n);
    by.by_lag_edges[l] = Frame(k, part, x_lag_).pull_back(-scale * b, n);
    by.by_start_edges[l] = start.pull_back(scale * b, part.turn.transpose() * n);
  }
  by.by_t = scale * n;
  by.by_n = -scale * (k.turned(k.gap(x_start_) + extension * n) + extension * back);
  by.by_r = -scale * back;
  return by;
}

// phi = mu lambda q(|w|) w . zeta,  q = f1/y,  w = P s,  s = r(x) - E(x) a - E_L b,  zeta = r(z) - E'(z)
// a, with E = (e1, e2, m), its change E' with z, a = E_L^-1 share t and b = E(x_start)^-1 share r';
// summed over both parts if there are two.
//
//   dphi/dw    = mu lambda (q zeta + f2 (w . zeta) w) =: omega      (f2 = q'/y)
//   dphi/ds    = P omega,   dphi/dn = -(n.s) omega - (n.omega) s,   dphi/dzeta = mu lambda q w =: eta
//   dphi/da = -E^T P omega - E'^T eta,   dphi/dt = share y + beta n,   y = E_L^-T dphi/da
//   dphi/d(Q r') = -V = -(P omega + beta n),   beta = -(P omega) . Q n / (n . Q n) through l
//   dphi/dr(x_start) = -Q^T V =: h,   dphi/dn += l h - beta Q r'
//   dphi/dc_i  = (P omega) . x_i + eta . z_i + h . x_start_i,   dphi/dx_start = c_i h
//
// minus the contributions of frame edges through E_L a, Q b and E(x_start) b; if n . Q n is clamped, l
// does not depend on it (see extension_derivative()). The lag configuration changes c through d(beta) =
// J dx, n through dn = P dt / d with dt = sum c_i dx_i + s d(beta), and lambda as in pull_back_lambda().
void FrictionSet::add_mixed(
    const double* x, const double* z, double scale, DiffWrt inputs, const Cotangents& out) const {
  const Slips& here = slips(x);
  for (std::size_t e = 0; e < entries_.size(); ++e) {
    const Entry& k = entries_[e];
    const Contact& lag = k.lag;
    const Closest& geometry = lag.closest;
    const auto& v = lag.pair.vertices;
    const double d = std::sqrt(geometry.d_sq);

    const Slip& at = here[e];
    const FrictionLaw& law = at.law;
    std::array<Frame, 2> changes;
    Vec3 zeta = k.gap(z);
    for (int l = 0; l < k.part_count; ++l) {
      const GapPart& part = k.parts[l];
      const Frame& frame = at.frames[l];
      Frame& change = changes[l] = Frame(k, part, z);
      change.m = change.e1.cross(frame.e2) + frame.e1.cross(change.e2);  // not of its own edges
      zeta = zeta - part.a[0] * change.e1 - part.a[1] * change.e2 - part.a[2] * change.m;
    }
    const double w_zeta = at.w.dot(zeta);

    const double lambda_bar = k.mu * law.f1_over_y * w_zeta;
    if (inputs == DiffWrt::kPointsAndParameters) {
      const double mu_bar = k.lambda * law.f1_over_y * w_zeta;
      out.parameters->slip += scale * k.mu * k.lambda * law.f1_over_y_e * w_zeta;
      model_->pull_back_mu(lag.pair, scale * mu_bar, *out.parameters);
    }

    Vec12 x_bar = pull_back_lambda(*model_, lag, x_lag_, lambda_bar, scale, inputs, out.parameters);

    // Cotangents of the frame at the start, of c and of n.
    const double strength = k.mu * k.lambda;
    const Vec3 omega = strength * (law.f1_over_y * zeta + law.f2 * w_zeta * at.w);
    const Vec3 eta = (strength * law.f1_over_y) * at.w;
    const Vec3 s_bar = tangential(omega, k.n);
    const Vec3 n_turned = k.turned(k.n);
    const double along = k.n.dot(n_turned);
    const double beta = -s_bar.dot(n_turned) / std::max(along, kLeastAlong);
    const Vec3 V = s_bar + beta * k.n;
    const Vec3 h = -k.turned_back(V);
    Vec3 n_bar = -k.n.dot(at.s) * omega - k.n.dot(omega) * at.s + k.extension * h -
                 beta * k.turned(k.gap(x_start_) + k.extension * k.n);
    Vec3 t_bar = beta * k.n;
    for (int l = 0; l < k.part_count; ++l) {
      const GapPart& part = k.parts[l];
      if (!part.turns) continue;
      const Frame& frame = at.frames[l];
      const Frame& change = changes[l];
      const Frame lag_frame(k, part, x_lag_);
      const Frame start(k, part, x_start_);
      const Vec3 y = lag_frame.dual(Vec3(-frame.transposed(s_bar) - change.transposed(eta)));
      t_bar += part.share * y;
      std::array<Vec3, 2> lag_edges = lag_frame.pull_back(-scale * part.a, y);
      lag_edges = sum(lag_edges, lag_frame.pull_back(-scale * part.b, V));
      std::array<Vec3, 2> start_edges = start.pull_back(scale * part.b, part.turn.transpose() * V);
      if (along < kLeastAlong) {
        const Vec3 b = (scale * beta * part.share) * start.coordinates(k.extension * k.n);
        lag_edges = sum(lag_edges, lag_frame.pull_back(b, k.n));
        start_edges = sum(start_edges, start.pull_back(-b, part.turn.transpose() * k.n));
      }
      k.add_edges(part, lag_edges, out.lag);
      k.add_edges(part, start_edges, out.start);
    }
    if (along < kLeastAlong) n_bar += (k.extension * beta) * (n_turned + k.turned_back(k.n));
    t_bar += tangential(n_bar, k.n) / d;
    Vec4 c_bar;
    for (int i = 0; i < 4; ++i) {
      const auto from_first = [&](const double* rows) -> Vec3 {
        return row(rows, v[i]) - row(rows, v[0]);
      };
      c_bar[i] = s_bar.dot(from_first(x)) + eta.dot(from_first(z)) + h.dot(from_first(x_start_));
      Eigen::Map<Vec3>(out.start + 3 * v[i]) += scale * geometry.c[i] * h;
    }
    pull_back_gap(geometry, t_bar, c_bar, x_bar);
    for (int i = 0; i < 4; ++i) {
      Eigen::Map<Vec3>(out.lag + 3 * v[i]) += scale * x_bar.segment<3>(3 * i);
    }
  }
}

}  // namespace diffcloth::contact
