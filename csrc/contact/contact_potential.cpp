#include "contact/contact_potential.h"

#include <algorithm>
#include <cmath>
#include <span>
#include <utility>

#include "contact/ccd.h"
#include "contact/direction_lanes.h"

namespace diffcloth::contact {
namespace {

/// Pairs within the sum of their reaches and this fraction of d_hat may be in contact soon.
constexpr double kSoon = 0.4;

/// A motion that distorts a surface by more than this multiple of its size is watched in parts.
constexpr double kTorn = 1.0;
/// Distortion of the first part, in sizes of the surface, and growth factor of each next part.
constexpr double kFirstPart = 1.0 / 16.0;
constexpr double kNextPart = 4.0;
/// Number of pairs between two reads of the clock, which cost a tenth of a microsecond each.
constexpr int kPairsAtOnce = 64;

using Stencil = std::array<Index, 4>;

/// Largest deviation of a vertex's displacement from the mean of its surface, in sizes of the surface:
/// the maximum over all surfaces. NaN counts as zero.
double distortion(const CollisionMesh& mesh, const double* x, const double* to) {
  double result = 0.0;
  for (Index first = 0, last = 0; first < mesh.vertex_count; first = last) {
    const Index surface = mesh.vertex_surface[first];
    Vec3 mean = Vec3::Zero();
    Vec3 lo = row(x, first);
    Vec3 hi = lo;
    for (; last < mesh.vertex_count && mesh.vertex_surface[last] == surface; ++last) {
      mean += row(to, last) - row(x, last);
      lo = lo.cwiseMin(row(x, last));
      hi = hi.cwiseMax(row(x, last));
    }
    mean /= last - first;
    double deviation = 0.0;
    for (Index v = first; v < last; ++v) {
      deviation = std::max(deviation, (row(to, v) - row(x, v) - mean).squaredNorm());
    }
    const double size = (hi - lo).squaredNorm();
    if (size > 0.0) result = std::max(result, std::sqrt(deviation / size));
  }
  return result;
}

void add_stencil_couplings(std::span<const Index> v, linalg::Couplings& pairs) {
  for (const Index i : v) {
    for (const Index j : v) {
      if (i > j) pairs.emplace_back(i, j);
    }
  }
}

bool moves(std::span<const Index> v, const double* d) {
  return std::ranges::any_of(v, [&](Index i) { return !row(d, i).isZero(0.0); });
}

bool moves(std::span<const Index> v, const Products& products) {
  return std::ranges::any_of(products.z, [&](const double* d) { return moves(v, d); });
}

/// Multiply by Hessians of contacts: calls multiply(kernels, z, y) with the rows of directions side by
/// side.
template <class Multiply>
void multiply_side_by_side(const Products& products, Index vertex_count, Multiply multiply) {
  const std::size_t size = 3 * static_cast<std::size_t>(vertex_count);
  for_direction_groups(products.size(),
                       [&](const DirectionKernels& kernels, std::size_t first, std::size_t count) {
                         DirectionRows z(kernels, size);
                         DirectionRows y(kernels, size);
                         z.read(products.z.subspan(first, count));
                         y.read(products.y.subspan(first, count));
                         multiply(kernels, z.data(), y.data());
                         y.write(products.y.subspan(first, count));
                       });
}

template <class Hessian>
void add_stencil_product(const Stencil& v, const Hessian& h, const double* d, double* y) {
  const Vec12 product = h * stacked(v, d);
  for (int i = 0; i < 4; ++i) Eigen::Map<Vec3>(y + 3 * v[i]) += product.segment<3>(3 * i);
}

}  // namespace

double ContactPotential::largest_coordinate(const double* x) const {
  const auto size = 3 * static_cast<std::ptrdiff_t>(model_.mesh().vertex_count);
  return size == 0 ? 0.0 : Eigen::Map<const Eigen::ArrayXd>(x, size).abs().maxCoeff();
}

template <class Visit>
void ContactPotential::visit_approaching(const double* x, const double* to, Visit&& visit) const {
  const double largest = std::max(largest_coordinate(x), largest_coordinate(to));
  const double d_hat = model_.parameters().d_hat;
  const double most = 2.0 * std::ranges::max(model_.reach()) - d_hat;  // largest xi
  const double harmless_to_all = harmless_distance(most, d_hat, largest);
  int visited = 0;
  for (std::size_t k = 0; k < found_.pairs.size(); ++k) {
    if (found_.apart[k] > harmless_to_all) continue;
    const Candidate& pair = found_.pairs[k];
    const double xi = model_.xi(pair);
    if (found_.apart[k] > harmless_distance(xi, d_hat, largest)) continue;
    if (++visited % kPairsAtOnce == 0 && detection_.checkpoint) detection_.checkpoint->check();
    if (!visit(pair, xi)) return;
  }
}

double ContactPotential::watch_free(const double* x, const double* to) {
  const double by = distortion(model_.mesh(), x, to);
  if (!std::isfinite(by)) {  // an overflow: no part of the motion can be certified
    watch(x, x);
    return 0.0;
  }
  std::vector<double> part;
  double fraction = by > kTorn ? kFirstPart / by : 1.0;
  for (;; fraction = std::min(1.0, kNextPart * fraction)) {
    const double* end = to;
    if (fraction < 1.0) {
      part.resize(3 * static_cast<std::size_t>(model_.mesh().vertex_count));
      for (std::size_t a = 0; a < part.size(); ++a) part[a] = x[a] + fraction * (to[a] - x[a]);
      end = part.data();
    }
    watch(x, end);
    const double safe = safe_fraction(x, end);
    if (safe < 1.0 || fraction == 1.0) return fraction * safe;
  }
}

double ContactPotential::safe_fraction(const double* x, const double* to) const {
  double alpha = 1.0;
  visit_approaching(x, to, [&](const Candidate& pair, double xi) {
    alpha = safe_step(pair.kind, corners(pair.vertices, x), corners(pair.vertices, to), xi,
                      model_.parameters().d_hat, alpha);
    return alpha != 0.0;
  });
  return alpha;
}

std::vector<char> ContactPotential::meeting(const double* x, const double* to) {
  if (distortion(model_.mesh(), x, to) > kTorn) return std::vector<char>(model_.reach().size(), 1);
  watch(x, to);
  const std::vector<Index>& surface = model_.mesh().vertex_surface;
  std::vector<char> meets(model_.reach().size(), 0);
  const auto mark = [&](const Candidate& pair) {
    meets[surface[pair.vertices[0]]] = meets[surface[pair.vertices[3]]] = 1;
  };
  visit_approaching(x, to, [&](const Candidate& pair, double xi) {
    const double safe = safe_step(pair.kind, corners(pair.vertices, x), corners(pair.vertices, to),
                                  xi, model_.parameters().d_hat, 1.0);
    if (safe < 1.0) mark(pair);
    return true;
  });
  Near there;
  model_.measure(found_.pairs, to, there);
  for (const Term& term : there.terms) mark(term.pair);
  return meets;
}

bool ContactPotential::is_at(const Measured& measured, const double* x) const {
  return !measured.x.empty() && std::equal(measured.x.begin(), measured.x.end(), x);
}

void ContactPotential::measure(const double* x, Measured& out) const {
  out.x.assign(x, x + 3 * static_cast<std::ptrdiff_t>(model_.mesh().vertex_count));
  model_.measure(found_.pairs, x, out.near);
}

void ContactPotential::stand_at(const double* x) {
  if (is_at(here_, x)) return;
  if (is_at(trial_, x)) {
    std::swap(here_, trial_);
  } else {
    measure(x, here_);
  }
  adopted_ = nullptr;
  model_.find(here_.near, x, contacts_);
}

double ContactPotential::energy(const double* x) const {
  Measured scratch;
  return near_at(x, scratch).energy();
}

double ContactPotential::energy_change(const double* x, const double* to) const {
  measure(to, trial_);
  Measured scratch;
  return contact::energy_change(near_at(x, scratch), trial_.near);
}

const Near& ContactPotential::near_at(const double* x, Measured& scratch) const {
  if (is_at(here_, x)) return here_.near;
  measure(x, scratch);
  return scratch.near;
}

void ContactPotential::add_gradient(const double* x, double* g) const {
  model_.add_gradient(contacts(), x, g);
}

void ContactPotential::add_couplings(linalg::Couplings& pairs) const {
  for (const Contact& k : contacts()) add_stencil_couplings(k.pair.vertices, pairs);
}

void ContactPotential::add_couplings_near(const double* x, linalg::Couplings& pairs) const {
  std::vector<Candidate> near;
  detection_.candidates.find_at(x, model_.reach(), 0.5 * kSoon * model_.parameters().d_hat,
                                model_.moving_surfaces(), detection_.scratch, near);
  for (const Candidate& pair : near) {
    add_stencil_couplings(pair.vertices, pairs);
    // For edges of cloths that do not cross, the gap of friction rotates with a face at the second edge.
    if (pair.kind != PairKind::kEdgeEdge || !model_.between_cloths(pair)) continue;
    if (crosses(pair, x)) continue;
    const Index third = model_.frame(pair)[2];
    for (const Index v : pair.vertices) pairs.emplace_back(std::max(v, third), std::min(v, third));
  }
}

void ContactPotential::add_hessian(const double* x,
                                   Curvature curvature,
                                   linalg::BlockMatrix& A) const {
  for (const Contact& k : contacts()) {
    model_.hessian(k, x, curvature).add_to(A, k.pair.vertices);
  }
}

void ContactPotential::add_hessian_products(const double* x, const Products& products) const {
  multiply_side_by_side(products, model_.mesh().vertex_count,
                        [&](const DirectionKernels& kernels, const double* z, double* y) {
                          for (const Contact& k : contacts()) {
                            const ContactHessian h = model_.hessian(k, x, Curvature::kExact);
                            kernels.contact_product(h.factors(k.pair.vertices), z, y);
                          }
                        });
}

void ContactPotential::add_held_product(const double* x, const double* z, double* y) const {
  for (const Contact& k : contacts()) {
    if (!model_.is_held(k.pair.vertices)) continue;
    add_stencil_product(k.pair.vertices, model_.hessian(k, x, Curvature::kExact), z, y);
  }
}

void ContactPotential::add_left_out_products(const double* x,
                                             Curvature curvature,
                                             const Products& products) const {
  if (products.size() == 0) return;
  multiply_side_by_side(products, model_.mesh().vertex_count,
                        [&](const DirectionKernels& kernels, const double* z, double* y) {
                          for (const Contact& k : contacts()) {
                            if (!moves(k.pair.vertices, products)) continue;
                            const ContactHessian h = model_.hessian(k, x, curvature);
                            kernels.contact_product(h.factors(k.pair.vertices), z, y);
                          }
                        });
}

void ContactPotential::accumulate(const double* x, const double* z) {
  if (bar_ != nullptr) model_.add_mixed(contacts(), x, z, -1.0, *bar_);
}

void ContactPotential::add_tangents(const double* x, std::span<double* const> y) const {
  std::vector<const ContactModel::Bar*> dots;
  std::vector<double*> out;
  for (std::size_t l = 0; l < directions_.size(); ++l) {
    if (directions_[l] == nullptr) continue;
    dots.push_back(directions_[l]);
    out.push_back(y[l]);
  }
  if (!dots.empty()) model_.add_tangents(contacts(), x, dots, out);
}

void FrictionPotential::add_couplings(linalg::Couplings& pairs) const {
  for (const FrictionSet::Entry& k : set_.entries()) add_stencil_couplings(k.all_points(), pairs);
}

void FrictionPotential::add_hessian(const double* x,
                                    Curvature curvature,
                                    linalg::BlockMatrix& A) const {
  const FrictionSet::Slips& at = set_.slips(x);
  for (const FrictionSet::Entry& k : set_.entries()) set_.hessian(k, at, curvature).add_to(A);
}

void FrictionPotential::add_hessian_products(const double* x, const Products& products) const {
  const FrictionSet::Slips& at = set_.slips(x);
  multiply_side_by_side(products, set_.model().mesh().vertex_count,
                        [&](const DirectionKernels& kernels, const double* z, double* y) {
                          for (const FrictionSet::Entry& k : set_.entries()) {
                            const FrictionSet::Hessian h = set_.hessian(k, at, Curvature::kExact);
                            std::array<Mat3, 6> B;
                            kernels.friction_product(h.factors(B), z, y);
                          }
                        });
}

void FrictionPotential::add_held_product(const double* x, const double* z, double* y) const {
  const FrictionSet::Slips& at = set_.slips(x);
  for (const FrictionSet::Entry& k : set_.entries()) {
    if (!set_.model().is_held(k.all_points())) continue;
    set_.add_product(k, at, z, y);
  }
}

void FrictionPotential::add_left_out_products(const double* x,
                                              Curvature curvature,
                                              const Products& products) const {
  if (products.size() == 0) return;
  const FrictionSet::Slips& at = set_.slips(x);
  multiply_side_by_side(products, set_.model().mesh().vertex_count,
                        [&](const DirectionKernels& kernels, const double* z, double* y) {
                          for (const FrictionSet::Entry& k : set_.entries()) {
                            if (!moves(k.all_points(), products)) continue;
                            const FrictionSet::Hessian h = set_.hessian(k, at, curvature);
                            std::array<Mat3, 6> B;
                            kernels.friction_product(h.factors(B), z, y);
                          }
                        });
}

void FrictionPotential::accumulate(const double* x, const double* z) {
  const std::size_t size = 3 * static_cast<std::size_t>(set_.model().mesh().vertex_count);
  start_bar.resize(size, 0.0);
  lag_bar.resize(size, 0.0);
  using enum FrictionSet::DiffWrt;
  set_.add_mixed(x, z, -1.0, bar_ != nullptr ? kPointsAndParameters : kPoints,
                 {.start = start_bar.data(), .lag = lag_bar.data(), .parameters = bar_});
}

void FrictionPotential::add_tangents(const double* x, std::span<double* const> y) const {
  set_.add_tangents(x, directions_, y);
}

}  // namespace diffcloth::contact
