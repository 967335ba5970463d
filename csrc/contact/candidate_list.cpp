#include "contact/candidate_list.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <utility>

#include "contact/pair_distances.h"

namespace diffcloth::contact {
namespace {

/// The skin is this multiple of the current motion, clamped to these fractions of the smallest reach: a
/// thin skin is soon used up, a thick one holds pairs that never meet.
constexpr double kAhead = 2.0;
constexpr double kThinnest = 0.5;
constexpr double kThickest = 4.0;
/// A near list is built if half of the approach of the motion is at most this fraction of the smallest
/// reach.
constexpr double kNear = 1.0;
/// The wide list is rebuilt when the searches beside it have visited one pair of leaves for every kWorn
/// pairs of the list, which costs about as much as a new list. Surfaces move from the start of a step to
/// its end: a list that is built near the end serves short motions without a search.
constexpr std::size_t kWorn = 4;
/// Rounding error of a distance, relative to the coordinates.
constexpr double kRounding = 1e-14;
/// The skin for boxes exceeds the margin for distances by this factor, because the two round
/// differently.
constexpr double kMore = 1.01;

/// Displacements of the vertices of a surface since the reference.
struct Travel {
  Vec3 mean = Vec3::Zero();
  double around_mean = 0.0;  ///< largest deviation from the mean
  double largest = 0.0;
};

/// Merge the unsorted pairs behind `middle` sorted pairs into order, each once.
void sort_in(std::size_t middle, Found& found) {
  std::vector<std::size_t> order(found.pairs.size() - middle);
  if (order.empty()) return;
  std::iota(order.begin(), order.end(), middle);
  std::ranges::sort(order, {}, [&](std::size_t k) -> const Candidate& { return found.pairs[k]; });
  Found all;
  all.pairs.reserve(found.pairs.size());
  all.apart.reserve(found.pairs.size());
  const auto take = [&](std::size_t k) {
    if (!all.pairs.empty() && all.pairs.back() == found.pairs[k]) return;
    all.push(found.pairs[k], found.apart[k]);
  };
  std::size_t first = 0;
  for (const std::size_t k : order) {
    while (first < middle && found.pairs[first] <= found.pairs[k]) take(first++);
    take(k);
  }
  while (first < middle) take(first++);
  std::swap(found, all);
}

/// Maximum in which NaN counts as the largest value.
void raise(double& largest, double value) {
  if (!(value <= largest) && !std::isnan(largest)) largest = value;
}

/// Travel of each surface. Vertices are grouped by surface.
std::vector<Travel> motions(const CollisionMesh& mesh, const double* from, const double* to) {
  std::vector<Travel> result(mesh.surface_count());
  for (Index first = 0, last = 0; first < mesh.vertex_count; first = last) {
    const Index surface = mesh.vertex_surface[first];
    while (last < mesh.vertex_count && mesh.vertex_surface[last] == surface) ++last;
    if (std::equal(from + 3 * first, from + 3 * last, to + 3 * first)) continue;  // at rest
    Travel motion;
    for (Index v = first; v < last; ++v) motion.mean += row(to, v) - row(from, v);
    motion.mean /= last - first;
    for (Index v = first; v < last; ++v) {
      const Vec3 u = row(to, v) - row(from, v);
      raise(motion.largest, u.squaredNorm());
      raise(motion.around_mean, (u - motion.mean).squaredNorm());
    }
    motion.largest = std::sqrt(motion.largest);  // one root for the maximum: roots keep the order
    motion.around_mean = std::sqrt(motion.around_mean);
    result[surface] = motion;
  }
  return result;
}

}  // namespace

/// Upper bound of the approach of every two surfaces since a reference, into approach_; 0 for surfaces
/// that may not touch. Returns the largest bound.
double CandidateList::measure_approach(const double* reference,
                                       const double* x_t0,
                                       const double* x_t1) {
  const CollisionMesh& mesh = broad_phase_->mesh();
  const auto count = static_cast<std::size_t>(mesh.surface_count());
  approach_.assign(count * count, 0.0);
  double result = 0.0;
  // Displacements of a straight motion are largest at one of its ends.
  for (const auto& [x, mean] : {std::pair(x_t0, &mean_t0_), std::pair(x_t1, &mean_t1_)}) {
    const std::vector<Travel> moved = motions(mesh, reference, x);
    mean->clear();
    for (const Travel& travel : moved) mean->push_back(travel.mean);
    for (std::size_t s = 0; s < count; ++s) {
      for (std::size_t r = 0; r < count; ++r) {
        if (!mesh.touching.contains(static_cast<Index>(s), static_cast<Index>(r))) continue;
        const double common =
            moved[s].around_mean + moved[r].around_mean + (moved[s].mean - moved[r].mean).norm();
        double& approach = approach_[s * count + r];
        raise(approach, std::min(common, moved[s].largest + moved[r].largest));
        raise(result, approach);
      }
    }
  }
  return result;
}

/// Build the wide list at the start of a motion.
void CandidateList::build(const double* x_t0,
                          const double* x_t1,
                          std::span<const double> reach,
                          BroadPhase::Scratch& scratch) {
  const auto size = 3 * static_cast<std::ptrdiff_t>(broad_phase_->mesh().vertex_count);
  wide_.reference.assign(x_t0, x_t0 + size);
  near_.reference.clear();
  reach_.assign(reach.begin(), reach.end());
  double largest = 0.0;
  for (const double value : wide_.reference) largest = std::max(largest, std::abs(value));
  rounding_ = kRounding * largest;
  const double approach = measure_approach(wide_.reference.data(), x_t0, x_t1);
  const double smallest = reach.empty() ? 0.0 : std::ranges::min(reach);
  // std::min and std::max in this order also handle a motion that is not finite.
  wide_.skin =
      std::max(kThinnest * smallest, std::min(kThickest * smallest, kAhead * 0.5 * approach));
  has_parts_ = false;
  looked_at_ = 0;
  ++builds_;
  with_skin_.clear();
  for (const double value : reach_) with_skin_.push_back(value + wide_.skin);
  broad_phase_->find_at_rest(x_t0, with_skin_, scratch, wide_.pairs);
  keep_near_ones(wide_);
}

/// Build the near list at the start of a motion with this approach.
void CandidateList::build_near(const double* x_t0, double approach, BroadPhase::Scratch& scratch) {
  near_.reference.clear();  // no valid list remains if an exception ends the search
  near_.skin = std::clamp(kAhead * 0.5 * approach,
                          reach_.empty() ? 0.0 : kThinnest * std::ranges::min(reach_), wide_.skin);
  with_skin_.clear();
  for (const double value : reach_) with_skin_.push_back(value + near_.skin);
  find_wide(x_t0, x_t0, with_skin_, near_.skin, scratch, found_);
  near_.reference.assign(x_t0, x_t0 + static_cast<std::ptrdiff_t>(wide_.reference.size()));
  near_.pairs = found_.pairs;
  keep_near_ones(near_);
}

/// Compute the distances of a list, and drop pairs beyond its skins: boxes may be near although the
/// primitives are not.
void CandidateList::keep_near_ones(Kept& kept) const {
  const CollisionMesh& mesh = broad_phase_->mesh();
  const double* const x = kept.reference.data();
  kept.distance = distances_sq(kept.pairs, x);
  kept.surfaces.clear();
  std::size_t count = 0;
  for (std::size_t k = 0; k < kept.pairs.size(); ++k) {
    const Candidate& pair = kept.pairs[k];
    const double distance = std::sqrt(kept.distance[k]);
    const Index s = mesh.vertex_surface[pair.vertices[0]];
    const Index r = mesh.vertex_surface[pair.vertices[3]];
    if (distance > reach_[s] + reach_[r] + 2.0 * (kept.skin + rounding_)) continue;
    kept.surfaces.push_back(s * mesh.surface_count() + r);
    kept.distance[count] = distance;
    kept.pairs[count++] = pair;
  }
  kept.distance.resize(count);
  kept.pairs.resize(count);
  kept.pairs.shrink_to_fit();  // often to almost nothing
  kept.middle = first_of_edges(kept.pairs);
}

/// Deviations of the vertices from the mean displacements of their surfaces, and differences of these
/// means.
void CandidateList::measure_deviations() {
  const CollisionMesh& mesh = broad_phase_->mesh();
  const auto count = static_cast<std::size_t>(mesh.surface_count());
  deviation_.resize(static_cast<std::size_t>(mesh.vertex_count));
  for (Index v = 0; v < mesh.vertex_count; ++v) {
    const Index s = mesh.vertex_surface[v];
    deviation_[v] = std::sqrt(std::max((row(u_t0_.data(), v) - mean_t0_[s]).squaredNorm(),
                                       (row(u_t1_.data(), v) - mean_t1_[s]).squaredNorm()));
  }
  mean_apart_.resize(count * count);
  for (std::size_t s = 0; s < count; ++s) {
    for (std::size_t r = 0; r < count; ++r) {
      mean_apart_[s * count + r] =
          std::max((mean_t0_[s] - mean_t0_[r]).norm(), (mean_t1_[s] - mean_t1_[r]).norm());
    }
  }
}

/// Select the stored pairs that may come within reach, by the bounds of measure_approach().
void CandidateList::cull(const Kept& kept,
                         const double* x_t0,
                         const double* x_t1,
                         std::span<const double> reach,
                         Found& out) {
  const std::size_t size = kept.reference.size();
  u_t0_.resize(size);
  u_t1_.resize(size);
  for (std::size_t a = 0; a < size; ++a) {
    u_t0_[a] = x_t0[a] - kept.reference[a];
    u_t1_[a] = x_t1[a] - kept.reference[a];
  }
  std::vector<double> together;  // for each pair of surfaces
  for (const double a : reach) {
    for (const double b : reach) together.push_back(a + b + 2.0 * rounding_);
  }
  measure_deviations();
  const auto spare = [&](Index k) { return kept.distance[k] - together[kept.surfaces[k]]; };
  // approach_ bounds a surface by its fastest part, and few pairs are that fast: per-vertex bounds
  // discard most of them before the corners of each pair are compared. The outcome is unpredictable:
  // every index is written, and the count advances by the outcome, without a branch.
  maybe_.resize(kept.pairs.size());
  Index count = 0;
  for (Index k = 0; k < static_cast<Index>(kept.pairs.size()); ++k) {
    maybe_[count] = k;
    count += static_cast<Index>(!(spare(k) > approach_[kept.surfaces[k]]));
  }
  const auto largest = [&](auto... v) { return std::max({deviation_[v]...}); };
  const Index before = count;
  count = 0;
  for (Index i = 0; i < before; ++i) {
    const Index k = maybe_[i];
    const auto& [a, b, c, d] = kept.pairs[k].vertices;
    const double deviation =
        k < kept.middle ? deviation_[a] + largest(b, c, d) : largest(a, b) + largest(c, d);
    maybe_[count] = k;
    count += static_cast<Index>(!(spare(k) > deviation + mean_apart_[kept.surfaces[k]]));
  }
  out.resize(count);
  std::size_t found = 0;
  for (const Index k : std::span(maybe_).first(count)) {
    const double moved = std::sqrt(approach_sq(kept.pairs[k], u_t0_.data(), u_t1_.data()));
    out.pairs[found] = kept.pairs[k];
    out.apart[found] = kept.distance[k] - 2.0 * rounding_ - moved;
    found += static_cast<std::size_t>(!(spare(k) > moved));
  }
  out.resize(found);
}

/// Find all pairs that may come within reach, in the wide list and beside it.
///
/// @param widened  excess of each reach over the reach of the list [m]
void CandidateList::find_wide(const double* x_t0,
                              const double* x_t1,
                              std::span<const double> reach,
                              double widened,
                              BroadPhase::Scratch& scratch,
                              Found& out) {
  const double approach = measure_approach(wide_.reference.data(), x_t0, x_t1);
  cull(wide_, x_t0, x_t1, reach, out);
  const double least = 2.0 * (wide_.skin - widened) - rounding_;
  if (approach <= least) return;
  if (!has_parts_) relative_search_.start(wide_.reference.data());
  has_parts_ = true;
  const std::size_t middle = out.pairs.size();
  looked_at_ += relative_search_.find({.reference = wide_.reference.data(),
                                       .x_t0 = x_t0,
                                       .x_t1 = x_t1,
                                       .u_t0 = u_t0_.data(),  // computed by cull()
                                       .u_t1 = u_t1_.data(),
                                       .reach = reach,
                                       .least = std::max(least, 0.0),
                                       .rounding = 2.0 * (rounding_ + kRounding * approach)},
                                      scratch, out);
  sort_in(middle, out);
}

void CandidateList::find_at(const double* x,
                            std::span<const double> reach,
                            double widened,
                            std::span<const char> wanted,
                            BroadPhase::Scratch& scratch,
                            std::vector<Candidate>& out) {
  const CollisionMesh& mesh = broad_phase_->mesh();
  const Index count = mesh.surface_count();
  // Largest distance of the pairs of two surfaces; negative if the pair of surfaces is not wanted.
  std::vector<double> range;
  for (Index s = 0; s < count; ++s) {
    for (Index r = 0; r < count; ++r) {
      const bool both = wanted[s] != 0 && wanted[r] != 0;
      range.push_back(both ? reach[s] + reach[r] + 2.0 * widened : -1.0);
    }
  }
  const std::vector<double>& reference = wide_.reference;
  if (!reference.empty() && kMore * widened <= wide_.skin && std::ranges::equal(reach, reach_) &&
      std::equal(reference.begin(), reference.end(), x)) {
    out.clear();
    for (std::size_t k = 0; k < wide_.pairs.size(); ++k) {
      if (wide_.distance[k] <= range[wide_.surfaces[k]]) out.push_back(wide_.pairs[k]);
    }
    return;
  }
  with_skin_.clear();
  for (const double value : reach) with_skin_.push_back(value + kMore * widened);
  broad_phase_->find_at_rest(x, with_skin_, scratch, out);
  const std::vector<double> d_sq = distances_sq(out, x);
  std::size_t kept = 0;
  for (std::size_t k = 0; k < out.size(); ++k) {
    const std::array<Index, 4>& v = out[k].vertices;
    const double limit = range[mesh.vertex_surface[v[0]] * count + mesh.vertex_surface[v[3]]];
    if (limit < 0.0 || std::sqrt(d_sq[k]) > limit) continue;
    out[kept++] = out[k];
  }
  out.resize(kept);
}

void CandidateList::find(const double* x_t0,
                         const double* x_t1,
                         std::span<const double> reach,
                         BroadPhase::Scratch& scratch,
                         Found& out) {
  if (!std::ranges::equal(reach, reach_)) {
    wide_.reference.clear();
    near_.reference.clear();
  }
  if (!near_.reference.empty() &&
      measure_approach(near_.reference.data(), x_t0, x_t1) + rounding_ <= 2.0 * near_.skin) {
    cull(near_, x_t0, x_t1, reach, out);
    return;
  }
  const double approach = measure_approach(x_t0, x_t0, x_t1);
  if (!std::isfinite(approach)) {
    broad_phase_->find(x_t0, x_t1, reach, scratch, out.pairs);
    out.apart.assign(out.pairs.size(), 0.0);
    return;
  }
  const bool is_worn = kWorn * looked_at_ > wide_.pairs.size();
  if (wide_.reference.empty() || is_worn) build(x_t0, x_t1, reach, scratch);
  const double thickest = reach.empty() ? 0.0 : kNear * std::ranges::min(reach);
  if (!(approach + rounding_ <= 2.0 * std::min(thickest, wide_.skin))) {
    find_wide(x_t0, x_t1, reach, 0.0, scratch, out);
    return;
  }
  build_near(x_t0, approach, scratch);
  measure_approach(near_.reference.data(), x_t0, x_t1);
  cull(near_, x_t0, x_t1, reach, out);
}

}  // namespace diffcloth::contact
