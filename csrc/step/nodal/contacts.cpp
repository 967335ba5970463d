#include "step/nodal/contacts.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <optional>
#include <utility>

#include "step/potentials/constant_form.h"

namespace diffcloth::step {

using projective::NodalContact;
using projective::Obstacle;

namespace {

/// Couplings of rows near vertices in contact with each other: the eliminated unknowns of a pair couple
/// all neighbors of both vertices.
class PairPattern final : public Potential {
 public:
  PairPattern(const linalg::BlockPattern& base,
              const std::vector<Index>& partner,
              const std::vector<char>& prescribed) {
    const auto rows = static_cast<Index>(partner.size());
    for (Index q = 0; q < rows; ++q) {
      for (Index k = base.column_start()[q]; k < base.column_start()[q + 1]; ++k) {
        const Index p = base.row()[k];
        if (p >= rows || (partner[p] < 0 && partner[q] < 0)) continue;
        for (const Index a : {p, partner[p]}) {
          for (const Index b : {q, partner[q]}) {
            if (a < 0 || b < 0 || a == b || prescribed[a] != 0 || prescribed[b] != 0) continue;
            pairs_.emplace_back(std::max(a, b), std::min(a, b));
          }
        }
      }
    }
  }

  double energy(const double* /*x*/) const override { return 0.0; }
  double energy_change(const double* /*x*/, const double* /*to*/) const override { return 0.0; }
  void add_gradient(const double* /*x*/, double* /*g*/) const override {}
  void add_couplings(std::vector<std::pair<Index, Index>>& pairs) const override {
    pairs.insert(pairs.end(), pairs_.begin(), pairs_.end());
  }
  void add_hessian(const double* /*x*/,
                   Curvature /*curvature*/,
                   linalg::BlockMatrix& /*A*/) const override {}
  void add_hessian_product(const double* /*x*/, const double* /*z*/, double* /*y*/) const override {
  }
  void accumulate(const double* /*x*/, const double* /*z*/) override {}
  void add_tangent(const double* /*x*/, double* /*y*/) const override {}
  void swap_cotangents(CotangentStore& /*store*/) override {}

 private:
  std::vector<std::pair<Index, Index>> pairs_;
};

double pair_friction(const Problem& p, Index a, Index b) {
  const View mu = p.inputs[Input::kFriction];
  const Index surfaces = p.scene.surface_count();
  if (mu.count == 1) return mu.data[0];
  return 0.5 * (mu.data[a * surfaces + b] + mu.data[b * surfaces + a]);
}

/// True if two surfaces may touch: pairs that the user ignores may not.
bool may_touch(const Problem& p, Index a, Index b) {
  const std::array<Index, 2> pair{std::min(a, b), std::max(a, b)};
  return std::ranges::find(p.scene.given.ignored_pairs, pair) == p.scene.given.ignored_pairs.end();
}

std::vector<Obstacle> make_obstacles(const Problem& p) {
  const Scene& scene = p.scene;
  std::vector<Obstacle> obstacles;
  for (std::size_t k = 0; k < scene.given.primitives.size(); ++k) {
    if (scene.given.primitives[k].kind == projective::PrimitiveKind::kNone) continue;
    const auto body = static_cast<Index>(k);
    const Index surface = scene.cloth_count() + body;
    const std::ptrdiff_t pose = 7 * static_cast<std::ptrdiff_t>(scene.given.bodies.pose[k]);
    Obstacle& o = obstacles.emplace_back();
    o.body = body;
    o.shape = scene.given.primitives[k];
    o.start = Eigen::Map<const bodies::Pose>(p.inputs.data(Input::kBodyPoses) + pose);
    o.end = Eigen::Map<const bodies::Pose>(p.inputs.data(Input::kBodyTargets) + pose);
    const double* thickness = p.inputs.data(Input::kThickness);
    for (Index c = 0; c < scene.cloth_count(); ++c) {
      o.friction.push_back(pair_friction(p, c, surface));
      o.band.push_back(may_touch(p, c, surface) ? 0.5 * (thickness[c] + thickness[surface])
                                                : -std::numeric_limits<double>::infinity());
    }
  }
  return obstacles;
}

/// Contact between vertices of cloths; absent if none is possible.
std::optional<projective::Touching> make_touching(const Problem& p) {
  const Scene& scene = p.scene;
  if (scene.scheme().has_barrier) return {};
  projective::Touching touching{.spheres = &scene.vertex_spheres, .friction = {}, .may_touch = {}};
  for (Index a = 0; a < scene.cloth_count(); ++a) {
    for (Index b = 0; b < scene.cloth_count(); ++b) {
      touching.friction.push_back(pair_friction(p, a, b));
      const bool touch = may_touch(p, a, b) && (a != b || scene.given.self_contact);
      touching.may_touch.push_back(touch ? 1 : 0);
    }
  }
  if (std::ranges::count(touching.may_touch, 1) == 0) return {};
  return touching;
}

}  // namespace

projective::Swept swept(const Problem& p) {
  return {.x = p.inputs.data(Input::kPositions),
          .predicted = p.inertia.target().data(),
          .h = p.h,
          .cloth = p.scene.vertex_cloth,
          .prescribed = p.scene.prescribed};
}

NodalContacts::NodalContacts(Problem& problem) : obstacles(make_obstacles(problem)) {
  const Scene& scene = problem.scene;
  if (problem.inputs.data(Input::kFriction) == nullptr) return;  // nothing can touch
  const std::optional<projective::Touching> touching = make_touching(problem);
  list = projective::find_contacts(swept(problem), obstacles, touching ? &*touching : nullptr);
  if (list.empty()) return;
  const elastic::ConstantForm form = constant_form(problem);
  for (std::size_t i = 0; i < problem.masses.size(); ++i) {
    const double stiffness = form.values()[form.pattern().column_start()[i]];
    inertia.push_back(problem.masses[i] + problem.h * problem.h * stiffness);
  }
  partner.assign(problem.masses.size(), -1);
  bool pairs = false;
  for (const NodalContact& c : list) {
    if (c.partner < 0) continue;
    partner[c.vertex] = c.partner;
    partner[c.partner] = c.vertex;
    pairs = true;
  }
  if (pairs) {
    couplings =
        std::make_unique<PairPattern>(scene.elastic_patterns.base(), partner, scene.prescribed);
  }
}

}  // namespace diffcloth::step
