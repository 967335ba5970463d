#include "elastic/elastic.h"

#include <algorithm>
#include <array>
#include <memory>
#include <span>
#include <stdexcept>
#include <utility>

#include "elastic/bending.h"
#include "elastic/elements.h"
#include "elastic/extrapolation.h"
#include "elastic/face_batches.h"
#include "elastic/face_terms.h"
#include "elastic/frame.h"

namespace diffcloth::elastic {
namespace {

bool is_damped(const Model& model, Index f) { return model.damping[f] != 0.0; }

/// y += H z of a face.
void add_face_product(const Model& model, Index f, const double* x, const double* z, double* y) {
  const Mat32 F = face_gradient(model, f, x);
  const Mat32 G = face_gradient(model, f, z);
  Mat32 P = stretch_stress_change(model, f, F, G);
  if (is_damped(model, f)) {
    P += damping_stress_change(model, f, F, damping_start(model, f), G);
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

void prepare_stretch(const Model& model, const Slots& slots, Prepared& prepared) {
  std::vector<Index> isotropic;
  std::vector<Index> orthotropic;
  for (Index f = 0; f < face_count(model); ++f) {
    (is_orthotropic(model, f) ? orthotropic : isotropic).push_back(f);
    if (is_damped(model, f)) prepared.damped.push_back(f);
  }
  prepared.stretch = stretch_batches(model, slots, isotropic);
  prepared.woven = woven_batches(model, slots, orthotropic);
  prepared.damping_of_stretch = damping_batches(model, slots, prepared.damped);
}

void prepare_form(const Model& model, Index e, Prepared& prepared) {
  const double area = model.rest->bending_area[e];
  if (is_plate(model, e) && !plate(model, e).is_isotropic()) {
    prepared.bending[e] = area;
    prepared.form[e] = plate_form(plate(model, e));
  } else {
    prepared.bending[e] = element_mean(model, e, model.bending) * area;
    prepared.form[e] = isotropic_form(element_mean(model, e, model.poisson));
  }
}

/// Compute the quantities that damping derives from the start of the step; the rest of `prepared` is
/// complete.
void prepare_start(const Model& model, Prepared& prepared) {
  put_start_gradients(model, prepared.damped, prepared.damping_of_stretch);
  for (Index e = 0; e < model.stencils->size(); ++e) {
    if (prepared.damping[e] == 0.0) continue;
    prepared.curvature_n[e] = bending::start_curvature(bending_element(model, e), start_of(model));
  }
  put_start_curvatures(prepared.curvature_n, prepared.bent);
}

template <class T>
std::size_t bytes(const std::vector<T>& values) {
  return sizeof(T) * values.size();
}

std::size_t bytes(const Prepared& p) {
  return bytes(p.bending) + bytes(p.form) + bytes(p.damping) + bytes(p.flat) +
         bytes(p.curvature_n) + bytes(p.constant) + bytes(p.identity) + bytes(p.stretch) +
         bytes(p.damping_of_stretch) + bytes(p.damped) + bytes(p.bent.batches) +
         bytes(p.bent.points) + bytes(p.bent.elements) + bytes(p.woven);
}

const BendingKernels& bending_here() {
  static const BendingKernels& best = bending_kernels(linalg::chosen_level());
  return best;
}

/// Ratio of bending stiffness to inertia above which elements are evaluated individually: the forces of
/// the matrix have torques at the level of its rounding, which would turn the cloth.
constexpr double kStiffest = 1e8;

/// Visit the flat elements that the matrix does not include.
template <class Visit>
void for_stiff_elements(const Model& model, Visit&& visit) {
  if (model.prepared->by_matrix) return;
  for (Index e = 0; e < model.stencils->size(); ++e) {
    if (model.prepared->flat[e] != 0) visit(bending_element(model, e));
  }
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
  const auto made = std::make_shared<Prepared>();
  Prepared& prepared = *made;
  model.prepared = made;
  prepared.bending.resize(element_count);
  prepared.form.resize(element_count);
  prepared.damping.resize(element_count);
  prepared.flat.resize(element_count);
  prepared.curvature_n.assign(element_count, Mat3::Zero());
  prepared.constant.assign(slots.block_count, 0.0);
  prepared.by_matrix = true;
  for (Index f = 0; f < face_count(model); ++f) prepared.has_damping |= is_damped(model, f);
  if (prepared.has_damping && (model.x_n == nullptr || !(model.h > 0.0))) {
    throw std::invalid_argument("elastic: damping needs the start of the step and a time step > 0");
  }
  prepare_stretch(model, slots, prepared);

  std::vector<Index> bent;
  for (Index e = 0; e < element_count; ++e) {
    prepare_form(model, e, prepared);
    const double damping = element_mean(model, e, model.damping);
    prepared.damping[e] = damping == 0.0 ? 0.0 : damping / model.h;
    prepared.flat[e] = damping == 0.0 && model.rest->curvature[e].isZero(0.0);
    const bending::Element element = bending_element(model, e);
    if (element.flat) {
      bending::add_constant(element, bending_slots(slots, e), prepared.constant.data());
    } else {
      bent.push_back(e);
    }
  }
  const double stiffest = prepared.constant.empty() ? 0.0 : std::ranges::max(prepared.constant);
  // A matrix of zeros, where no element is flat, would take as long as any other.
  prepared.by_matrix = stiffest > 0.0 && stiffest <= kStiffest * model.least_inertia;
  prepared.identity = prepared.constant;
  for (const Index e : bent) {
    bending::Element element = bending_element(model, e);
    element.weight *= 1.0 + element.damping;
    bending::add_constant(element, bending_slots(slots, e), prepared.identity.data());
  }
  prepared.bent = bending_batches(model, slots, std::move(bent));
  prepare_start(model, prepared);
}

void PreparedCache::prepare(Model& model, const Slots& slots) {
  // Damping depends on the start of the step.
  const bool damped = std::ranges::any_of(model.damping, [](double value) { return value != 0.0; });
  const double h = damped ? model.h : 0.0;
  std::vector<double> start;
  if (damped && model.x_n != nullptr) {
    const auto size = 3 * static_cast<std::ptrdiff_t>(model.topology->vertex_count);
    start.assign(model.x_n, model.x_n + size);
    if (model.ahead != nullptr) start.insert(start.end(), model.ahead, model.ahead + size);
  }
  const std::array<const std::vector<double>*, kFields> fields = {
      &model.stretch,      &model.bending,       &model.poisson,      &model.damping,
      &model.stretch_weft, &model.stretch_shear, &model.bending_weft, &model.bending_twill};
  const auto is_of_model = [&](const Entry& entry) {
    if (entry.least_inertia != model.least_inertia || entry.h != h) return false;
    return std::ranges::equal(entry.fields, fields,
                              [](const auto& kept, const auto* given) { return kept == *given; });
  };
  const auto is_the_same = [&](const Entry& entry) {
    return entry.start == start && is_of_model(entry);
  };
  std::shared_ptr<const Prepared> of_other_start;
  {
    const std::lock_guard lock(mutex_);
    if (const auto same = std::ranges::find_if(entries_, is_the_same); same != entries_.end()) {
      entries_.splice(entries_.begin(), entries_, same);
      model.prepared = same->prepared;
      return;
    }
    const auto other = std::ranges::find_if(entries_, is_of_model);
    if (other != entries_.end()) of_other_start = other->prepared;
  }
  if (of_other_start != nullptr && !start.empty()) {
    const auto made = std::make_shared<Prepared>(*of_other_start);
    model.prepared = made;
    prepare_start(model, *made);
  } else {
    elastic::prepare(model, slots);
  }
  Entry entry{.fields = {},
              .least_inertia = model.least_inertia,
              .h = h,
              .start = std::move(start),
              .prepared = model.prepared,
              .bytes = bytes(*model.prepared)};
  entry.bytes += bytes(entry.start);
  for (std::size_t k = 0; k < kFields; ++k) {
    entry.fields[k] = *fields[k];
    entry.bytes += sizeof(double) * fields[k]->size();
  }
  const std::lock_guard lock(mutex_);
  bytes_ += entry.bytes;
  entries_.push_front(std::move(entry));
  while (bytes_ > kCapacity && entries_.size() > 1) {
    bytes_ -= entries_.back().bytes;
    entries_.pop_back();
  }
}

double stretch_energy(const Model& model, const double* x) {
  double total = 0.0;
  for (Index f = 0; f < face_count(model); ++f) {
    total += stretch_energy(model, f, face_gradient(model, f, x));
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

BendingStates bending_states(const Model& model, const double* x) {
  const BendingBatches& bent = model.prepared->bent;
  BendingStates states(bent.batches.size());
  bending_here().evaluate(bent.batches.data(), bent.batches.size(), bent.points.data(), x,
                          states.data());
  return states;
}

double energy_change(const Model& model,
                     const double* x0,
                     const double* x1,
                     const double* dx,
                     const BendingStates& start,
                     BendingStates& end,
                     double* g1) {
  const Prepared& prepared = *model.prepared;
  double total =
      stretch_kernels().energy_change(prepared.stretch.data(), prepared.stretch.size(), x0, x1, g1);
  total +=
      stretch_kernels().woven_energy_change(prepared.woven.data(), prepared.woven.size(), x0, x1);
  stretch_kernels().add_woven_gradient(prepared.woven.data(), prepared.woven.size(), x1, g1);
  total += stretch_kernels().damping_energy_change(prepared.damping_of_stretch.data(),
                                                   prepared.damping_of_stretch.size(), x0, x1, g1);
  end.resize(prepared.bent.batches.size());
  total += bending_here().energy_change(prepared.bent.batches.data(), prepared.bent.batches.size(),
                                        prepared.bent.points.data(), x1, dx, start.data(),
                                        end.data(), g1);
  for_stiff_elements(model, [&](const bending::Element& element) {
    total += bending::flat_energy_change(element, x0, x1);
    bending::add_flat_gradient(element, x1, g1);
  });
  return total;
}

void add_gradient(const Model& model, const double* x, const BendingStates& at, double* g) {
  const Prepared& prepared = *model.prepared;
  stretch_kernels().add_gradient(prepared.stretch.data(), prepared.stretch.size(), x, g);
  stretch_kernels().add_woven_gradient(prepared.woven.data(), prepared.woven.size(), x, g);
  stretch_kernels().add_damping_gradient(prepared.damping_of_stretch.data(),
                                         prepared.damping_of_stretch.size(), x, g);
  bending_here().add_gradient(prepared.bent.batches.data(), prepared.bent.batches.size(),
                              prepared.bent.points.data(), at.data(), g);
  for_stiff_elements(
      model, [&](const bending::Element& element) { bending::add_flat_gradient(element, x, g); });
}

void add_hessian(const Model& model,
                 const Slots& slots,
                 const double* x,
                 const BendingStates& at,
                 Curvature curvature,
                 const std::vector<Index>& place,
                 double* blocks) {
  const bool positive = curvature == Curvature::kPositive;
  const Prepared& prepared = *model.prepared;
  for (Index slot = 0; slot < slots.block_count; ++slot) {
    double* block = blocks + 9 * static_cast<std::ptrdiff_t>(place[slot]);
    const double value = prepared.identity[slot];
    block[0] += value;
    block[4] += value;
    block[8] += value;
  }
  stretch_kernels().add_hessian(prepared.stretch.data(), prepared.stretch.size(), x, positive,
                                place.data(), blocks);
  stretch_kernels().add_woven_hessian(prepared.woven.data(), prepared.woven.size(), x, positive,
                                      place.data(), blocks);
  stretch_kernels().add_damping_hessian(prepared.damping_of_stretch.data(),
                                        prepared.damping_of_stretch.size(), x, positive,
                                        place.data(), blocks);
  bending_here().add_hessian(prepared.bent.batches.data(), prepared.bent.batches.size(),
                             prepared.bent.points.data(), at.data(), positive, place.data(),
                             blocks);
}

std::vector<Mat2> extrapolated_stresses(const Model& model, const double* x, const double* to) {
  std::vector<Mat2> stresses;
  stresses.reserve(model.topology->faces.size());
  for (Index f = 0; f < face_count(model); ++f) {
    const Mat32 F = face_gradient(model, f, x);
    const Mat32 G = face_gradient(model, f, to) - F;
    stresses.push_back(extrapolated_stress(F, G, second_stress(model, f, F),
                                           stretch_stress_change(model, f, F, G)));
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
    const Mat32 F = face_gradient(model, f, x);
    add_face_blocks(model.topology->faces[f],
                    slots.stretch.data() + 6 * static_cast<std::ptrdiff_t>(f), place,
                    extrapolation(model.rest->shape_gradient[f], F, second_stress(model, f, F),
                                  stresses[f], positive),
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
      stretch_weft(topology.faces.size(), 0.0),
      stretch_shear(topology.faces.size(), 0.0),
      bending_weft(topology.faces.size(), 0.0),
      bending_twill(topology.faces.size(), 0.0),
      rest(topology, stencils),
      x_n(3 * static_cast<std::size_t>(topology.vertex_count), 0.0),
      ahead(x_n) {}

}  // namespace diffcloth::elastic
