#include "solver/coordinates.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

#include "solver/stopping.h"

namespace diffcloth::solver {
namespace {

/// Largest absolute value; NaN counts as infinite.
double largest(const double* first, const double* last) {
  // Independent lanes, without branches: the loop is as fast as it reads.
  constexpr std::ptrdiff_t kLanes = 8;
  std::array<double, kLanes> most{};
  std::array<double, kLanes> zero{};  // NaN from the first NaN or infinity on
  const auto add = [&](std::ptrdiff_t lane, double value) {
    const double size = std::abs(value);
    most[lane] = size > most[lane] ? size : most[lane];
    zero[lane] += value * 0.0;
  };
  for (; last - first >= kLanes; first += kLanes) {
    for (std::ptrdiff_t lane = 0; lane < kLanes; ++lane) add(lane, first[lane]);
  }
  for (std::ptrdiff_t lane = 0; lane < last - first; ++lane) add(lane, first[lane]);
  for (const double value : zero) {
    if (std::isnan(value)) return std::numeric_limits<double>::infinity();
  }
  return *std::ranges::max_element(most);
}

}  // namespace

Coordinates::Coordinates(Index cloth_vertex_count,
                         Index vertex_count,
                         const bodies::Mechanisms& mechanisms,
                         const std::vector<char>& prescribed)
    : cloth_vertex_count_(cloth_vertex_count),
      vertex_count_(vertex_count),
      mechanisms_(&mechanisms),
      prescribed_(&prescribed) {
  attachments_.first = cloth_vertex_count_;
  if (is_curved()) {
    attachments_ = mechanisms_->attachments(cloth_vertex_count_, cloth_vertex_count_);
  }
}

void Coordinates::take_rows(const std::vector<double>& x, std::vector<double>& z) const {
  z.assign(x.begin(), x.begin() + body_offset());
  const auto nodes = x.begin() + node_offset();
  z.insert(z.end(), nodes, nodes + 3 * static_cast<std::ptrdiff_t>(mechanisms_->node_count()));
}

void Coordinates::put_rows(const double* z, std::vector<double>& x) const {
  std::copy_n(z, body_offset(), x.begin());
  std::copy_n(z + body_offset(), 3 * static_cast<std::ptrdiff_t>(mechanisms_->node_count()),
              x.begin() + node_offset());
}

void Coordinates::add_rows(const std::vector<double>& z, std::vector<double>& x) const {
  for (Index i = 0; i < row_count(); ++i) {
    for (int a = 0; a < 3; ++a) x[3 * point(i) + a] += z[3 * i + a];
  }
}

void Coordinates::clear_rows(std::vector<double>& x) const {
  std::fill_n(x.begin(), body_offset(), 0.0);
  std::fill_n(x.begin() + node_offset(), 3 * static_cast<std::ptrdiff_t>(mechanisms_->node_count()),
              0.0);
}

void Coordinates::place(std::vector<double>& x) const {
  if (!mechanisms_->empty()) mechanisms_->place(nodes(x), x.data() + body_offset());
}

void Coordinates::stand_at(const double* x) {
  if (!is_curved()) return;
  mechanisms_->differentiate(x + node_offset(), cloth_vertex_count_, attachments_);
}

void Coordinates::push_forward(const std::vector<double>& dz, std::vector<double>& dx) const {
  dx.assign(3 * prescribed_->size(), 0.0);
  for (Index i = 0; i < row_count(); ++i) {
    if (!is_free(i)) continue;
    for (int a = 0; a < 3; ++a) dx[3 * point(i) + a] = dz[3 * i + a];
  }
  if (!is_curved()) return;
  for (Index v = cloth_vertex_count_; v < vertex_count_; ++v) {
    Vec3 change = Vec3::Zero();
    for (const auto* e = attachments_.begin(v); e != attachments_.end(v); ++e) {
      change += e->jacobian * row(dz.data(), e->row);
    }
    Eigen::Map<Vec3>(dx.data() + 3 * v) = change;
  }
}

void Coordinates::follow(const std::vector<double>& x, std::vector<double>& dx) const {
  if (!is_curved()) return;
  std::vector<double> change(static_cast<std::size_t>(node_offset() - body_offset()), 0.0);
  mechanisms_->push_forward(nodes(x), nodes(dx), change.data());
  for (Index v = cloth_vertex_count_; v < vertex_count_; ++v) {
    // Surfaces that are prescribed as a whole have their change already.
    if ((*prescribed_)[v] != 0) continue;
    Eigen::Map<Vec3>(dx.data() + 3 * v) += row(change.data(), v - cloth_vertex_count_);
  }
}

void Coordinates::pull_back(const std::vector<double>& g, std::vector<double>& g_z) const {
  g_z.assign(size(), 0.0);
  for (Index i = 0; i < row_count(); ++i) {
    if (!is_free(i)) continue;
    for (int a = 0; a < 3; ++a) g_z[3 * i + a] = g[3 * point(i) + a];
  }
  if (!is_curved()) return;
  for (Index v = cloth_vertex_count_; v < vertex_count_; ++v) {
    const Vec3 g_v = row(g.data(), v);
    for (const auto* e = attachments_.begin(v); e != attachments_.end(v); ++e) {
      Eigen::Map<Vec3>(g_z.data() + 3 * e->row) += e->jacobian.transpose() * g_v;
    }
  }
}

void Coordinates::gather(const std::vector<double>& x, std::vector<double>& bar) const {
  if (mechanisms_->empty()) return;
  mechanisms_->pull_back(nodes(x), bar.data() + body_offset(), nodes(bar));
  mechanisms_->clear(bar.data() + body_offset());
}

void Coordinates::carry(const std::vector<double>& x, std::vector<double>& dx) const {
  if (!mechanisms_->empty()) {
    mechanisms_->push_forward(nodes(x), nodes(dx), dx.data() + body_offset());
  }
}

void Coordinates::add_change(const std::vector<double>& x,
                             const std::vector<double>& dx,
                             const std::vector<double>& g,
                             std::vector<double>& g_dot) const {
  mechanisms_->push_forward_change(nodes(x), nodes(dx), g.data() + body_offset(), nodes(g_dot));
}

void Coordinates::subtract_change(const std::vector<double>& x,
                                  const std::vector<double>& dx,
                                  const std::vector<double>& g,
                                  std::vector<double>& bar) const {
  std::vector<double> change(bar.size() - static_cast<std::size_t>(node_offset()), 0.0);
  mechanisms_->pull_back_change(nodes(x), nodes(dx), g.data() + body_offset(), change.data());
  for (std::size_t k = 0; k < change.size(); ++k) nodes(bar)[k] -= change[k];
}

void Coordinates::add_curvature(const double* x,
                                const std::vector<double>& g,
                                linalg::BlockMatrix& A) const {
  if (!is_curved()) return;
  mechanisms_->visit_curvature(
      x + node_offset(), g.data() + body_offset(), [&](Index i, Index j, const Mat3& block) {
        A.add_block(cloth_vertex_count_ + i, cloth_vertex_count_ + j, block);
      });
}

linalg::Couplings Coordinates::couplings_of_rows(linalg::Couplings points) const {
  if (!is_curved()) {
    std::erase_if(points, [&](const std::pair<Index, Index>& pair) {
      // The greater index comes first.
      return pair.first >= cloth_vertex_count_ || !is_free(pair.first) || !is_free(pair.second);
    });
    return points;
  }
  linalg::Couplings rows;
  rows.reserve(points.size());
  std::vector<Index> of_i;
  std::vector<Index> of_j;
  const auto rows_of = [&](Index v, std::vector<Index>& out) {
    out.clear();
    if (v < cloth_vertex_count_) {
      if (is_free(v)) out.push_back(v);
    } else {
      for (const auto* e = attachments_.begin(v); e != attachments_.end(v); ++e) {
        out.push_back(e->row);
      }
    }
  };
  for (const auto& [i, j] : points) {
    rows_of(i, of_i);
    rows_of(j, of_j);
    for (const Index r : of_i) {
      for (const Index s : of_j) {
        if (r != s) rows.emplace_back(std::max(r, s), std::min(r, s));
      }
    }
  }
  return rows;
}

void Coordinates::retract(const std::vector<double>& x,
                          const std::vector<double>& dx,
                          double alpha,
                          std::vector<double>& out) const {
  out.resize(x.size());
  for (std::size_t a = 0; a < x.size(); ++a) out[a] = x[a] + alpha * dx[a];
  if (!is_curved()) return;
  std::vector<double> vertices(out.begin() + body_offset(), out.begin() + node_offset());
  mechanisms_->place(nodes(out), vertices.data());
  for (Index v = cloth_vertex_count_; v < vertex_count_; ++v) {
    if ((*prescribed_)[v] != 0) continue;
    Eigen::Map<Vec3>(out.data() + 3 * v) = row(vertices.data(), v - cloth_vertex_count_);
  }
}

double Coordinates::largest_fraction(const std::vector<double>& x,
                                     const std::vector<double>& dx) const {
  if (!is_curved()) return std::numeric_limits<double>::infinity();
  double fraction = stopping::kJointSteps.largest_turn / mechanisms_->turn(nodes(dx));
  const bodies::MechanismsDescription& given = mechanisms_->given();
  for (Index c = 0; c < mechanisms_->coordinate_count(); ++c) {
    const double zone = given.limit_zone * (given.upper[c] - given.lower[c]);
    if (given.prescribed[c] != 0 || !std::isfinite(zone)) continue;
    const double q = nodes(x)[mechanisms_->slot(c)];
    const double change = nodes(dx)[mechanisms_->slot(c)];
    const double left = change > 0.0 ? given.upper[c] + zone - q : q - given.lower[c] + zone;
    if (std::abs(change) > 0.0) {
      fraction = std::min(fraction, stopping::kJointSteps.share_of_limit * left / std::abs(change));
    }
  }
  return fraction;
}

bool Coordinates::is_curved(const std::vector<double>& dx) const {
  const double* const first = nodes(dx);
  return is_curved() &&
         std::any_of(first, first + 3 * static_cast<std::ptrdiff_t>(mechanisms_->node_count()),
                     [](double change) { return change != 0.0; });
}

double Coordinates::displacement(const std::vector<double>& dx) const {
  double result = largest(dx.data(), dx.data() + node_offset());
  const std::vector<double>& lever = mechanisms_->lever();
  for (std::size_t k = 0; k < lever.size(); ++k) {
    const double change = lever[k] * nodes(dx)[k];
    if (std::isnan(change)) return std::numeric_limits<double>::infinity();
    result = std::max(result, std::abs(change));
  }
  return result;
}

double Coordinates::extent(const std::vector<double>& x) const {
  return largest(x.data(), x.data() + node_offset());
}

}  // namespace diffcloth::solver
