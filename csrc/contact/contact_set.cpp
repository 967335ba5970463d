#include "contact/contact_set.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "contact/distance/mollifier.h"

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
                           const RestMeasures& rest,
                           Parameters parameters,
                           const std::vector<char>& prescribed)
    : mesh_(mesh), rest_(rest), parameters_(std::move(parameters)), prescribed_(prescribed) {
  double thickest = 0.0;
  for (const double t : parameters_.thickness) thickest = std::max(thickest, t);
  reach_ = parameters_.d_hat + thickest;
}

double ContactModel::xi(const Candidate& pair) const {
  return 0.5 * (parameters_.thickness[surface_a(pair)] + parameters_.thickness[surface_b(pair)]);
}

double ContactModel::mu(const Candidate& pair) const {
  const auto surfaces = static_cast<Index>(parameters_.thickness.size());
  const Index a = surface_a(pair);
  const Index b = surface_b(pair);
  return 0.5 * (parameters_.friction[a * surfaces + b] + parameters_.friction[b * surfaces + a]);
}

bool ContactModel::inert(const Candidate& pair) const {
  return std::ranges::all_of(pair.vertices, [&](Index v) { return prescribed_[v] != 0; });
}

bool ContactModel::has_prescribed(const std::array<Index, 4>& vertices) const {
  return std::ranges::any_of(vertices, [&](Index v) { return prescribed_[v] != 0; });
}

// Weights (3-contact, 3.3): point-triangle A_p/4, edge-edge (A_a + A_b)/4. A body's coarse areas
// must not dominate: edge-edge takes the cloth edge's half, a body vertex on a cloth face the
// smaller of the two.
double ContactModel::weight(const Candidate& pair) const {
  if (pair.kind == PairKind::kPointTriangle) {
    const Index p = pair.vertices[0];
    if (p < mesh_.cloth_vertex_count) return 0.25 * rest_.vertex_area[p];
    return 0.25 * std::min(rest_.vertex_area[p], rest_.face_area[pair.b]);
  }
  if (pair.a >= mesh_.cloth_edge_count) return 0.5 * rest_.edge_area[pair.b];
  if (pair.b >= mesh_.cloth_edge_count) return 0.5 * rest_.edge_area[pair.a];
  return 0.25 * (rest_.edge_area[pair.a] + rest_.edge_area[pair.b]);
}

double ContactModel::threshold(const Candidate& pair) const {
  if (pair.kind == PairKind::kPointTriangle) return 0.0;
  return mollifier_threshold(rest_.edge_length_sq[pair.a], rest_.edge_length_sq[pair.b]);
}

void ContactModel::pull_back(
    const Candidate& pair, double weight_bar, double threshold_bar, double xi_bar, Bar& bar) const {
  bar.thickness[surface_a(pair)] += 0.5 * xi_bar;
  bar.thickness[surface_b(pair)] += 0.5 * xi_bar;
  RestMeasures& rest = bar.rest;
  if (pair.kind == PairKind::kPointTriangle) {
    const Index p = pair.vertices[0];
    if (p < mesh_.cloth_vertex_count || rest_.vertex_area[p] <= rest_.face_area[pair.b]) {
      rest.vertex_area[p] += 0.25 * weight_bar;
    } else {
      rest.face_area[pair.b] += 0.25 * weight_bar;
    }
    return;
  }
  if (pair.a >= mesh_.cloth_edge_count) {
    rest.edge_area[pair.b] += 0.5 * weight_bar;
  } else if (pair.b >= mesh_.cloth_edge_count) {
    rest.edge_area[pair.a] += 0.5 * weight_bar;
  } else {
    rest.edge_area[pair.a] += 0.25 * weight_bar;
    rest.edge_area[pair.b] += 0.25 * weight_bar;
  }
  // The threshold is 1e-3 |U|^2 |V|^2.
  const double eps = threshold(pair);
  rest.edge_length_sq[pair.a] += threshold_bar * eps / rest_.edge_length_sq[pair.a];
  rest.edge_length_sq[pair.b] += threshold_bar * eps / rest_.edge_length_sq[pair.b];
}

void ContactModel::pull_back_mu(const Candidate& pair, double mu_bar, Bar& bar) const {
  const auto surfaces = static_cast<Index>(parameters_.thickness.size());
  const Index a = surface_a(pair);
  const Index b = surface_b(pair);
  bar.friction[a * surfaces + b] += 0.5 * mu_bar;
  bar.friction[b * surfaces + a] += 0.5 * mu_bar;
}

ContactModel::Bar::Bar(const CollisionMesh& mesh, const RestMeasures& like) {
  const auto surfaces =
      static_cast<std::size_t>(mesh.vertex_surface.empty() ? 0 : mesh.vertex_surface.back() + 1);
  thickness.assign(surfaces, 0.0);
  friction.assign(surfaces * surfaces, 0.0);
  rest.vertex_area.assign(like.vertex_area.size(), 0.0);
  rest.edge_area.assign(like.edge_area.size(), 0.0);
  rest.edge_length_sq.assign(like.edge_length_sq.size(), 0.0);
  rest.face_area.assign(like.face_area.size(), 0.0);
}

void ContactModel::find(const std::vector<Candidate>& candidates,
                        const double* x,
                        std::vector<Contact>& out) const {
  out.clear();
  for (const Candidate& pair : candidates) {
    if (inert(pair)) continue;
    const Corners corner = corners(pair.vertices, x);
    const Closest geometry = closest(pair.kind, corner);
    const double xi_pair = xi(pair);
    const double range = parameters_.d_hat + xi_pair;
    if (!(geometry.d_sq < range * range)) continue;
    Contact contact{.pair = pair,
                    .weight = weight(pair),
                    .threshold = threshold(pair),
                    .xi = xi_pair,
                    .closest = geometry,
                    .barrier = barrier_derivatives(geometry.d_sq, xi_pair, parameters_.d_hat),
                    .mollifier = 1.0,
                    .mollified = false};
    if (pair.kind == PairKind::kEdgeEdge && mollified(corner, contact.threshold)) {
      contact.mollified = true;
      contact.mollifier = mollifier(corner, contact.threshold);
    }
    out.push_back(contact);
  }
}

void ContactModel::energies(const std::vector<Candidate>& candidates,
                            const double* x,
                            std::vector<double>& out) const {
  out.assign(candidates.size(), 0.0);
  for (std::size_t k = 0; k < candidates.size(); ++k) {
    const Candidate& pair = candidates[k];
    if (inert(pair)) continue;
    const Corners corner = corners(pair.vertices, x);
    const double d_sq = closest(pair.kind, corner).d_sq;
    const double xi_pair = xi(pair);
    const double range = parameters_.d_hat + xi_pair;
    if (!(d_sq < range * range)) continue;
    const double m = pair.kind == PairKind::kEdgeEdge ? mollifier(corner, threshold(pair)) : 1.0;
    const double b = barrier(d_sq, xi_pair, parameters_.d_hat);
    // 0 * infinity for exactly parallel edges that touch: still infeasible.
    out[k] =
        b == std::numeric_limits<double>::infinity() ? b : parameters_.kappa * weight(pair) * m * b;
  }
}

void ContactModel::add_gradient(const std::vector<Contact>& contacts,
                                const double* x,
                                double* g) const {
  for (const Contact& k : contacts) {
    const double scale = parameters_.kappa * k.weight;
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
Mat12 positive_hessian(const Closest& k, double b1, double b2) {
  const Vec12 gradient = distance_sq_gradient(k);
  Mat12 h = std::max(b2 + b1 / (2.0 * k.d_sq), 0.0) * gradient * gradient.transpose();
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
    h.noalias() += (2.0 * std::abs(b1) * d * eigenvalue) * v * v.transpose();
  }
  return h;
}

}  // namespace

Mat12 ContactModel::hessian(const Contact& k, const double* x, Curvature curvature) const {
  const double scale = parameters_.kappa * k.weight;
  const double b1 = k.barrier.b1;
  const double b2 = k.barrier.b2;
  if (curvature == Curvature::kPositive) {
    return scale * k.mollifier * positive_hessian(k.closest, b1, b2);
  }
  const Vec12 d_gradient = distance_sq_gradient(k.closest);
  Mat12 h = (k.mollifier * b2) * d_gradient * d_gradient.transpose() +
            (k.mollifier * b1) * distance_sq_hessian(k.closest);
  if (k.mollified) {
    const Mollifier m = mollifier_derivatives(corners(k.pair.vertices, x), k.threshold);
    const Mat12 cross = m.gradient * d_gradient.transpose();
    h += k.barrier.b * m.hessian + b1 * (cross + cross.transpose());
  }
  return scale * h;
}

void ContactModel::add_hessian_product(const std::vector<Contact>& contacts,
                                       const double* x,
                                       const double* z,
                                       double* y) const {
  for (const Contact& k : contacts) {
    scatter(k.pair.vertices, hessian(k, x, Curvature::kExact) * stacked(k.pair.vertices, z), y);
  }
}

// phi = z . grad B = kappa w (b (grad m . z) + m b' (grad D . z)), and its partial derivatives.
void ContactModel::add_mixed(const std::vector<Contact>& contacts,
                             const double* x,
                             const double* z,
                             double scale,
                             Bar& bar) const {
  const double kappa = parameters_.kappa;
  for (const Contact& k : contacts) {
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
    bar.kappa += scale * k.weight * per_weight;
    bar.d_hat +=
        scale * kappa * k.weight * (k.barrier.b_d_hat * m_z + m * k.barrier.b1_d_hat * d_z);
    const double xi_bar = kappa * k.weight * (k.barrier.b_xi * m_z + m * k.barrier.b1_xi * d_z);
    pull_back(k.pair, scale * kappa * per_weight, scale * threshold_bar, scale * xi_bar, bar);
  }
}

}  // namespace diffcloth::contact
