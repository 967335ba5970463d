#include "elastic/elastic.h"

#include <algorithm>
#include <array>
#include <span>
#include <stdexcept>

#include "elastic/bending.h"
#include "elastic/damping.h"
#include "elastic/elements.h"
#include "elastic/frame.h"
#include "elastic/stretch.h"

namespace diffcloth::elastic {
namespace {

double damping_weight(const Model& model, Index f) {
  return model.damping[f] / model.h * stretch_weight(model, f);
}

bool is_damped(const Model& model, Index f) { return model.damping[f] != 0.0; }

/// y_p += P g_p over the corners of a face.
void scatter(const Model& model, Index f, const Mat32& P, double* y) {
  for (int p = 0; p < 3; ++p) {
    Eigen::Map<Vec3>(y + 3 * model.topology->faces[f][p]) +=
        P * model.rest->shape_gradient[f].row(p).transpose();
  }
}

/// y += H z of a face.
void add_face_product(const Model& model, Index f, const double* x, const double* z, double* y) {
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 G = face_gradient(model, f, z);
  Mat32 P = stretch::stress_change(stretch_weight(model, f), F, G);
  if (is_damped(model, f)) {
    P += damping::stress_change(damping_weight(model, f), F, face_gradient(model, f, model.x_n), G);
  }
  scatter(model, f, P, y);
}

void add_face_blocks(const std::array<Index, 3>& face,
                     const Index* slots,
                     const std::vector<Index>& place,
                     const std::array<Mat3, 6>& element,
                     double* blocks) {
  int k = 0;
  for (int p = 0; p < 3; ++p) {
    for (int q = 0; q <= p; ++q, ++k) {
      linalg::add_block(blocks, place[slots[k]], face[p] < face[q], element[k]);
    }
  }
}

/// All triangles in lanes, in their order.
std::vector<StretchBatch> stretch_batches(const Model& model, const Slots& slots) {
  const Index count = face_count(model);
  std::vector<StretchBatch> batches((count + kStretchLanes - 1) / kStretchLanes);
  for (std::size_t b = 0; b < batches.size(); ++b) {
    StretchBatch& batch = batches[b];
    const auto first = static_cast<Index>(b) * kStretchLanes;
    batch.size = std::min(kStretchLanes, count - first);
    for (int l = 0; l < kStretchLanes; ++l) {
      const Index f = first + std::min(l, batch.size - 1);
      const std::array<Index, 3>& face = model.topology->faces[f];
      const mesh::ShapeGradient& g = model.rest->shape_gradient[f];
      const Index* const face_slots = slots.stretch.data() + 6 * static_cast<std::ptrdiff_t>(f);
      std::array<int, 3> corner{0, 1, 2};
      std::ranges::sort(corner, {}, [&](int p) { return face[p]; });
      int k = 0;
      for (int p = 0; p < 3; ++p) {
        batch.vertex[p][l] = face[corner[p]];
        for (int q = 0; q <= p; ++q, ++k) {
          const auto [low, high] = std::minmax(corner[p], corner[q]);
          batch.slot[k][l] = face_slots[linalg::lower(high, low)];
        }
      }
      for (int p = 1; p < 3; ++p) {
        for (int a = 0; a < 2; ++a) batch.g[2 * (p - 1) + a][l] = g(corner[p], a);
      }
      batch.weight[l] = l < batch.size ? stretch_weight(model, f) : 0.0;
    }
  }
  return batches;
}

const StretchKernels& kernels() {
  static const StretchKernels& best = stretch_kernels(linalg::best_level());
  return best;
}

/// Where bending is stiffer than this many times inertia, forces by the matrix have torques of its
/// rounding that turn cloth: each element by itself has none.
constexpr double kStiffest = 1e8;

bool is_by_matrix(const Model& model, Index e) {
  return model.prepared.by_matrix && model.prepared.flat[e] != 0;
}

void add_face_mixed(
    const Model& model, Index f, const double* x, const double* z, bool with_rest, Bar& bar) {
  const double k_s = model.stretch[f];
  const double area = model.rest->area[f];
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 G = face_gradient(model, f, z);
  const Mat32 unit = stretch::stress(1.0, F);
  const double work = unit.cwiseProduct(G).sum();
  bar.stretch[f] += area * work;
  if (with_rest) {
    bar.rest.area[f] += k_s * work;
    mesh::ShapeGradient& g_bar = bar.rest.shape_gradient[f];
    scatter_gradient_bar(model, f, stretch::stress_change(k_s * area, F, G), x, g_bar);
    scatter_gradient_bar(model, f, k_s * area * unit, z, g_bar);
  }
}

void add_face_damping_mixed(
    const Model& model, Index f, const double* x, const double* z, bool with_rest, Bar& bar) {
  const double k_s = model.stretch[f];
  const double area = model.rest->area[f];
  const double rate = model.damping[f] / model.h;
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 F_n = face_gradient(model, f, model.x_n);
  const Mat32 G = face_gradient(model, f, z);
  const Mat32 unit = damping::stress(1.0, F, F_n);
  const double work = unit.cwiseProduct(G).sum();
  bar.damping[f] += k_s * area * work / model.h;
  if (rate == 0.0) return;

  const double weight = rate * k_s * area;
  bar.stretch[f] += rate * area * work;
  const Mat32 F_n_bar = damping::start_bar(weight, F, F_n, G);
  scatter(model, f, F_n_bar, bar.x_n.data());
  if (with_rest) {
    bar.rest.area[f] += rate * k_s * work;
    mesh::ShapeGradient& g_bar = bar.rest.shape_gradient[f];
    scatter_gradient_bar(model, f, damping::stress_change(weight, F, F_n, G), x, g_bar);
    scatter_gradient_bar(model, f, weight * unit, z, g_bar);
    scatter_gradient_bar(model, f, F_n_bar, model.x_n, g_bar);
  }
}

/// Where the cotangents of the geometry of a bending element are added.
bending::GeometryBars geometry_bars(const Model& model, Index e, bool with_rest, Bar& bar) {
  bending::GeometryBars geometry;
  geometry.x_n = bar.x_n.data();
  if (with_rest) {
    geometry.c = bar.rest.curvature_operator.data() + 3 * model.stencils->start[e];
    geometry.g = &bar.rest.shape_gradient[model.stencils->faces[e][0]];
    geometry.b = &bar.rest.curvature[e];
  }
  return geometry;
}

/// Pull the cotangents of the weight and nu of a bending element back to the faces.
void add_weight_bars(
    const Model& model, Index e, const bending::ScalarBars& scalar, bool with_rest, Bar& bar) {
  add_to_faces(model, e, scalar.weight * model.rest->bending_area[e], bar.bending);
  add_to_faces(model, e, scalar.poisson, bar.poisson);
  if (with_rest) {
    bar.rest.bending_area[e] += scalar.weight * element_mean(model, e, model.bending);
  }
}

void add_bending_mixed(
    const Model& model, Index e, const double* x, const double* z, bool with_rest, Bar& bar) {
  bending::Element element = bending_element(model, e);
  Mat3 curvature_n;
  if (model.x_n != nullptr) {
    curvature_n = bending::body_curvature(element, model.x_n);
    element.b_n = &curvature_n;
  }
  const bending::ScalarBars scalar =
      bending::mixed(element, x, model.x_n, z, geometry_bars(model, e, with_rest, bar));
  add_weight_bars(model, e, scalar, with_rest, bar);
  if (model.x_n != nullptr) add_to_faces(model, e, scalar.damping / model.h, bar.damping);
}

/// y_p += dP g_p + P g_dot_p, with P = k_s A (F - R) and its change dP.
void add_face_tangent(const Model& model,
                      Index f,
                      const double* x,
                      const Bar& dot,
                      const Changing& changing,
                      double* y) {
  const double k_s = model.stretch[f];
  const double area = model.rest->area[f];
  const double k_dot = changing.materials ? dot.stretch[f] : 0.0;
  const double area_dot = changing.rest ? dot.rest.area[f] : 0.0;
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 unit = stretch::stress(1.0, F);
  Mat32 change = (k_dot * area + k_s * area_dot) * unit;
  Mat32 P = k_s * area * unit;
  Mat32 F_dot = Mat32::Zero();
  if (changing.rest) {
    F_dot = face_gradient(model, f, dot.rest.shape_gradient[f], x);
    change += stretch::stress_change(k_s * area, F, F_dot);
  }
  if (model.x_n != nullptr) {
    const double rate = model.damping[f] / model.h;
    const double rate_dot = changing.materials ? dot.damping[f] / model.h : 0.0;
    if (rate != 0.0 || rate_dot != 0.0) {
      const Mat32 F_n = face_gradient(model, f, model.x_n);
      const Mat32 unit_n = damping::stress(1.0, F, F_n);
      const double weight = rate * k_s * area;
      change += (rate_dot * k_s * area + rate * (k_dot * area + k_s * area_dot)) * unit_n;
      P += weight * unit_n;
      Mat32 F_n_dot = Mat32::Zero();
      if (changing.start) F_n_dot += face_gradient(model, f, dot.x_n.data());
      if (changing.rest) {
        F_n_dot += face_gradient(model, f, dot.rest.shape_gradient[f], model.x_n);
        change += damping::stress_change(weight, F, F_n, F_dot);
      }
      change += damping::start_change(weight, F, F_n, F_n_dot);
    }
  }
  scatter(model, f, change, y);
  if (!changing.rest) return;
  for (int p = 0; p < 3; ++p) {
    Eigen::Map<Vec3>(y + 3 * model.topology->faces[f][p]) +=
        P * dot.rest.shape_gradient[f].row(p).transpose();
  }
}

void add_bending_tangent(const Model& model,
                         Index e,
                         const double* x,
                         const Bar& dot,
                         const Changing& changing,
                         double* y) {
  bending::Element element = bending_element(model, e);
  bending::Tangents tangents;
  if (changing.materials) {
    tangents.weight = element_mean(model, e, dot.bending) * model.rest->bending_area[e];
    tangents.poisson = element_mean(model, e, dot.poisson);
    if (model.x_n != nullptr) tangents.damping = element_mean(model, e, dot.damping) / model.h;
  }
  if (changing.rest) {
    tangents.weight += element_mean(model, e, model.bending) * dot.rest.bending_area[e];
    tangents.c = dot.rest.curvature_operator.data() + 3 * model.stencils->start[e];
    tangents.g = &dot.rest.shape_gradient[model.stencils->faces[e][0]];
    tangents.b = &dot.rest.curvature[e];
  }
  if (changing.start) tangents.x_n = dot.x_n.data();
  Mat3 curvature_n;
  if (model.x_n != nullptr) {
    curvature_n = bending::body_curvature(element, model.x_n);
    element.b_n = &curvature_n;
  }
  bending::add_tangent(element, x, model.x_n, tangents, y);
}

// E = k_s A W(F), with dW/dF the stress of unit weight.
void add_face_energy_bars(const Model& model,
                          Index f,
                          const double* x,
                          double seed,
                          bool with_rest,
                          Bar& bar,
                          double* x_bar) {
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 F_bar = stretch::stress(seed * stretch_weight(model, f), F);
  const double unit = seed * stretch::energy(1.0, F);
  scatter(model, f, F_bar, x_bar);
  bar.stretch[f] += model.rest->area[f] * unit;
  if (with_rest) {
    bar.rest.area[f] += model.stretch[f] * unit;
    scatter_gradient_bar(model, f, F_bar, x, bar.rest.shape_gradient[f]);
  }
}

void add_bending_energy_bars(const Model& model,
                             Index e,
                             const double* x,
                             double seed,
                             bool with_rest,
                             Bar& bar,
                             double* x_bar) {
  const bending::ScalarBars scalar = bending::energy_bars(
      bending_element(model, e), x, seed, geometry_bars(model, e, with_rest, bar), x_bar);
  add_weight_bars(model, e, scalar, with_rest, bar);
}

}  // namespace

std::vector<std::vector<Index>> cliques(const mesh::Topology& topology,
                                        const mesh::BendingStencils& stencils) {
  std::vector<std::vector<Index>> result;
  result.reserve(topology.faces.size() + stencils.faces.size());
  for (const std::array<Index, 3>& face : topology.faces) {
    result.emplace_back(face.begin(), face.end());
  }
  for (Index e = 0; e < stencils.size(); ++e) {
    const std::span<const Index> vertices = stencils.element(e);
    result.emplace_back(vertices.begin(), vertices.end());
  }
  return result;
}

Elements elements_at(const mesh::Topology& topology,
                     const mesh::BendingStencils& stencils,
                     const std::vector<char>& marked) {
  const auto is_marked = [&](Index i) { return marked[i] != 0; };
  Elements result;
  for (std::size_t f = 0; f < topology.faces.size(); ++f) {
    if (std::ranges::any_of(topology.faces[f], is_marked)) {
      result.faces.push_back(static_cast<Index>(f));
    }
  }
  for (Index e = 0; e < stencils.size(); ++e) {
    if (std::ranges::any_of(stencils.element(e), is_marked)) result.bending.push_back(e);
  }
  return result;
}

Slots slots(const mesh::Topology& topology,
            const mesh::BendingStencils& stencils,
            const linalg::BlockPattern& pattern) {
  Slots result;
  result.block_count = pattern.block_count();
  result.stretch.reserve(6 * topology.faces.size());
  for (const std::array<Index, 3>& face : topology.faces) {
    const std::vector<Index> element = pattern.slots(face);
    result.stretch.insert(result.stretch.end(), element.begin(), element.end());
  }
  std::size_t count = 0;
  for (Index e = 0; e < stencils.size(); ++e) {
    const std::size_t size = stencils.element(e).size();
    count += size * (size + 1) / 2;
  }
  result.bending.reserve(count);
  result.bending_start.reserve(static_cast<std::size_t>(stencils.size()) + 1);
  result.bending_start.push_back(0);
  for (Index e = 0; e < stencils.size(); ++e) {
    const std::vector<Index> element = pattern.slots(stencils.element(e));
    result.bending.insert(result.bending.end(), element.begin(), element.end());
    result.bending_start.push_back(static_cast<Index>(result.bending.size()));
  }
  return result;
}

void prepare(Model& model, const Slots& slots) {
  const Index element_count = model.stencils->size();
  Prepared& prepared = model.prepared;
  prepared.bending.resize(element_count);
  prepared.poisson.resize(element_count);
  prepared.damping.resize(element_count);
  prepared.flat.resize(element_count);
  prepared.curvature_n.resize(element_count);
  prepared.constant.assign(slots.block_count, 0.0);
  prepared.stretch = stretch_batches(model, slots);
  prepared.by_matrix = true;
  prepared.bends = false;
  prepared.damped = false;
  for (Index f = 0; f < face_count(model); ++f) prepared.damped |= is_damped(model, f);
  if (prepared.damped && (model.x_n == nullptr || !(model.h > 0.0))) {
    throw std::invalid_argument("elastic: damping needs the start of the step and a time step > 0");
  }

  for (Index e = 0; e < element_count; ++e) {
    prepared.bending[e] = element_mean(model, e, model.bending) * model.rest->bending_area[e];
    prepared.poisson[e] = element_mean(model, e, model.poisson);
    const double damping = element_mean(model, e, model.damping);
    prepared.damping[e] = damping == 0.0 ? 0.0 : damping / model.h;
    prepared.flat[e] = damping == 0.0 && model.rest->curvature[e].isZero(0.0);
    const bending::Element element = bending_element(model, e);
    if (element.flat) {
      bending::add_constant(element, bending_slots(slots, e), prepared.constant.data());
    } else {
      prepared.bends = true;
    }
    if (damping != 0.0) {
      prepared.curvature_n[e] = bending::body_curvature(element, model.x_n);
    }
  }
  const double stiffest = prepared.constant.empty() ? 0.0 : std::ranges::max(prepared.constant);
  prepared.by_matrix = stiffest <= kStiffest * model.least_inertia;
  prepared.bends |= !prepared.by_matrix;
}

double stretch_energy(const Model& model, const double* x) {
  double total = 0.0;
  for (Index f = 0; f < face_count(model); ++f) {
    total += stretch::energy(stretch_weight(model, f), face_gradient(model, f, x));
  }
  return total;
}

double bending_energy(const Model& model, const double* x) {
  double total = 0.0;
  for (Index e = 0; e < model.stencils->size(); ++e) {
    total += bending::energy(bending_element(model, e), x);
  }
  return total;
}

double energy_change(const Model& model, const double* x0, const double* x1) {
  const Prepared& prepared = model.prepared;
  double total = kernels().energy_change(prepared.stretch.data(), prepared.stretch.size(), x0, x1);
  for (Index f = 0; prepared.damped && f < face_count(model); ++f) {
    if (!is_damped(model, f)) continue;
    const std::array<Index, 3>& face = model.topology->faces[f];
    const Mat32 dF = deformation_gradient(
        model.rest->shape_gradient[f], row(x1, face[0]) - row(x0, face[0]),
        row(x1, face[1]) - row(x0, face[1]), row(x1, face[2]) - row(x0, face[2]));
    total +=
        damping::energy_change(damping_weight(model, f), face_gradient(model, f, x0),
                               face_gradient(model, f, x1), dF, face_gradient(model, f, model.x_n));
  }
  for (Index e = 0; prepared.bends && e < model.stencils->size(); ++e) {
    if (!is_by_matrix(model, e)) total += bending::energy_change(bending_element(model, e), x0, x1);
  }
  return total;
}

void add_gradient(const Model& model, const double* x, double* g) {
  const Prepared& prepared = model.prepared;
  kernels().add_gradient(prepared.stretch.data(), prepared.stretch.size(), x, g);
  for (Index f = 0; prepared.damped && f < face_count(model); ++f) {
    if (!is_damped(model, f)) continue;
    scatter(model, f,
            damping::stress(damping_weight(model, f), face_gradient(model, f, x),
                            face_gradient(model, f, model.x_n)),
            g);
  }
  for (Index e = 0; prepared.bends && e < model.stencils->size(); ++e) {
    if (!is_by_matrix(model, e)) bending::add_gradient(bending_element(model, e), x, g);
  }
}

void add_hessian(const Model& model,
                 const Slots& slots,
                 const double* x,
                 Curvature curvature,
                 const std::vector<Index>& place,
                 double* blocks) {
  const bool positive = curvature == Curvature::kPositive;
  const Prepared& prepared = model.prepared;
  for (Index slot = 0; slot < slots.block_count; ++slot) {
    double* block = blocks + 9 * static_cast<std::ptrdiff_t>(place[slot]);
    const double value = prepared.constant[slot];
    block[0] += value;
    block[4] += value;
    block[8] += value;
  }
  kernels().add_hessian(prepared.stretch.data(), prepared.stretch.size(), x, positive, place.data(),
                        blocks);
  for (Index f = 0; prepared.damped && f < face_count(model); ++f) {
    if (!is_damped(model, f)) continue;
    add_face_blocks(
        model.topology->faces[f], slots.stretch.data() + 6 * static_cast<std::ptrdiff_t>(f), place,
        damping::hessian(damping_weight(model, f), model.rest->shape_gradient[f],
                         face_gradient(model, f, x), face_gradient(model, f, model.x_n), positive),
        blocks);
  }
  std::vector<Index> places;
  for (Index e = 0; prepared.bends && e < model.stencils->size(); ++e) {
    if (prepared.flat[e] != 0) continue;
    places.clear();
    for (const Index slot : bending_slots(slots, e)) places.push_back(place[slot]);
    bending::add_hessian(bending_element(model, e), places, x, positive, blocks);
  }
}

std::vector<Mat2> extrapolated_stresses(const Model& model, const double* x, const double* to) {
  std::vector<Mat2> stresses;
  stresses.reserve(model.topology->faces.size());
  for (Index f = 0; f < face_count(model); ++f) {
    const Mat32 F = face_gradient(model, f, x);
    const Mat32 G = face_gradient(model, f, to) - F;
    stresses.push_back(stretch::extrapolated_stress(stretch_weight(model, f), F, G));
  }
  return stresses;
}

void add_extrapolation(const Model& model,
                       const Slots& slots,
                       const double* x,
                       const std::vector<Mat2>& stresses,
                       Curvature curvature,
                       const std::vector<Index>& place,
                       double* blocks) {
  const bool positive = curvature == Curvature::kPositive;
  for (Index f = 0; f < face_count(model); ++f) {
    add_face_blocks(model.topology->faces[f],
                    slots.stretch.data() + 6 * static_cast<std::ptrdiff_t>(f), place,
                    stretch::extrapolation(stretch_weight(model, f), model.rest->shape_gradient[f],
                                           face_gradient(model, f, x), stresses[f], positive),
                    blocks);
  }
}

void add_hessian_product(const Model& model, const double* x, const double* z, double* y) {
  for (Index f = 0; f < face_count(model); ++f) add_face_product(model, f, x, z, y);
  for (Index e = 0; e < model.stencils->size(); ++e) {
    bending::add_hessian_product(bending_element(model, e), x, z, y);
  }
}

void add_hessian_product(
    const Model& model, const Elements& elements, const double* x, const double* z, double* y) {
  for (const Index f : elements.faces) add_face_product(model, f, x, z, y);
  for (const Index e : elements.bending) {
    bending::add_hessian_product(bending_element(model, e), x, z, y);
  }
}

Bar::Bar(const mesh::Topology& topology, const mesh::BendingStencils& stencils)
    : stretch(topology.faces.size(), 0.0),
      bending(topology.faces.size(), 0.0),
      poisson(topology.faces.size(), 0.0),
      damping(topology.faces.size(), 0.0),
      rest(topology, stencils),
      x_n(3 * static_cast<std::size_t>(topology.vertex_count), 0.0) {}

void add_mixed(const Model& model, const double* x, const double* z, bool with_rest, Bar& bar) {
  for (Index f = 0; f < face_count(model); ++f) {
    add_face_mixed(model, f, x, z, with_rest, bar);
    if (model.x_n != nullptr) add_face_damping_mixed(model, f, x, z, with_rest, bar);
  }
  for (Index e = 0; e < model.stencils->size(); ++e) {
    add_bending_mixed(model, e, x, z, with_rest, bar);
  }
}

void add_tangent(
    const Model& model, const double* x, const Bar& dot, const Changing& changing, double* y) {
  const bool damped = model.prepared.damped && changing.start;
  if (!changing.materials && !changing.rest && !damped) return;
  for (Index f = 0; f < face_count(model); ++f) add_face_tangent(model, f, x, dot, changing, y);
  for (Index e = 0; e < model.stencils->size(); ++e) {
    add_bending_tangent(model, e, x, dot, changing, y);
  }
}

void add_energy_bars(const Model& model,
                     const double* x,
                     const Energies& seed,
                     bool with_rest,
                     Bar& bar,
                     double* x_bar) {
  for (Index f = 0; seed.stretch != 0.0 && f < face_count(model); ++f) {
    add_face_energy_bars(model, f, x, seed.stretch, with_rest, bar, x_bar);
  }
  for (Index e = 0; seed.bending != 0.0 && e < model.stencils->size(); ++e) {
    add_bending_energy_bars(model, e, x, seed.bending, with_rest, bar, x_bar);
  }
}

}  // namespace diffcloth::elastic
