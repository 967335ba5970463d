#include "contact/candidate_list.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "contact/distance/separation.h"

namespace diffcloth::contact {
namespace {

/// A skin is this many times the motion at hand, but within these shares of the smallest and of the
/// largest reach: a thin one is soon used up, a thick one holds pairs that never meet. What is
/// thick itself has enough of these already.
constexpr double kAhead = 2.0;
constexpr double kThinnest = 0.5;
constexpr double kThickest = 4.0;
/// Rounding of a distance, relative to the coordinates.
constexpr double kRounding = 1e-14;

/// What the vertices of a surface have done since the reference.
struct Motion {
  Vec3 mean = Vec3::Zero();
  double around_mean = 0.0;  ///< largest deviation from it
  double largest = 0.0;
};

/// NaN counts as the largest of all.
void raise(double& largest, double value) {
  if (!(value <= largest)) largest = value;
}

std::vector<Motion> motions(const CollisionMesh& mesh, const double* from, const double* to) {
  std::vector<Motion> result(mesh.surface_count());
  std::vector<Index> count(result.size(), 0);
  for (Index v = 0; v < mesh.vertex_count; ++v) {
    result[mesh.vertex_surface[v]].mean += row(to, v) - row(from, v);
    ++count[mesh.vertex_surface[v]];
  }
  for (std::size_t s = 0; s < result.size(); ++s) result[s].mean /= std::max(count[s], 1);
  for (Index v = 0; v < mesh.vertex_count; ++v) {
    Motion& motion = result[mesh.vertex_surface[v]];
    const Vec3 u = row(to, v) - row(from, v);
    raise(motion.largest, u.norm());
    raise(motion.around_mean, (u - motion.mean).norm());
  }
  return result;
}

}  // namespace

void CandidateList::measure_approach(const double* x_t0,
                                     const double* x_t1,
                                     std::vector<double>& out) const {
  const CollisionMesh& mesh = broad_phase_->mesh();
  const auto count = static_cast<std::size_t>(mesh.surface_count());
  out.assign(count * count, 0.0);
  // Along a straight motion displacements are largest at one of its ends.
  for (const double* x : {x_t0, x_t1}) {
    const std::vector<Motion> moved = motions(mesh, reference_.data(), x);
    for (std::size_t s = 0; s < count; ++s) {
      for (std::size_t r = 0; r < count; ++r) {
        if (!mesh.touching.contains(static_cast<Index>(s), static_cast<Index>(r))) continue;
        const double common =
            moved[s].around_mean + moved[r].around_mean + (moved[s].mean - moved[r].mean).norm();
        raise(out[s * count + r], std::min(common, moved[s].largest + moved[r].largest));
      }
    }
  }
}

/// Square of how much the two primitives of a pair can have come closer since the reference, at most:
/// the largest change of a vector between their corners. That between any two of their points is a
/// mean of those.
double CandidateList::pair_approach_sq(const Candidate& pair,
                                       const double* x_t0,
                                       const double* x_t1) const {
  const int first = pair.kind == PairKind::kPointTriangle ? 1 : 2;  // corner of the second one
  double result = 0.0;
  for (const double* x : {x_t0, x_t1}) {
    std::array<Vec3, 4> u;
    for (int i = 0; i < 4; ++i) {
      u[i] = row(x, pair.vertices[i]) - row(reference_.data(), pair.vertices[i]);
    }
    for (int i = 0; i < first; ++i) {
      for (int j = first; j < 4; ++j) raise(result, (u[i] - u[j]).squaredNorm());
    }
  }
  return result;
}

/// Whether no pair beyond the skin can have come within reach.
bool CandidateList::covers(std::span<const double> approach, std::span<const double> reach) const {
  if (!std::ranges::equal(reach, reach_)) return false;
  const CollisionMesh& mesh = broad_phase_->mesh();
  const auto count = static_cast<std::size_t>(mesh.surface_count());
  for (std::size_t s = 0; s < count; ++s) {
    for (std::size_t r = s; r < count; ++r) {
      if (!(approach[s * count + r] + rounding_ <= 2.0 * skin_)) return false;
    }
  }
  return true;
}

/// Make the list at the start of a motion. False where that is so long that its own candidates are
/// better than a thick skin.
bool CandidateList::build(const double* x_t0,
                          const double* x_t1,
                          std::span<const double> reach,
                          BroadPhase::Scratch& scratch) {
  const CollisionMesh& mesh = broad_phase_->mesh();
  const auto count = static_cast<std::size_t>(mesh.surface_count());
  reference_.assign(x_t0, x_t0 + 3 * static_cast<std::size_t>(mesh.vertex_count));
  reach_.assign(reach.begin(), reach.end());
  double size = 0.0;
  for (const double value : reference_) size = std::max(size, std::abs(value));
  rounding_ = kRounding * size;
  const auto [smallest, largest] = std::ranges::minmax_element(reach);
  const double least = reach.empty() ? 0.0 : kThinnest * *smallest;
  const double most = reach.empty() ? 0.0 : kThickest * *largest;
  measure_approach(x_t0, x_t1, approach_);
  double approach = 0.0;
  for (const double value : approach_) raise(approach, value);
  skin_ = std::clamp(kAhead * 0.5 * approach, least, most);
  if (!covers(approach_, reach)) {
    reference_.clear();
    return false;
  }
  ++builds_;
  std::vector<double> with_skin(reach_);
  for (double& value : with_skin) value += skin_;
  broad_phase_->find(x_t0, x_t0, with_skin, scratch, kept_);
  distance_.clear();
  surfaces_.clear();
  std::erase_if(kept_, [&](const Candidate& pair) {
    const auto& v = pair.vertices;
    const Corners corner{row(x_t0, v[0]), row(x_t0, v[1]), row(x_t0, v[2]), row(x_t0, v[3])};
    const double distance = std::sqrt(distance_sq(pair.kind, corner));
    const Index s = mesh.vertex_surface[v[0]];
    const Index r = mesh.vertex_surface[v[3]];
    // Boxes are near sooner than what is in them.
    if (distance > with_skin[s] + with_skin[r] + 2.0 * rounding_) return true;
    distance_.push_back(distance);
    surfaces_.push_back(s * static_cast<Index>(count) + r);
    return false;
  });
  return true;
}

void CandidateList::find(const double* x_t0,
                         const double* x_t1,
                         std::span<const double> reach,
                         BroadPhase::Scratch& scratch,
                         std::vector<Candidate>& out) {
  bool usable = false;
  if (!reference_.empty()) {
    measure_approach(x_t0, x_t1, approach_);
    usable = covers(approach_, reach);
  }
  if (!usable && !build(x_t0, x_t1, reach, scratch)) {
    broad_phase_->find(x_t0, x_t1, reach, scratch, out);
    return;
  }
  // From here on approach_ is how near pairs may have come.
  const auto count = static_cast<std::size_t>(broad_phase_->mesh().surface_count());
  for (std::size_t s = 0; s < count; ++s) {
    for (std::size_t r = 0; r < count; ++r) {
      approach_[s * count + r] += reach[s] + reach[r] + 2.0 * rounding_;
    }
  }
  out.clear();
  for (std::size_t k = 0; k < kept_.size(); ++k) {
    if (distance_[k] > approach_[surfaces_[k]]) continue;
    // A surface counts as near as its fastest part; few of its pairs are.
    const Index s = surfaces_[k];
    const double together = reach[s / count] + reach[s % count] + 2.0 * rounding_;
    const double spare = distance_[k] - together;
    if (spare > 0.0 && spare * spare > pair_approach_sq(kept_[k], x_t0, x_t1)) continue;
    out.push_back(kept_[k]);
  }
}

}  // namespace diffcloth::contact
