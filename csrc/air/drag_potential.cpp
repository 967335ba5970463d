#include "air/drag_potential.h"

#include <algorithm>
#include <utility>

namespace diffcloth::air {
namespace {

using Face = std::array<Index, 3>;

Vec3 sum_of_corners(const Face& face, const double* rows) {
  return row(rows, face[0]) + row(rows, face[1]) + row(rows, face[2]);
}

void add_to_corners(const Face& face, const Vec3& value, double* rows) {
  for (const Index i : face) Eigen::Map<Vec3>(rows + 3 * i) += value;
}

Vec3 edge(const Face& face, int p, const double* rows) {
  return row(rows, face[p]) - row(rows, face[0]);
}

}  // namespace

DragPotential::DragPotential(Flow flow, Index vertex_count, bool of_coefficients)
    : across_bar(flow.faces.size(), 0.0),
      along_bar(flow.faces.size(), 0.0),
      start_bar(3 * static_cast<std::size_t>(vertex_count), 0.0),
      velocity_bar(flow.velocities != nullptr ? start_bar.size() : 0, 0.0),
      wind_bar(3, 0.0),
      flow_(std::move(flow)),
      span_(flow_.velocities != nullptr ? 2.0 * flow_.h : flow_.h),
      size_(3 * static_cast<std::size_t>(vertex_count)),
      of_coefficients_(of_coefficients) {
  for (std::size_t f = 0; f < flow_.faces.size(); ++f) {
    if (flow_.across[f] != 0.0 || flow_.along[f] != 0.0)
      with_drag_.push_back(static_cast<Index>(f));
  }
}

const std::vector<FaceDrag>& DragPotential::drags() const {
  if (!drags_.empty()) return drags_;
  drags_.reserve(flow_.faces.size());
  for (std::size_t f = 0; f < flow_.faces.size(); ++f) {
    const Face& face = flow_.faces[f];
    const Vec3 N = edge(face, 1, flow_.start).cross(edge(face, 2, flow_.start));
    drags_.emplace_back(N, flow_.across[f], flow_.along[f]);
  }
  return drags_;
}

/// Velocity u of a face.
Vec3 DragPotential::velocity(Index f, const double* x) const {
  Vec3 moved = Vec3::Zero();
  for (const Index i : flow_.faces[f]) {
    moved += row(x, i) - row(flow_.start, i);
    if (flow_.velocities != nullptr) moved += flow_.h * row(flow_.velocities, i);
  }
  return moved / (3.0 * span_) - flow_.wind;
}

double DragPotential::energy(const double* x) const {
  double sum = 0.0;
  for (const Index f : with_drag_) sum += drags()[f].power(velocity(f, x));
  return span_ * sum;
}

double DragPotential::energy_change(const double* x, const double* to) const {
  double sum = 0.0;
  for (const Index f : with_drag_) {
    Vec3 moved = Vec3::Zero();
    for (const Index i : flow_.faces[f]) moved += row(to, i) - row(x, i);
    sum += drags()[f].power_change(velocity(f, x), velocity(f, to), moved / (3.0 * span_));
  }
  return span_ * sum;
}

void DragPotential::add_gradient(const double* x, double* g) const {
  for (const Index f : with_drag_) {
    add_to_corners(flow_.faces[f], drags()[f].force(velocity(f, x)) / 3.0, g);
  }
}

void DragPotential::add_hessian(const double* x,
                                Curvature /*curvature*/,
                                linalg::BlockMatrix& A) const {
  for (const Index f : with_drag_) {
    const Mat3 block = drags()[f].slope(velocity(f, x)) / (9.0 * span_);
    A.add_rows(flow_.faces[f], [&](int /*p*/, int /*q*/) -> const Mat3& { return block; });
  }
}

void DragPotential::add_product(Index f, const Mat3& slope, const double* z, double* y) const {
  const Vec3 sum = sum_of_corners(flow_.faces[f], z);
  if (sum.isZero(0.0)) return;
  add_to_corners(flow_.faces[f], slope * sum / (9.0 * span_), y);
}

void DragPotential::add_hessian_product(const double* x, const double* z, double* y) const {
  for (const Index f : with_drag_) add_product(f, drags()[f].slope(velocity(f, x)), z, y);
}

void DragPotential::add_held_product(const double* x, const double* z, double* y) const {
  if (flow_.held == nullptr) {
    add_hessian_product(x, z, y);
    return;
  }
  for (const Index f : *flow_.held) {
    if (flow_.across[f] == 0.0 && flow_.along[f] == 0.0) continue;
    add_product(f, drags()[f].slope(velocity(f, x)), z, y);
  }
}

void DragPotential::accumulate(const double* x, const double* z) {
  // z . grad P = sum_f z_f . grad D_f,  z_f the mean of the corners' z.
  const auto add = [&](Index f) {
    const FaceDrag& face = drags()[f];
    const Vec3 u = velocity(f, x);
    const Vec3 z_f = sum_of_corners(flow_.faces[f], z) / 3.0;
    across_bar[f] -= z_f.dot(face.by_across(u));
    along_bar[f] -= z_f.dot(face.by_along(u));
    if (face.across == 0.0 && face.along == 0.0) return;
    const Vec3 minus_u_bar = face.slope(u) * z_f;
    Eigen::Map<Vec3>(wind_bar.data()) += minus_u_bar;
    add_to_corners(flow_.faces[f], minus_u_bar / (3.0 * span_), start_bar.data());
    if (!velocity_bar.empty()) {
      add_to_corners(flow_.faces[f], -flow_.h / (3.0 * span_) * minus_u_bar, velocity_bar.data());
    }
    add_frame_bar(f, -face.frame_bar(u, z_f));
  };
  if (of_coefficients_) {
    for (std::size_t f = 0; f < flow_.faces.size(); ++f) add(static_cast<Index>(f));
  } else {
    for (const Index f : with_drag_) add(f);
  }
}

const std::vector<DragPotential::Derivative>& DragPotential::derivatives(const double* x) const {
  if (!derivatives_at_.empty() && std::ranges::equal(derivatives_at_, std::span(x, size_))) {
    return derivatives_;
  }
  derivatives_at_.assign(x, x + size_);
  derivatives_.clear();
  derivatives_.reserve(with_drag_.size());
  for (const Index f : with_drag_) {
    const Vec3 u = velocity(f, x);
    Derivative of{.u = u, .by_velocity = drags()[f].slope(u), .by_frame = {}};
    for (int k = 0; k < 3; ++k) of.by_frame.col(k) = drags()[f].frame_change(u, Vec3::Unit(k));
    derivatives_.push_back(of);
  }
  return derivatives_;
}

void DragPotential::add_tangent(const double* x, double* y) const {
  const auto by_coefficients = [&](Index f, const Vec3& u) -> Vec3 {
    return across_dot[f] * drags()[f].by_across(u) + along_dot[f] * drags()[f].by_along(u);
  };
  const auto is_zero = [](double value) { return value == 0.0; };
  if (with_drag_.empty() && std::ranges::all_of(across_dot, is_zero) &&
      std::ranges::all_of(along_dot, is_zero)) {
    return;
  }
  const std::vector<Derivative>& here = derivatives(x);
  auto next = with_drag_.begin();
  for (std::size_t k = 0; k < flow_.faces.size(); ++k) {
    const auto f = static_cast<Index>(k);
    const bool drags = next != with_drag_.end() && *next == f;
    const bool changes = across_dot[k] != 0.0 || along_dot[k] != 0.0;
    if (!drags && !changes) continue;
    Vec3 change = Vec3::Zero();
    if (drags) {
      const Derivative& of = here[next - with_drag_.begin()];
      ++next;
      Vec3 moved = -sum_of_corners(flow_.faces[k], start_dot.data());
      if (flow_.velocities != nullptr) {
        moved += flow_.h * sum_of_corners(flow_.faces[k], velocity_dot.data());
      }
      const Vec3 u_dot = moved / (3.0 * span_) - wind_dot;
      change = of.by_velocity * u_dot + of.by_frame * frame_dot(f);
      if (changes) change += by_coefficients(f, of.u);
    } else {
      change = by_coefficients(f, velocity(f, x));
    }
    add_to_corners(flow_.faces[k], change / 3.0, y);
  }
}

void DragPotential::swap_cotangents(CotangentStore& store) {
  store.exchange(across_bar);
  store.exchange(along_bar);
  store.exchange(start_bar);
  store.exchange(velocity_bar);
  store.exchange(wind_bar);
}

/// Pull the cotangent of N = e_1 x e_2 back to x_n.
void DragPotential::add_frame_bar(Index f, const Vec3& N_bar) {
  const Face& face = flow_.faces[f];
  const Vec3 first = edge(face, 2, flow_.start).cross(N_bar);
  const Vec3 second = N_bar.cross(edge(face, 1, flow_.start));
  Eigen::Map<Vec3>(start_bar.data() + 3 * face[0]) -= first + second;
  Eigen::Map<Vec3>(start_bar.data() + 3 * face[1]) += first;
  Eigen::Map<Vec3>(start_bar.data() + 3 * face[2]) += second;
}

/// Tangent of N.
Vec3 DragPotential::frame_dot(Index f) const {
  const Face& face = flow_.faces[f];
  const double* const dot = start_dot.data();
  return edge(face, 1, dot).cross(edge(face, 2, flow_.start)) +
         edge(face, 1, flow_.start).cross(edge(face, 2, dot));
}

}  // namespace diffcloth::air
