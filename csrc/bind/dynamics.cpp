#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include "bind/arrays.h"
#include "bind/bind.h"
#include "bind/environments.h"
#include "bind/links.h"
#include "bodies/body_functions.h"
#include "bodies/link_frames.h"
#include "bodies/robot_functions.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;  // NOLINT: the literal suffix of nanobind
using bodies::Linearized;
using bodies::SmoothFunction;

[[noreturn]] void refuse(const std::string& what) { throw nb::value_error(what.c_str()); }

/// Index of an array of a function by name; the number of arrays if there is none.
std::size_t find(const std::vector<SmoothFunction::Array>& arrays, const std::string& name) {
  std::size_t i = 0;
  while (i < arrays.size() && arrays[i].name != name) ++i;
  return i;
}

/// Arrays of all environments by the names of a function, with one row for each environment or one for
/// all, behind `leading` axes.
class Rows {
 public:
  Rows(const std::vector<SmoothFunction::Array>& arrays, const nb::dict& given, std::size_t leading)
      : arrays_(arrays), given_(arrays.size()), copies_(arrays.size(), 0) {
    for (const auto [key, value] : given) {
      const auto name = nb::cast<std::string>(key);
      const std::size_t i = find(arrays, name);
      if (i == arrays.size()) refuse("dynamics: unknown array `" + name + "`");
      given_[i] = nb::cast<Doubles>(value);
      copies_[i] = given_[i].ndim() <= leading ? 0 : given_[i].shape(leading);
      std::size_t rows = copies_[i];
      for (std::size_t axis = 0; axis < leading && rows > 0; ++axis) rows *= given_[i].shape(axis);
      if (copies_[i] == 0 || given_[i].size() != rows * arrays[i].size()) {
        refuse("dynamics: `" + name + "` must have " + std::to_string(arrays[i].size()) +
               " numbers an environment");
      }
      environments_ = std::max(environments_, copies_[i]);
    }
    for (std::size_t i = 0; i < arrays.size(); ++i) {
      if (copies_[i] > 1 && copies_[i] != environments_) {
        refuse("dynamics: `" + arrays[i].name + "` must have 1 or " +
               std::to_string(environments_) + " environments");
      }
    }
  }

  void require_all() const {
    for (std::size_t i = 0; i < arrays_.size(); ++i) {
      if (copies_[i] == 0 && !arrays_[i].is_optional) {
        refuse("dynamics: `" + arrays_[i].name + "` is missing");
      }
    }
  }

  void require(std::size_t environments) const {
    if (environments_ > environments) refuse("dynamics: too many environments");
  }

  std::size_t environments() const { return environments_; }
  std::size_t copies(std::size_t i) const { return copies_[i]; }

  /// Arrays of an environment; null if not given. `turn` is the index along the leading axis.
  std::vector<const double*> row(std::size_t e, std::size_t turn = 0) const {
    std::vector<const double*> result(arrays_.size(), nullptr);
    for (std::size_t i = 0; i < arrays_.size(); ++i) {
      if (copies_[i] == 0) continue;
      result[i] =
          given_[i].data() + arrays_[i].size() * (turn * copies_[i] + (copies_[i] > 1 ? e : 0));
    }
    return result;
  }

 private:
  const std::vector<SmoothFunction::Array>& arrays_;
  std::vector<Doubles> given_;
  std::vector<std::size_t> copies_;
  std::size_t environments_ = 1;
};

/// Create zero arrays [leading.., ...] of a function's outputs, and add them to `out` by name.
std::vector<double*> make_outputs(const SmoothFunction& function,
                                  const std::vector<std::size_t>& leading,
                                  nb::dict& out) {
  std::vector<double*> data;
  for (const SmoothFunction::Array& array : function.outputs()) {
    std::vector<std::size_t> shape = leading;
    shape.insert(shape.end(), array.shape.begin(), array.shape.end());
    const Owned<double> owned = make_array<double>(shape);
    data.push_back(owned.data);
    out[array.name.c_str()] = owned.array;
  }
  return data;
}

std::vector<double*> row_of(const SmoothFunction& function,
                            const std::vector<double*>& data,
                            std::size_t row) {
  std::vector<double*> result(data);
  for (std::size_t i = 0; i < result.size(); ++i) result[i] += row * function.outputs()[i].size();
  return result;
}

nb::dict values(const SmoothFunction& function, const nb::dict& inputs, int threads) {
  const Rows given(function.inputs(), inputs, 0);
  given.require_all();
  nb::dict out;
  const std::vector<double*> data = make_outputs(function, {given.environments()}, out);
  for_environments(given.environments(), threads, {}, [&](Index e, const Checkpoint&) {
    function.evaluate(given.row(e), row_of(function, data, e));
  });
  return out;
}

nb::dict gradients(const SmoothFunction& function,
                   const nb::dict& inputs,
                   const nb::dict& cotangents,
                   std::size_t losses,
                   const std::vector<std::string>& needs,
                   int threads) {
  const Rows given(function.inputs(), inputs, 0);
  given.require_all();
  const Rows from(function.outputs(), cotangents, 1);
  from.require(given.environments());
  const std::size_t environments = given.environments();
  const std::size_t count = function.inputs().size();
  std::vector<char> varies(count, 0);
  std::vector<std::vector<double>> parts(count);  // [environments, losses, size]
  for (const std::string& name : needs) {
    const std::size_t i = find(function.inputs(), name);
    if (i == count || given.copies(i) == 0) refuse("dynamics: no input `" + name + "`");
    varies[i] = 1;
    parts[i].resize(environments * losses * function.inputs()[i].size());
  }
  for_environments(environments, threads, {}, [&](Index e, const Checkpoint&) {
    Linearized at(function, given.row(e), varies);
    for (std::size_t loss = 0; loss < losses; ++loss) {
      std::vector<double*> own(count, nullptr);
      for (std::size_t i = 0; i < count; ++i) {
        if (varies[i] == 0) continue;
        own[i] = parts[i].data() + (e * losses + loss) * function.inputs()[i].size();
      }
      at.pull_back(from.row(e, loss), own);
    }
  });
  nb::dict out;
  for (std::size_t i = 0; i < count; ++i) {
    if (varies[i] == 0) continue;
    const std::size_t size = function.inputs()[i].size();
    const std::size_t copies = given.copies(i);
    const Owned<double> sum = make_array<double>({losses, copies, size});
    for (std::size_t e = 0; e < environments; ++e) {  // serial: the sum has a fixed order
      for (std::size_t loss = 0; loss < losses; ++loss) {
        double* const to = sum.data + size * (loss * copies + (copies > 1 ? e : 0));
        const double* const part = parts[i].data() + size * (e * losses + loss);
        for (std::size_t k = 0; k < size; ++k) to[k] += part[k];
      }
    }
    out[function.inputs()[i].name.c_str()] = sum.array;
  }
  return out;
}

nb::dict tangents(const SmoothFunction& function,
                  const nb::dict& inputs,
                  const nb::dict& directions,
                  std::size_t count,
                  int threads) {
  const Rows given(function.inputs(), inputs, 0);
  given.require_all();
  const Rows along(function.inputs(), directions, 1);
  const std::size_t environments = given.environments();
  along.require(environments);
  std::vector<char> varies(function.inputs().size(), 0);
  for (std::size_t i = 0; i < varies.size(); ++i) varies[i] = along.copies(i) > 0 ? 1 : 0;
  nb::dict out;
  const std::vector<double*> data = make_outputs(function, {count, environments}, out);
  for_environments(environments, threads, {}, [&](Index e, const Checkpoint&) {
    Linearized at(function, given.row(e), varies);
    for (std::size_t k = 0; k < count; ++k) {
      at.push_forward(along.row(e, k), row_of(function, data, k * environments + e));
    }
  });
  return out;
}

void require(bool holds, const char* what) {
  if (!holds) refuse(what);
}

// Values in the order of their names in Python.
constexpr std::array kBases{bodies::Base::kFixed, bodies::Base::kKinematic,
                            bodies::Base::kFloating};
constexpr std::array kActuations{bodies::Actuation::kPosition, bodies::Actuation::kVelocity,
                                 bodies::Actuation::kTorque, bodies::Actuation::kDrive};

template <class Table>
auto at(const Table& table, Index i, const char* what) {
  require(i >= 0 && std::cmp_less(i, table.size()), what);
  return table[i];
}

bodies::Tree make_tree(const std::vector<Index>& parent,
                       const std::vector<Index>& order,
                       const std::vector<Index>& kind,
                       const Doubles& offset,
                       const Doubles& axis,
                       const std::vector<Index>& dof,
                       const Doubles& multiplier,
                       const Doubles& constant,
                       Index joint_count) {
  const std::size_t count = parent.size();
  const LinkArrays arrays{.tree = std::vector<Index>(count, 0),
                          .parent = parent,
                          .kind = kind,
                          .offset = to_vector(offset),
                          .axis = to_vector(axis),
                          .coordinate = dof,
                          .multiplier = to_vector(multiplier),
                          .constant = to_vector(constant)};
  bodies::Tree tree{
      .links = to_links(arrays, joint_count), .order = order, .joint_count = joint_count};
  constexpr const char* kOrder =
      "dynamics: `order` must hold every link once, parents before their children";
  require(count > 0 && order.size() == count, kOrder);
  std::vector<char> placed(count, 0);
  for (const Index l : order) {
    require(l >= 0 && std::cmp_less(l, count) && placed[l] == 0, kOrder);
    require(parent[l] < 0 || (std::cmp_less(parent[l], count) && placed[parent[l]] != 0), kOrder);
    placed[l] = 1;
  }
  return tree;
}

using Functions = std::pair<std::unique_ptr<SmoothFunction>, std::unique_ptr<SmoothFunction>>;

nb::object robot_functions(const bodies::Tree& tree,
                           Index base,
                           const std::vector<Index>& actuation,
                           const std::vector<Index>& vertex_link,
                           const Doubles& points,
                           double dt,
                           double largest,
                           bool is_at_rest,
                           bool bounds_weight) {
  bodies::RobotModel model{.tree = tree,
                           .base = at(kBases, base, "dynamics: `base` is out of range"),
                           .actuation = {},
                           .vertex_link = vertex_link,
                           .points = to_vector(points),
                           .dt = dt,
                           .largest = largest,
                           .is_at_rest = is_at_rest,
                           .bounds_weight = bounds_weight};
  require(std::cmp_equal(actuation.size(), tree.joint_count),
          "dynamics: `actuation` must have one entry a joint");
  for (const Index mode : actuation) {
    model.actuation.push_back(at(kActuations, mode, "dynamics: `actuation` is out of range"));
  }
  require(model.points.size() == 3 * vertex_link.size(), "dynamics: `points` must be [V, 3]");
  for (const Index l : vertex_link) {
    require(l >= 0 && std::cmp_less(l, tree.links.size()),
            "dynamics: `vertex_link` is out of range");
  }
  return nb::make_tuple(bodies::robot_prediction(model), bodies::robot_advance(model));
}

nb::object body_functions(std::size_t count, double dt) {
  return nb::make_tuple(bodies::body_prediction(count, dt), bodies::body_advance(count, dt));
}

}  // namespace

void dynamics(nb::module_& m) {
  nb::class_<SmoothFunction>(m, "SmoothFunction")
      .def("values", &values, "inputs"_a, "threads"_a,
           "Outputs [B, ...] by their names, from inputs [B or 1, ...] by theirs.")
      .def("gradients", &gradients, "inputs"_a, "cotangents"_a, "losses"_a, "needs"_a, "threads"_a,
           "Gradients [losses, B or 1, size] by some inputs, from cotangents [losses, B, ...].")
      .def("tangents", &tangents, "inputs"_a, "directions"_a, "count"_a, "threads"_a,
           "Tangents [count, B, ...] of all outputs, from those of some inputs.");
  nb::dict kinds;
  for (const bodies::JointKind& kind : bodies::joint_kinds()) {
    kinds[std::string(kind.name).c_str()] = nb::make_tuple(kind.turn, kind.slide);
  }
  m.attr("joint_kinds") = kinds;
  nb::class_<bodies::Tree>(m, "Tree");
  m.def("tree", &make_tree, nb::kw_only(), "parent"_a, "order"_a, "kind"_a, "offset"_a, "axis"_a,
        "dof"_a, "multiplier"_a, "constant"_a, "joint_count"_a, "Links and joints of a mechanism.");
  m.def("link_frames", &bodies::link_frames, "tree"_a,
        "Frames [L, 4, 4] of links in their root's frame, and twists [L, 4, 4] of their joints.");
  m.def("robot_functions", &robot_functions, nb::kw_only(), "tree"_a, "base"_a, "actuation"_a,
        "vertex_link"_a, "points"_a, "dt"_a, "largest"_a, "is_at_rest"_a, "bounds_weight"_a,
        "A robot over a step: its prediction, and its state once the step is solved.");
  m.def("body_functions", &body_functions, "count"_a, "dt"_a, "The same of free bodies.");
}

}  // namespace diffcloth::bind
