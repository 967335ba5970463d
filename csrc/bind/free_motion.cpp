#include "bodies/free_motion.h"

#include <algorithm>
#include <array>
#include <string>
#include <utility>
#include <vector>

#include <nanobind/stl/vector.h>

#include "bind/arrays.h"
#include "bind/bind.h"
#include "bind/links.h"
#include "bodies/free_turn.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;  // NOLINT: the literal suffix of nanobind
using bodies::FreeMotion;

void require(bool holds, const char* what) {
  if (!holds) throw nb::value_error(what);
}

void make(FreeMotion* self,
          const std::vector<Index>& parent,
          const std::vector<Index>& order,
          const std::vector<Index>& kind,
          const Doubles& offset,
          const Doubles& axis,
          const std::vector<Index>& dof,
          const Doubles& multiplier,
          const Doubles& constant,
          Index joint_count,
          std::vector<Index> solved,
          bool root_moves,
          double dt) {
  const std::size_t count = parent.size();
  std::vector<bodies::Link> links = to_links({.tree = std::vector<Index>(count, 0),
                                              .parent = parent,
                                              .kind = kind,
                                              .offset = to_vector(offset),
                                              .axis = to_vector(axis),
                                              .coordinate = dof,
                                              .multiplier = to_vector(multiplier),
                                              .constant = to_vector(constant)},
                                             joint_count);
  constexpr const char* kOrder =
      "free motion: `order` must hold every link once, parents before their children";
  require(order.size() == count, kOrder);
  std::vector<char> placed(count, 0);
  for (const Index l : order) {
    require(l >= 0 && std::cmp_less(l, count) && placed[l] == 0, kOrder);
    require(parent[l] < 0 || (std::cmp_less(parent[l], count) && placed[parent[l]] != 0), kOrder);
    placed[l] = 1;
  }
  for (const Index i : solved) {
    require(i >= 0 && i < 6 + joint_count, "free motion: `solved` must be rows of the velocities");
  }
  new (self) FreeMotion(std::move(links), order, joint_count, std::move(solved), root_moves, dt);
}

/// Arrays of all environments, or of one for all.
struct Rows {
  const char* name;
  Doubles array;
  std::size_t count;  ///< numbers of an environment

  Rows(const char* name, const Doubles& array, std::size_t count, std::size_t environments)
      : name(name), array(array), count(count) {
    if (array.size() != count && array.size() != count * environments) {
      throw nb::value_error((std::string("free motion: `") + name + "` must have " +
                             std::to_string(count) + " numbers an environment")
                                .c_str());
    }
  }
  const double* of(std::size_t e) const {
    return array.data() + (array.size() == count ? 0 : e * count);
  }
};

nb::object solve(const FreeMotion& self,
                 const Doubles& mass,
                 const Doubles& center,
                 const Doubles& inertia,
                 const Doubles& armature,
                 const Doubles& root_center,
                 const Doubles& root_rotation,
                 const Doubles& joints,
                 const Doubles& known,
                 const Doubles& momentum) {
  const auto l = static_cast<std::size_t>(self.link_count());
  const auto j = static_cast<std::size_t>(self.joint_count());
  const auto n = static_cast<std::size_t>(self.solved_count());
  const std::size_t b = momentum.ndim() == 0 ? 0 : momentum.shape(0);
  const Rows m("mass", mass, l, b);
  const Rows c("center", center, 3 * l, b);
  const Rows i("inertia", inertia, 9 * l, b);
  const Rows a("armature", armature, j, b);
  const Rows rc("root_center", root_center, 3, b);
  const Rows rr("root_rotation", root_rotation, 9, b);
  const Rows q("joints", joints, j, b);
  const Rows k("known", known, 6 + j, b);
  const Rows p("momentum", momentum, 6 + j, b);

  const Owned<double> velocities = make_array<double>({b, n});
  const Owned<bool> found = make_array<bool>({b});
  for (std::size_t e = 0; e < b; ++e) {
    found.data[e] = self.solve({.mass = m.of(e),
                                .center = c.of(e),
                                .inertia = i.of(e),
                                .armature = a.of(e),
                                .root_center = rc.of(e),
                                .root_rotation = rr.of(e),
                                .joints = q.of(e),
                                .known = k.of(e),
                                .momentum = p.of(e)},
                               velocities.data + e * n);
  }
  return nb::make_tuple(velocities.array, found.array);
}

nb::object turns(const Doubles& inertia, const Doubles& momentum, double time, bool with_rates) {
  const std::size_t n = momentum.size() / 3;
  require(momentum.size() == 3 * n, "free turns: `momentum` must have 3 numbers a body");
  require(inertia.size() == 9 * n, "free turns: `inertia` must have 9 numbers a body");
  const Owned<double> turn = make_array<double>({n, 4});
  const Owned<double> rate = make_array<double>({with_rates ? n : 0, 4, 12});
  const Owned<bool> found = make_array<bool>({n});
  bodies::Turn q{};
  bodies::TurnRate dq{};
  for (std::size_t k = 0; k < n; ++k) {
    found.data[k] = bodies::free_turn(inertia.data() + 9 * k, momentum.data() + 3 * k, time, q,
                                      with_rates ? &dq : nullptr);
    if (!found.data[k]) continue;
    std::ranges::copy(q, turn.data + 4 * k);
    for (std::size_t i = 0; with_rates && i < 4; ++i) {
      std::ranges::copy(dq[i], rate.data + 12 * (4 * k + i));
    }
  }
  return nb::make_tuple(turn.array, rate.array, found.array);
}

}  // namespace

void free_motion(nb::module_& m) {
  m.def(
      "free_turns", &turns, "inertia"_a, "momentum"_a, "time"_a, "with_rates"_a,
      "Quaternions [n, 4] by which free bodies turn in their own axes, their derivatives by J and "
      "l [n, 4, 12], and whether they were found [n].");
  nb::class_<FreeMotion>(m, "FreeMotion")
      .def("__init__", &make, "parent"_a, "order"_a, "kind"_a, "offset"_a, "axis"_a, "dof"_a,
           "multiplier"_a, "constant"_a, "joint_count"_a, "solved"_a, "root_moves"_a, "dt"_a)
      .def("solve", &solve, "mass"_a, "center"_a, "inertia"_a, "armature"_a, "root_center"_a,
           "root_rotation"_a, "joints"_a, "known"_a, "momentum"_a,
           "Velocities [B, n] that are solved for, and whether they were found [B].");
}

}  // namespace diffcloth::bind
