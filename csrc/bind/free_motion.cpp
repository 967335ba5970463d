#include "bodies/free_motion.h"

#include <memory>
#include <string>

#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include "bind/bind.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;  // NOLINT: the literal suffix of nanobind
using bodies::FreeMotion;

using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Indices = std::vector<Index>;

void require(bool holds, const char* what) {
  if (!holds) throw nb::value_error(what);
}

void make(FreeMotion* self,
          const Indices& parent,
          const Indices& order,
          const Indices& kind,
          const Doubles& offset,
          const Doubles& axis,
          const Indices& dof,
          const Doubles& multiplier,
          const Doubles& constant,
          Index joint_count,
          Indices solved,
          bool root_moves,
          double dt) {
  const std::size_t count = parent.size();
  require(order.size() == count && kind.size() == count && dof.size() == count &&
              offset.size() == 16 * count && axis.size() == 3 * count &&
              multiplier.size() == count && constant.size() == count,
          "free motion: arrays of links must have one entry a link");
  std::vector<char> placed(count, 0);
  for (const Index l : order) {
    require(l >= 0 && static_cast<std::size_t>(l) < count && placed[l] == 0 &&
                (parent[l] < 0 ||
                 (static_cast<std::size_t>(parent[l]) < count && placed[parent[l]] != 0)),
            "free motion: `order` must hold every link once, parents before their children");
    placed[l] = 1;
  }
  std::vector<bodies::Link> links;
  for (std::size_t l = 0; l < count; ++l) {
    require(kind[l] >= 0 && kind[l] <= static_cast<Index>(bodies::JointKind::kPrismatic) &&
                dof[l] < joint_count && (kind[l] == 0 || dof[l] >= 0),
            "free motion: kinds and joints of links must be in range");
    const double* t = offset.data() + 16 * l;
    bodies::Mat34 frame;
    frame << t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7], t[8], t[9], t[10], t[11];
    links.push_back({.tree = 0,
                     .parent = parent[l],
                     .kind = static_cast<bodies::JointKind>(kind[l]),
                     .offset = frame,
                     .axis = row(axis.data(), static_cast<Index>(l)),
                     .coordinate = dof[l],
                     .multiplier = multiplier.data()[l],
                     .constant = constant.data()[l]});
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

  auto memory = std::make_unique<double[]>(b * n + 1);
  auto flags = std::make_unique<bool[]>(b + 1);
  for (std::size_t e = 0; e < b; ++e) {
    flags[e] = self.solve({.mass = m.of(e),
                           .center = c.of(e),
                           .inertia = i.of(e),
                           .armature = a.of(e),
                           .root_center = rc.of(e),
                           .root_rotation = rr.of(e),
                           .joints = q.of(e),
                           .known = k.of(e),
                           .momentum = p.of(e)},
                          memory.get() + e * n);
  }
  double* const values = memory.release();
  bool* const found = flags.release();
  const nb::capsule own_values(values, [](void* x) noexcept { delete[] static_cast<double*>(x); });
  const nb::capsule own_found(found, [](void* x) noexcept { delete[] static_cast<bool*>(x); });
  return nb::make_tuple(nb::ndarray<nb::numpy, double>(values, {b, n}, own_values),
                        nb::ndarray<nb::numpy, bool>(found, {b}, own_found));
}

}  // namespace

void free_motion(nb::module_& m) {
  nb::class_<FreeMotion>(m, "FreeMotion")
      .def("__init__", &make, "parent"_a, "order"_a, "kind"_a, "offset"_a, "axis"_a, "dof"_a,
           "multiplier"_a, "constant"_a, "joint_count"_a, "solved"_a, "root_moves"_a, "dt"_a)
      .def("solve", &solve, "mass"_a, "center"_a, "inertia"_a, "armature"_a, "root_center"_a,
           "root_rotation"_a, "joints"_a, "known"_a, "momentum"_a,
           "Velocities [B, n] that are solved for, and whether they were found [B].");
}

}  // namespace diffcloth::bind
