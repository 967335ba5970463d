#include "contact/contact_set.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include <Eigen/Eigenvalues>

#include "common/outer_product.h"
#include "contact/distance/mollifier.h"
#include "contact/pair_distances.h"

namespace diffcloth::contact {

Corners corners(const std::array<Index, 4>& v, const double* x) {
  return {row(x, v[0]), row(x, v[1]), row(x, v[2]), row(x, v[3])};
}

Vec12 stacked(const std::array<Index, 4>& v, const double* z) {
  Vec12 result;
  for (int i = 0; i < 4; ++i) result.segment<3>(3 * i) = row(z, v[i]);
  return result;
}

namespace {

void scatter(const std::array<Index, 4>& v, const Vec12& g, double* out) {
  for (int i = 0; i < 4; ++i) Eigen::Map<Vec3>(out + 3 * v[i]) += g.segment<3>(3 * i);
}

}  // namespace

ContactModel::ContactModel(const CollisionMesh& mesh,
                           const FeatureWeights& weights,
                           const RestMeasures& rest,
                           Parameters parameters,
                           const std::vector<char>& prescribed)
    : mesh_(mesh),
      weights_(weights),
      rest_(rest),
      parameters_(std::move(parameters)),
      prescribed_(prescribed) {
  for (std::size_t s = 0; s < parameters_.thickness.size(); ++s) {
    reach_.push_back(0.5 * (parameters_.d_hat + parameters_.thickness[s]) + mesh.radius[s]);
  }
}

double ContactModel::xi(const Candidate& pair) const {
  const Index a = surface_a(pair);
  const Index b = surface_b(pair);
  return 0.5 * (parameters_.thickness[a] + parameters_.thickness[b]) +
         (mesh_.radius[a] + mesh_.radius[b]);
}

double ContactModel::mean_entry(const std::vector<double>& values, const Candidate& pair) const {
  const Index surfaces = mesh_.surface_count();
  const Index a = surface_a(pair);
  const Index b = surface_b(pair);
  return 0.5 * (values[a * surfaces + b] + values[b * surfaces + a]);
}

void ContactModel::pull_back_mean_entry(const Candidate& pair,
                                        double mean_bar,
                                        std::vector<double>& bar) const {
  const Index surfaces = mesh_.surface_count();
  const Index a = surface_a(pair);
  const Index b = surface_b(pair);
  bar[a * surfaces + b] += 0.5 * mean_bar;
  bar[b * surfaces + a] += 0.5 * mean_bar;
}

bool ContactModel::between_cloths(const Candidate& pair) const {
  return surface_a(pair) < mesh_.cloth_count && surface_b(pair) < mesh_.cloth_count;
}

bool ContactModel::between_bodies(const Candidate& pair) const {
  return surface_a(pair) >= mesh_.cloth_count && surface_b(pair) >= mesh_.cloth_count;
}

// Factor between a contact's coefficient and its weight.
double ContactModel::area(const Candidate& pair) const {
  return between_bodies(pair) ? 1.0 : area(pair, rest_);  // there its coefficient is the weight
}

double ContactModel::area(const Candidate& pair, const RestMeasures& rest) const {
  if (pair.kind == PairKind::kPointTriangle) {
    const Index p = pair.vertices[0];
    if (is_round_on_cloth(pair)) return rest.face_area[pair.b];
    return p < mesh_.cloth_vertex_count ? rest.vertex_area[p]
                                        : rest.mean_face_area[surface_b(pair)];
  }
  if (!between_cloths(pair)) return rest.edge_area[pair.a];
  return rest.edge_area[pair.a] + rest.edge_area[pair.b];
}

double ContactModel::threshold(const Candidate& pair) const {
  if (pair.kind == PairKind::kPointTriangle || pair.b < 0) return 0.0;
  return mollifier_threshold(rest_.edge_length_sq[pair.a], rest_.edge_length_sq[pair.b],
                             mesh_.is_round_edge(pair.a) || mesh_.is_round_edge(pair.b));
}

void ContactModel::pull_back_area(const Contact& k, double area_bar, RestMeasures& rest) const {
  const Candidate& pair = k.pair;
  if (between_bodies(pair)) return;
  if (pair.kind == PairKind::kEdgeEdge) {
    rest.edge_area[pair.a] += area_bar;
    if (between_cloths(pair)) rest.edge_area[pair.b] += area_bar;
    return;
  }
  const Index p = pair.vertices[0];
  if (is_round_on_cloth(pair)) {
    rest.face_area[pair.b] += area_bar;
  } else if (p < mesh_.cloth_vertex_count) {
    rest.vertex_area[p] += area_bar;
  } else {
    rest.mean_face_area[surface_b(pair)] += area_bar;
  }
}

void ContactModel::pull_back(
    const Contact& k, double weight_bar, double threshold_bar, double xi_bar, Bar& bar) const {
  const Candidate& pair = k.pair;
  bar.thickness[surface_a(pair)] += 0.5 * xi_bar;
  bar.thickness[surface_b(pair)] += 0.5 * xi_bar;
  pull_back_area(k, k.coefficient * weight_bar, bar.rest);
  if (!k.mollified) return;
  // The threshold is a number times |U|^2 |V|^2.
  RestMeasures& rest = bar.rest;
  rest.edge_length_sq[pair.a] += threshold_bar * k.threshold / rest_.edge_length_sq[pair.a];
  rest.edge_length_sq[pair.b] += threshold_bar * k.threshold / rest_.edge_length_sq[pair.b];
}

ContactModel::ContactTangent ContactModel::push_forward(const Contact& k, const Bar& dot) const {
  const Candidate& pair = k.pair;
  ContactTangent tangent{
      .kappa = mean_entry(dot.kappa, pair),
      .weight = k.coefficient * (between_bodies(pair) ? 0.0 : area(pair, dot.rest)),
      .threshold = 0.0,
      .xi = 0.5 * (dot.thickness[surface_a(pair)] + dot.thickness[surface_b(pair)])};
  if (k.mollified) {
    for (const Index e : {pair.a, pair.b}) {
      tangent.threshold += k.threshold * dot.rest.edge_length_sq[e] / rest_.edge_length_sq[e];
    }
  }
  return tangent;
}

ContactModel::Bar::Bar(const CollisionMesh& mesh) : rest(RestMeasures::zero(mesh)) {
  const auto surfaces = static_cast<std::size_t>(mesh.surface_count());
  thickness.assign(surfaces, 0.0);
  kappa.assign(surfaces * surfaces, 0.0);
  friction.assign(surfaces * surfaces, 0.0);
}

std::size_t ContactModel::group_end(const std::vector<Candidate>& candidates,
                                    std::size_t first) const {
  const Candidate& head = candidates[first];
  std::size_t end = first + 1;
  if (is_alone(head)) return end;
  while (end < candidates.size() && candidates[end].kind == head.kind &&
         candidates[end].a == head.a && surface_b(candidates[end]) == surface_b(head)) {
    ++end;
  }
  return end;
}

void ContactModel::add_own_term(const Candidate& pair,
                                const double* x,
                                std::vector<Term>& out) const {
  if (std::ranges::all_of(pair.vertices, [&](Index v) { return prescribed_[v] != 0; })) return;
  const double range = parameters_.d_hat + xi(pair);
  const double d_sq = closest_points(pair.kind, corners(pair.vertices, x)).d_sq;
  if (d_sq < range * range) out.push_back({.pair = pair, .coefficient = 0.25, .d_sq = d_sq});
}

/// A point of a skeleton against another skeleton. For two spheres one of the two pairs is kept. For a
/// sphere and a capsule the center against the capsule is kept, because the capsule's ends do not cover
/// it. For two capsules the ends of each against the other are kept, besides the pair of segments.
void ContactModel::add_skeleton_term(const Candidate& pair,
                                     const double* x,
                                     std::vector<Term>& out) const {
  const auto& [p, i, j, k] = pair.vertices;
  const bool is_point_b = i == j;
  const bool is_point_a = mesh_.is_point(surface_a(pair));
  if (is_point_b && (!is_point_a || surface_a(pair) > surface_b(pair))) return;
  const double range = parameters_.d_hat + xi(pair);
  const double d_sq = closest_points(pair.kind, corners(pair.vertices, x)).d_sq;
  if (!(d_sq < range * range)) return;
  Candidate own = pair;
  own.b = -1;  // no face has the area
  out.push_back(
      {.pair = own, .coefficient = 0.25 * weights_.vertex_area(p, surface_b(pair)), .d_sq = d_sq});
}

/// Terms of a group of candidates.
void ContactModel::find_terms(std::span<const Candidate> group,
                              const double* x,
                              MergeScratch& scratch,
                              std::vector<Term>& out) const {
  const Candidate& head = group.front();
  if (is_alone(head)) {
    add_own_term(head, x, out);
    return;
  }
  const double range = parameters_.d_hat + xi(head);
  const Index a = head.vertices[0];
  // The vertices of a body are all prescribed or all free.
  const bool edges = head.kind == PairKind::kEdgeEdge;
  const bool prescribed_a = prescribed_[a] != 0 && (!edges || prescribed_[head.vertices[1]] != 0);
  const bool body_b = surface_b(head) >= mesh_.cloth_count;
  if (prescribed_a && body_b && prescribed_[head.vertices[3]] != 0) return;
  if (edges) {
    add_edge_terms(mesh_, weights_, group, rest_.edge_length_sq, x, range, 0.5, scratch, out);
    return;
  }
  if (body_b && mesh_.is_round(surface_b(head))) {
    for (const Candidate& pair : group) add_skeleton_term(pair, x, out);
    return;
  }
  double w = 1.0;
  if (a >= mesh_.cloth_vertex_count) {
    w = body_b ? weights_.vertex_area(a, surface_b(head))
               : weights_.vertex_sharpness(surface_b(head), a);
  }
  if (w == 0.0) return;
  add_point_terms(mesh_, weights_.features(prescribed_a), group, x, range, 0.25 * w, scratch, out);
}

Contact ContactModel::contact(const Term& term, const double* x) const {
  const Candidate& pair = term.pair;
  Corners corner = corners(pair.vertices, x);
  const double xi_pair = xi(pair);
  Contact k{.pair = pair,
            .coefficient = term.coefficient,
            .weight = term.coefficient * area(pair),
            .threshold = threshold(pair),
            .xi = xi_pair,
            .kappa = kappa(pair),
            .closest = {},
            .barrier = {},
            .mollifier = 1.0,
            .mollified = false};
  if (pair.kind == PairKind::kEdgeEdge && mollified(corner, k.threshold)) {
    k.mollified = true;
    k.mollifier = mollifier(corner, k.threshold);
  }
  for (int side = 0; side < 2; ++side) {
    // Distance from one end of an edge: collapse the edge to this end.
    const std::int8_t end = term.ends[side];
    if (end >= 0) corner[2 * side + 1 - end] = corner[2 * side + end];
  }
  k.closest = closest(pair.kind, corner);
  for (int side = 0; side < 2; ++side) {
    // closest() assigns a collapsed edge to its first corner: swap if the end is the second.
    if (term.ends[side] != 1) continue;
    k.closest.c.segment<2>(2 * side).reverseInPlace();
    k.closest.c_beta.middleRows<2>(2 * side).colwise().reverseInPlace();
  }
  k.barrier = barrier_derivatives(k.closest.d_sq, xi_pair, parameters_.d_hat);
  return k;
}

/// Sorted candidates within reach at x, and a few more.
std::vector<Candidate> ContactModel::near_ones(const std::vector<Candidate>& candidates,
                                               const double* x) const {
  // Exceeds the relative difference between the two ways to compute a distance.
  constexpr double kClearly = 1.0 + 1e-6;
  std::vector<double> range_sq;  // for each pair of surfaces
  for (const double a : reach_) {
    for (const double b : reach_) range_sq.push_back(kClearly * (a + b) * (a + b));
  }
  const std::vector<double> d_sq = distances_sq(candidates, x);
  std::vector<Candidate> near;
  near.reserve(candidates.size());
  for (std::size_t k = 0; k < candidates.size(); ++k) {
    const Candidate& pair = candidates[k];
    const Index surfaces = surface_a(pair) * mesh_.surface_count() + surface_b(pair);
    if (!(d_sq[k] > range_sq[surfaces])) near.push_back(pair);
  }
  return near;
}

void ContactModel::measure(const std::vector<Candidate>& all, const double* x, Near& out) const {
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  out.terms.clear();
  out.energies.clear();
  const std::vector<Candidate> candidates = near_ones(all, x);
  MergeScratch scratch;
  for (std::size_t first = 0, last = 0; first < candidates.size(); first = last) {
    last = group_end(candidates, first);
    const std::size_t begin = out.terms.size();
    const double stiffness = kappa(candidates[first]);  // of one pair of surfaces
    find_terms({candidates.data() + first, last - first}, x, scratch, out.terms);
    double sum = 0.0;
    for (std::size_t k = begin; k < out.terms.size(); ++k) {
      const Term& term = out.terms[k];
      const double b = barrier(term.d_sq, xi(term.pair), parameters_.d_hat);
      if (b == kInfinity) {
        // Infinite whatever the factor, which may be zero for exactly parallel edges, or negative.
        sum = b;
        break;
      }
      const double eps = threshold(term.pair);
      const double m = eps > 0.0 ? mollifier(corners(term.pair.vertices, x), eps) : 1.0;
      sum += stiffness * (term.coefficient * area(term.pair)) * m * b;
    }
    if (sum == 0.0) continue;
    const Candidate& head = candidates[first];
    out.energies.push_back({.kind = head.kind,
                            .a = head.a,
                            .surface = surface_b(head),
                            .b = is_alone(head) ? head.b : -1,
                            .value = sum});
  }
}

void ContactModel::find(const Near& near, const double* x, std::vector<Contact>& out) const {
  std::vector<Term> terms = near.terms;
  merge_shared_ends(terms);
  out.clear();
  out.reserve(terms.size());
  for (const Term& term : terms) out.push_back(contact(term, x));
}

double Near::energy() const {
  double sum = 0.0;
  for (const Energy& e : energies) sum += e.value;
  return sum;
}

double energy_change(const Near& p, const Near& q) {
  double change = 0.0;
  for_each_energy(p, q, [&](double e_p, double e_q) { change += e_q - e_p; });
  return change;
}

void ContactModel::add_gradient(const std::vector<Contact>& contacts,
                                const double* x,
                                double* g) const {
  for (const Contact& k : contacts) {
    const double scale = k.kappa * k.weight;
    if (k.mollified) {
      const Mollifier m = mollifier_derivatives(corners(k.pair.vertices, x), k.threshold);
      const Vec12 gradient =
          scale * (k.barrier.b * m.gradient + m.m * k.barrier.b1 * distance_sq_gradient(k.closest));
      scatter(k.pair.vertices, gradient, g);
      continue;
    }
    const Vec3 force = (2.0 * scale * k.barrier.b1) * k.closest.t;
    for (int i = 0; i < 4; ++i) {
      if (k.closest.c[i] == 0.0) continue;
      Eigen::Map<Vec3>(g + 3 * k.pair.vertices[i]) += k.closest.c[i] * force;
    }
  }
}

namespace {

// Positive part of b'' grad D grad D^T + b' hess D. With n = t/d and orthonormal tangents s_k (and
// c'_k with respect to them), and b' <= 0,
//
//   (b'' + b'/(2D)) grad D grad D^T                                       along the normal
//   + 2 |b'| d sum_k (p_k q_k^T + q_k p_k^T + d q_k q_k^T)                as the normal turns
//   - 2 |b'| c c^T (x) (other tangents)                                   negative: left out
//
// with p_k = c (x) s_k orthogonal to q_k = c'_k (x) n. Each k is a 2x2 form with one positive
// eigenvalue. Without the second line a contact pressed hard slides until it is blocked.
template <class Add>
void visit_positive_part(const Closest& k, double b1, double b2, Add&& add) {
  add(std::max(b2 + b1 / (2.0 * k.d_sq), 0.0), distance_sq_gradient(k));
  const double d = std::sqrt(k.d_sq);
  const Vec3 n = k.t / d;
  const double p_sq = k.c.squaredNorm();
  Eigen::Matrix<double, 3, 2> s = k.s;
  Eigen::Matrix<double, 4, 2> c = k.c_beta;
  for (int a = 0; a < k.parameter_count; ++a) {
    if (a == 1) {  // Gram-Schmidt
      const double along = s.col(0).dot(s.col(1));
      s.col(1) -= along * s.col(0);
      c.col(1) -= along * c.col(0);
    }
    const double length = s.col(a).norm();
    s.col(a) /= length;
    c.col(a) /= length;
    const double q_sq = c.col(a).squaredNorm();
    // In the orthonormal basis p/|p|, q/|q|: [[0, |p||q|], [|p||q|, d |q|^2]].
    const double off = std::sqrt(p_sq * q_sq);
    const double corner = d * q_sq;
    const double eigenvalue = 0.5 * (corner + std::sqrt(corner * corner + 4.0 * off * off));
    const double norm = std::sqrt(off * off + eigenvalue * eigenvalue);
    const double along_p = off / (norm * std::sqrt(p_sq));
    const double along_q = eigenvalue / (norm * std::sqrt(q_sq));
    Vec12 v;
    for (int i = 0; i < 4; ++i) {
      v.segment<3>(3 * i) = along_p * k.c[i] * s.col(a) + along_q * c(i, a) * n;
    }
    add(2.0 * std::abs(b1) * d * eigenvalue, v);
  }
}

/// Symmetric matrix with its negative eigenvalues set to zero.
Mat12 positive_part(const Mat12& h) {
  const Eigen::SelfAdjointEigenSolver<Mat12> eigen(h);
  const Mat12& vectors = eigen.eigenvectors();
  return vectors * eigen.eigenvalues().cwiseMax(0.0).asDiagonal() * vectors.transpose();
}

}  // namespace

Mat3 ContactHessian::operator()(int p, int q) const {
  Mat3 h = (along_ * c_[p] * c_[q]) * Mat3::Identity();
  for (int k = 0; k < count_; ++k) {
    add_outer_product(left_[k].segment<3>(3 * p), right_[k].segment<3>(3 * q), h);
  }
  if (rest_) h += rest_->block<3, 3>(3 * p, 3 * q);
  return h;
}

void ContactHessian::add_to(linalg::BlockMatrix& A, const std::array<Index, 4>& points) const {
  // Only features of skeletons repeat their last point.
  if (A.any_attached(points) || points[2] == points[3]) {
    A.add_stencil(points, *this);
    return;
  }
  linalg::StencilTerms of;
  of.terms = count_;
  for (int k = 0; k < count_; ++k) {
    of.left[k] = left_[k].data();
    of.right[k] = right_[k].data();
  }
  of.along = along_;
  of.c = c_.data();
  if (rest_) of.rest = rest_->data();
  A.add_terms(points, of);
}

Mat12 ContactHessian::dense() const {
  Mat12 h;
  for (int p = 0; p < 4; ++p) {
    for (int q = 0; q < 4; ++q) h.block<3, 3>(3 * p, 3 * q) = (*this)(p, q);
  }
  return h;
}

Vec12 ContactHessian::operator*(const Vec12& z) const {
  Vec12 y = Vec12::Zero();
  if (along_ != 0.0) {
    Vec3 sum = Vec3::Zero();
    for (int q = 0; q < 4; ++q) sum += c_[q] * z.segment<3>(3 * q);
    for (int p = 0; p < 4; ++p) y.segment<3>(3 * p) = (along_ * c_[p]) * sum;
  }
  for (int k = 0; k < count_; ++k) y += right_[k].dot(z) * left_[k];
  if (rest_) y += rest_->lazyProduct(z);
  return y;
}

ContactProduct ContactHessian::factors(const std::array<Index, 4>& points) const {
  return {.point = {points[0], points[1], points[2], points[3]},
          .count = count_,
          .left = {left_[0].data(), left_[1].data(), left_[2].data()},
          .right = {right_[0].data(), right_[1].data(), right_[2].data()},
          .c = c_.data(),
          .along = along_,
          .rest = rest_ ? rest_->data() : nullptr};
}

void ContactHessian::add(const Vec12& left, const Vec12& right) {
  left_[count_] = left;
  right_[count_++] = right;
}

ContactHessian ContactModel::hessian(const Contact& k, const double* x, Curvature curvature) const {
  ContactHessian h;
  const double scale = k.kappa * k.weight;
  const double b1 = scale * k.mollifier * k.barrier.b1;
  const double b2 = scale * k.mollifier * k.barrier.b2;
  if (curvature == Curvature::kPositive) {
    if (scale <= 0.0) return h;
    if (k.mollified) {
      h.rest_ = positive_part(hessian(k, x, Curvature::kExact).dense());
      return h;
    }
    visit_positive_part(k.closest, b1, b2, [&](double w, const Vec12& u) { h.add(w * u, u); });
    return h;
  }
  const Vec12 d_gradient = distance_sq_gradient(k.closest);
  h.add(b2 * d_gradient, d_gradient);
  h.c_ = k.closest.c;
  h.along_ = 2.0 * b1;
  if (k.closest.parameter_count > 0) {
    const Sliding part = sliding(k.closest);
    for (int a = 0; a < k.closest.parameter_count; ++a) {
      h.add(b1 * part.left.col(a), part.right.col(a));
    }
  }
  if (k.mollified) {
    const Mollifier m = mollifier_derivatives(corners(k.pair.vertices, x), k.threshold);
    const Mat12 cross = m.gradient * d_gradient.transpose();
    h.rest_ = scale * (k.barrier.b * m.hessian + k.barrier.b1 * (cross + cross.transpose()));
  }
  return h;
}

std::vector<char> ContactModel::moving_surfaces() const {
  std::vector<char> moves(reach_.size(), 0);
  for (Index v = 0; v < mesh_.vertex_count; ++v) {
    if (prescribed_[v] == 0) moves[mesh_.vertex_surface[v]] = 1;
  }
  return moves;
}

bool ContactModel::is_held(std::span<const Index> points) const {
  return std::ranges::any_of(
      points, [&](Index v) { return v >= mesh_.cloth_vertex_count || prescribed_[v] != 0; });
}

bool ContactModel::is_of_moving_body(std::span<const Index> points) const {
  return std::ranges::any_of(
      points, [&](Index v) { return v >= mesh_.cloth_vertex_count && prescribed_[v] == 0; });
}

std::array<Index, 3> ContactModel::frame(const Candidate& pair) const {
  const auto& v = pair.vertices;
  if (between_cloths(pair)) {
    if (pair.kind == PairKind::kPointTriangle) return {v[1], v[2], v[3]};
    const CollisionMesh::Face& face = mesh_.faces[mesh_.edge_faces[pair.b][0]];
    const auto third = std::ranges::find_if(face, [&](Index i) { return i != v[2] && i != v[3]; });
    return {v[2], v[3], *third};
  }
  const Index a = surface_a(pair);
  const Index b = surface_b(pair);
  const bool takes_a =
      mesh_.is_round(a) != mesh_.is_round(b) && between_bodies(pair)
          ? mesh_.is_round(a)
          : b < mesh_.cloth_count || (between_bodies(pair) && prescribed_[v[0]] != 0);
  return weights_.carriers(takes_a ? a : b);
}

double ContactModel::first_share(const Candidate& pair) const {
  const double a = mesh_.radius[surface_a(pair)];
  const double b = mesh_.radius[surface_b(pair)];
  return a > 0.0 && b > 0.0 ? a / (a + b) : -1.0;
}

// B = kappa w m b, summed over contacts. The bodies' fractions of areas are constant while features do
// not change.
void ContactModel::add_energy_bars(const std::vector<Contact>& contacts,
                                   const double* x,
                                   double scale,
                                   Bar& bar) const {
  for (const Contact& k : contacts) {
    const double m = k.mollifier;
    const double per_b = scale * k.kappa * k.weight * m;
    double threshold_bar = 0.0;
    if (k.mollified) {
      const Mollifier by = mollifier_derivatives(corners(k.pair.vertices, x), k.threshold);
      threshold_bar = scale * k.kappa * k.weight * by.m_eps * k.barrier.b;
    }
    pull_back_kappa(k.pair, scale * k.weight * m * k.barrier.b, bar);
    bar.d_hat += per_b * k.barrier.b_d_hat;
    pull_back(k, scale * k.kappa * m * k.barrier.b, threshold_bar, per_b * k.barrier.b_xi, bar);
  }
}

// phi = z . grad B = kappa w (b (grad m . z) + m b' (grad D . z)), and its partial derivatives.
void ContactModel::add_mixed(const std::vector<Contact>& contacts,
                             const double* x,
                             const double* z,
                             double scale,
                             Bar& bar) const {
  for (const Contact& k : contacts) {
    const double kappa = k.kappa;
    const Vec12 z_pair = stacked(k.pair.vertices, z);
    const double d_z = distance_sq_gradient(k.closest).dot(z_pair);
    double m_z = 0.0;
    double threshold_bar = 0.0;
    if (k.mollified) {
      const Mollifier m = mollifier_derivatives(corners(k.pair.vertices, x), k.threshold);
      m_z = m.gradient.dot(z_pair);
      threshold_bar = kappa * k.weight *
                      (k.barrier.b * m.gradient_eps.dot(z_pair) + m.m_eps * k.barrier.b1 * d_z);
    }
    const double m = k.mollifier;
    const double per_weight = k.barrier.b * m_z + m * k.barrier.b1 * d_z;
    pull_back_kappa(k.pair, scale * k.weight * per_weight, bar);
    bar.d_hat +=
        scale * kappa * k.weight * (k.barrier.b_d_hat * m_z + m * k.barrier.b1_d_hat * d_z);
    const double xi_bar = kappa * k.weight * (k.barrier.b_xi * m_z + m * k.barrier.b1_xi * d_z);
    pull_back(k, scale * kappa * per_weight, scale * threshold_bar, scale * xi_bar, bar);
  }
}

// grad B = kappa w (b grad m + m b' grad D).
void ContactModel::add_tangents(const std::vector<Contact>& contacts,
                                const double* x,
                                std::span<const Bar* const> directions,
                                std::span<double* const> y) const {
  for (const Contact& k : contacts) {
    const Vec12 d_gradient = distance_sq_gradient(k.closest);
    std::optional<Mollifier> m;
    if (k.mollified) m = mollifier_derivatives(corners(k.pair.vertices, x), k.threshold);
    for (std::size_t l = 0; l < directions.size(); ++l) {
      const Bar& dot = *directions[l];
      const ContactTangent tangent = push_forward(k, dot);
      const Barrier& b = k.barrier;
      const double scale = k.kappa * k.weight;
      const double scale_dot = tangent.kappa * k.weight + k.kappa * tangent.weight;
      const double b_dot = b.b_d_hat * dot.d_hat + b.b_xi * tangent.xi;
      const double b1_dot = b.b1_d_hat * dot.d_hat + b.b1_xi * tangent.xi;
      double along_d = k.mollifier * (scale_dot * b.b1 + scale * b1_dot);
      Vec12 change = Vec12::Zero();
      if (m) {
        along_d += scale * m->m_eps * tangent.threshold * b.b1;
        change = (scale_dot * b.b + scale * b_dot) * m->gradient +
                 (scale * b.b * tangent.threshold) * m->gradient_eps;
      }
      change += along_d * d_gradient;
      scatter(k.pair.vertices, change, y[l]);
    }
  }
}

}  // namespace diffcloth::contact
