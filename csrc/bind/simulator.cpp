#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "bind/arrays.h"
#include "bind/bind.h"
#include "bind/checks.h"
#include "bind/environments.h"
#include "bind/links.h"
#include "contact/nonadjacent_distance.h"
#include "step/scheme.h"
#include "step/step.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;  // NOLINT: the literal suffix of nanobind
using step::Input;
using step::kInputCount;

std::vector<std::array<Index, 3>> to_faces(const Indices& array) {
  if (array.size() % 3 != 0) throw nb::value_error("core: faces must have three vertices each");
  std::vector<std::array<Index, 3>> faces(array.size() / 3);
  std::copy_n(array.data(), array.size(), faces.empty() ? nullptr : faces.front().data());
  return faces;
}

/// Whether all numbers are at most `largest` in size; no NaN is.
bool is_within(const Doubles& array, double largest) {
  std::int64_t beyond = 0;  // no branch, so that the compiler takes several numbers at once
  for (std::size_t i = 0; i < array.size(); ++i) {
    beyond |= static_cast<std::int64_t>(!(std::abs(array.data()[i]) <= largest));
  }
  return beyond == 0;
}

bool are_within(const std::vector<Doubles>& arrays, double largest) {
  return std::ranges::all_of(arrays,
                             [&](const Doubles& array) { return is_within(array, largest); });
}

bool is_finite(const Doubles& array) {
  return is_within(array, std::numeric_limits<double>::max());
}

/// Whether all poses [.., 7] have quaternions longer than this.
bool have_quaternions(const Doubles& poses, double shortest) {
  for (std::size_t k = 0; k + 7 <= poses.size(); k += 7) {
    const double* const q = poses.data() + k + 3;
    if (!(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] > shortest * shortest))
      return false;
  }
  return true;
}

/// The arrays of a call, and what one environment sees of them.
struct Arrays {
  std::array<Doubles, kInputCount> array;
  std::array<bool, kInputCount> present{};
  std::size_t environments = 1;

  /// @param finite  whether numbers are checked too: what came back from Python may be anything
  Arrays(const step::Scene& scene, const nb::dict& inputs, bool finite = false) {
    for (std::size_t k = 0; k < kInputCount; ++k) {
      const nb::str name(step::kInputNames[k]);
      if (!inputs.contains(name)) continue;
      array[k] = nb::cast<Doubles>(inputs[name]);
      present[k] = true;
    }
    constexpr auto kPositions = static_cast<std::size_t>(Input::kPositions);
    if (!present[kPositions] || array[kPositions].ndim() == 0 || array[kPositions].shape(0) == 0) {
      throw nb::value_error("core: `positions` must hold one environment or more");
    }
    environments = array[kPositions].shape(0);
    for (std::size_t k = 0; k < kInputCount; ++k) {
      if (!present[k]) continue;
      if (array[k].ndim() == 0 || (array[k].shape(0) != 1 && array[k].shape(0) != environments)) {
        refuse(k, "must have the rows of one environment or of all");
      }
      if (finite && !is_finite(array[k])) refuse(k, "must be finite");
    }
    check_inputs(scene, environment(0));
  }

  step::Inputs environment(std::size_t b) const {
    step::Inputs inputs;
    for (std::size_t k = 0; k < kInputCount; ++k) {
      if (!present[k]) continue;
      const std::size_t copies = array[k].shape(0);
      const std::size_t count = copies == 0 ? 0 : array[k].size() / copies;
      inputs.views[k] = {.data = array[k].data() + (copies > 1 ? b * count : 0), .count = count};
    }
    return inputs;
  }

 private:
  [[noreturn]] static void refuse(std::size_t k, const char* accepted) {
    throw nb::value_error(
        (std::string("core: `") + step::kInputNames[k] + "` " + accepted).c_str());
  }
};

/// What a step with a tape keeps for its backward, environment by environment: given up with the tape.
struct KeptSteps {
  std::vector<std::shared_ptr<step::FactorCache::Ticket>> tickets;
};

/// Call visit(name, value) for every number of a report, seconds of the phases included.
template <class Visit>
void for_each_number(const step::Report& report, Visit&& visit) {
  report.for_each(visit);
  for (std::size_t k = 0; k < kPhaseCount; ++k) visit(kPhaseNames[k], report.seconds[k]);
}

/// What for_each_number() visits, a phase with a prefix.
std::vector<std::string> number_names() {
  std::vector<std::string> names;
  step::Report().for_each([&](const char* name, auto /*value*/) { names.emplace_back(name); });
  for (const char* const phase : kPhaseNames) names.push_back(std::string("seconds_") + phase);
  return names;
}

/// The numbers of all environments' reports, a list of each: cheaper than arrays of one number.
nb::list to_lists(const std::vector<step::Report>& reports) {
  std::vector<nb::list> columns;
  for (const step::Report& report : reports) {
    std::size_t k = 0;
    for_each_number(report, [&](const char* /*name*/, auto value) {
      if (k == columns.size()) columns.emplace_back();
      columns[k++].append(value);
    });
  }
  nb::list lists;
  for (const nb::list& column : columns) lists.append(column);
  return lists;
}

class Simulator {
 public:
  explicit Simulator(step::Description description)
      : scene_(std::move(description)),
        outputs_(step::output_fields(scene_)),
        tape_(step::tape_fields(scene_)) {}

  nb::dict forward(const nb::dict& inputs, bool tape, int threads);
  nb::dict backward(const nb::dict& inputs,
                    const nb::dict& tape,
                    const KeptSteps& kept,
                    const nb::dict& cotangents,
                    std::size_t losses,
                    const std::vector<std::string>& needs,
                    int threads);
  nb::dict stored_energy(const nb::dict& inputs) const;
  nb::object path(const nb::dict& inputs);
  double smallest_nonadjacent_distance() const;
  double default_barrier_stiffness(const nb::dict& inputs, double barrier_distance) const {
    const Arrays arrays(scene_, inputs);
    if (!arrays.present[static_cast<std::size_t>(Input::kThickness)]) {
      throw nb::value_error("core: `thickness` is missing");
    }
    return step::default_barrier_stiffness(scene_, arrays.environment(0), barrier_distance);
  }
  nb::object find_overlap(const nb::dict& inputs) const;
  nb::object find_close_start(const nb::dict& inputs) const;
  double reference_factorization_seconds(const nb::dict& inputs, int repeats) const {
    const Arrays arrays(scene_, inputs);
    if (repeats < 1) throw nb::value_error("core: `repeats` must be at least 1");
    const nb::gil_scoped_release nogil;
    return step::reference_factorization_seconds(scene_, arrays.environment(0), repeats);
  }
  void forget_factors() { factors_.clear(); }
  std::size_t factor_bytes() const { return factors_.bytes(); }

 private:
  step::Scene scene_;
  std::vector<step::Field> outputs_;
  std::vector<step::Field> tape_;
  step::FactorCache factors_;
};

/// Arrays of all environments by name, and what one environment sees of them.
class Outputs {
 public:
  /// Zeroed arrays [environments, ...] for these fields, put into `out` under prefix + name.
  Outputs(const std::vector<step::Field>& fields,
          std::size_t environments,
          const std::string& prefix,
          nb::dict& out) {
    for (const step::Field& field : fields) {
      std::vector<std::size_t> shape{environments};
      shape.insert(shape.end(), field.shape.begin(), field.shape.end());
      Owned<double> owned = make_array<double>(shape);
      out[(prefix + field.name).c_str()] = owned.array;
      entries_.push_back({.name = field.name, .data = owned.data, .size = field.size()});
    }
  }

  step::Arrays<double> environment(std::size_t e) const {
    step::Arrays<double> arrays;
    for (const Entry& entry : entries_) arrays.set(entry.name, entry.data + e * entry.size);
    return arrays;
  }

 private:
  struct Entry {
    std::string name;
    double* data;
    std::size_t size;
  };
  std::vector<Entry> entries_;
};

/// Arrays that came back from Python under prefix + name; their shapes are checked, as hooks on saved
/// tensors may return anything.
class Saved {
 public:
  Saved(const std::vector<step::Field>& fields,
        std::size_t environments,
        const std::string& prefix,
        const nb::dict& from) {
    for (const step::Field& field : fields) {
      const std::string name = prefix + field.name;
      auto array = nb::cast<Doubles>(from[name.c_str()]);
      if (array.size() != environments * field.size()) {
        throw nb::value_error(("core: `" + name + "` must have " +
                               std::to_string(environments * field.size()) + " numbers, got " +
                               std::to_string(array.size()))
                                  .c_str());
      }
      entries_.push_back({.name = field.name, .array = array, .size = field.size()});
    }
  }

  bool is_finite() const {
    return std::ranges::all_of(entries_,
                               [](const Entry& entry) { return bind::is_finite(entry.array); });
  }

  /// Whether an environment's arrays are zero throughout.
  bool is_zero(std::size_t e) const {
    return std::ranges::all_of(entries_, [&](const Entry& entry) {
      const double* const first = entry.array.data() + e * entry.size;
      return std::all_of(first, first + entry.size, [](double value) { return value == 0.0; });
    });
  }

  step::Arrays<const double> environment(std::size_t e) const {
    step::Arrays<const double> arrays;
    for (const Entry& entry : entries_) arrays.set(entry.name, entry.array.data() + e * entry.size);
    return arrays;
  }

 private:
  struct Entry {
    std::string name;
    Doubles array;
    std::size_t size;
  };
  std::vector<Entry> entries_;
};

nb::dict Simulator::forward(const nb::dict& inputs, bool tape, int threads) {
  const Arrays arrays(scene_, inputs);
  const std::size_t b = arrays.environments;
  nb::dict out;
  const Outputs outputs(outputs_, b, "", out);
  const Outputs tapes(tape ? tape_ : std::vector<step::Field>(), b, "tape_", out);
  std::vector<step::Report> reports(b);
  KeptSteps kept{.tickets = decltype(KeptSteps::tickets)(b)};
  for_environments(b, threads, [&](Index i, const Checkpoint& checkpoint) {
    const auto e = static_cast<std::size_t>(i);
    step::Kept found;
    reports[e] = step::forward(scene_, arrays.environment(e), checkpoint, outputs.environment(e),
                               tapes.environment(e), found, threads_each(b, threads), nullptr);
    if (tape) kept.tickets[e] = factors_.insert(std::move(found));
  });
  if (tape) out["kept"] = nb::cast(std::move(kept));
  out["numbers"] = to_lists(reports);
  nb::list messages;
  for (const step::Report& report : reports) messages.append(report.message);
  out["message"] = messages;
  return out;
}

nb::dict Simulator::backward(const nb::dict& inputs,
                             const nb::dict& tape,
                             const KeptSteps& kept,
                             const nb::dict& cotangents,
                             std::size_t losses,
                             const std::vector<std::string>& needs,
                             int threads) {
  const Arrays arrays(scene_, inputs, true);
  const std::size_t b = arrays.environments;
  const Saved tapes(tape_, b, "tape_", tape);
  if (!tapes.is_finite()) throw nb::value_error("core: the tape must be finite");
  if (kept.tickets.size() != b) {
    throw nb::value_error("core: `kept` must be of as many environments as the inputs");
  }
  const Saved bars(outputs_, losses * b, "", cotangents);

  // [losses, environments or 1, count]. Each environment of a loss writes into its own copy; those of
  // inputs that environments share are then summed in index order.
  struct Wanted {
    std::size_t input, count, copies;
    double* out;
    std::vector<double> own;  // empty where nothing is shared
    double* at(std::size_t row) { return (own.empty() ? out : own.data()) + row * count; }
  };
  nb::dict out;
  std::vector<Wanted> wanted;
  for (const std::string& name : needs) {
    const auto* found = std::ranges::find(step::kInputNames, name);
    const auto input = static_cast<std::size_t>(found - step::kInputNames.begin());
    if (input == kInputCount || !arrays.present[input]) {
      throw nb::value_error(("backward: `needs` has an unknown input " + name).c_str());
    }
    const Doubles& array = arrays.array[input];
    std::vector<std::size_t> shape{losses};
    for (std::size_t d = 0; d < array.ndim(); ++d) shape.push_back(array.shape(d));
    Owned<double> owned = make_array<double>(shape);
    out[name.c_str()] = owned.array;
    const std::size_t copies = array.shape(0);
    const std::size_t count = array.size() / copies;
    wanted.push_back({.input = input,
                      .count = count,
                      .copies = copies,
                      .out = owned.data,
                      .own = std::vector<double>(copies < b ? losses * b * count : 0, 0.0)});
  }

  // A loss that does not depend on an environment has zeros there: that step may even have failed.
  struct Portion {
    std::size_t environment;
    std::vector<std::size_t> rows;  // loss * environments + environment
  };
  std::vector<Portion> portions;
  for (std::size_t e = 0; e < b; ++e) {
    std::vector<std::size_t> rows;
    for (std::size_t row = e; row < losses * b; row += b) {
      if (!bars.is_zero(row)) rows.push_back(row);
      if (rows.size() < step::kLossesAtOnce) continue;
      portions.push_back({.environment = e, .rows = std::move(rows)});
      rows.clear();
    }
    if (!rows.empty()) portions.push_back({.environment = e, .rows = std::move(rows)});
  }
  for_environments(portions.size(), threads, [&](Index i, const Checkpoint& checkpoint) {
    const auto& [e, rows] = portions[static_cast<std::size_t>(i)];
    std::vector<step::Loss> of_rows;
    for (const std::size_t row : rows) {
      of_rows.push_back({.cotangents = bars.environment(row), .gradients = {}});
      step::Gradients& gradients = of_rows.back().gradients;
      for (Wanted& w : wanted) gradients.data[w.input] = w.at(row);
    }
    step::backward(scene_, arrays.environment(e), tapes.environment(e), *kept.tickets[e]->find(),
                   of_rows, threads_each(portions.size(), threads), checkpoint);
  });
  for (const Wanted& w : wanted) {
    for (std::size_t row = 0; row < w.own.size() / std::max<std::size_t>(w.count, 1); ++row) {
      double* target = w.out + row / b * w.count;
      for (std::size_t a = 0; a < w.count; ++a) target[a] += w.own[row * w.count + a];
    }
  }
  return out;
}

nb::object Simulator::path(const nb::dict& inputs) {
  const Arrays arrays(scene_, inputs);
  nb::dict unused;
  const Outputs outputs(outputs_, 1, "", unused);
  std::vector<std::vector<double>> path;
  for_environments(1, 1, [&](Index, const Checkpoint& checkpoint) {
    step::Kept kept;
    step::forward(scene_, arrays.environment(0), checkpoint, outputs.environment(0), {}, kept, 1,
                  &path);
  });
  const auto all = static_cast<std::size_t>(scene_.vertex_count());
  Owned<double> result = make_array<double>({path.size(), all, 3});
  for (std::size_t k = 0; k < path.size(); ++k) {
    // Behind the vertices come the coordinates of mechanisms.
    std::copy_n(path[k].begin(), 3 * all, result.data + 3 * all * k);
  }
  return result.array;
}

nb::dict Simulator::stored_energy(const nb::dict& inputs) const {
  const Arrays arrays(scene_, inputs);
  nb::dict result;
  std::map<std::string, double*> parts;
  for (std::size_t e = 0; e < arrays.environments; ++e) {
    const step::StoredEnergy energy = step::stored_energy(scene_, arrays.environment(e));
    energy.for_each([&](const char* name, double value) {
      if (!parts.contains(name)) {
        Owned<double> part = make_array<double>({arrays.environments});
        parts[name] = part.data;
        result[name] = part.array;
      }
      parts[name][e] = value;
    });
  }
  return result;
}

double Simulator::smallest_nonadjacent_distance() const {
  // Bodies do not count; their place does not matter.
  std::vector<double> x = scene_.given.rest_vertices;
  x.resize(3 * static_cast<std::size_t>(scene_.vertex_count()), 0.0);
  return contact::smallest_nonadjacent_distance(scene_.collision_mesh, x.data());
}

nb::object Simulator::find_overlap(const nb::dict& inputs) const {
  const Arrays arrays(scene_, inputs);
  const std::string text = step::find_overlap(scene_, arrays.environment(0));
  return text.empty() ? nb::none() : nb::cast(text);
}

nb::object Simulator::find_close_start(const nb::dict& inputs) const {
  const Arrays arrays(scene_, inputs);
  const auto found = step::find_close_start(scene_, arrays.environment(0));
  if (!found) return nb::none();
  return nb::make_tuple(found->elements, found->gap, found->rest_gap);
}

step::Metric to_metric(const std::string& name) {
  if (name == "elastic") return step::Metric::kElastic;
  if (name == "mass") return step::Metric::kMass;
  if (name == "identity") return step::Metric::kIdentity;
  throw nb::value_error(
      ("metric must be one of 'elastic', 'mass', 'identity', got '" + name + "'").c_str());
}

step::ElasticSolver to_elastic_solver(const std::string& name) {
  if (name == "newton") return step::ElasticSolver::kNewton;
  if (name == "projective") return step::ElasticSolver::kProjective;
  throw nb::value_error(
      ("elastic must be one of 'newton', 'projective', got '" + name + "'").c_str());
}

step::Description describe(const Doubles& vertices,
                           const Doubles& rest_vertices,
                           const Indices& faces,
                           const Indices& cloth_vertex_start,
                           const Indices& cloth_face_start,
                           const std::vector<std::string>& bending_models,
                           const Indices& pins,
                           const Indices& soft_pins,
                           const Doubles& body_vertices,
                           const Indices& body_faces,
                           const Indices& body_vertex_start,
                           bool self_contact,
                           double dt,
                           const std::string& scheme,
                           const std::string& metric,
                           int friction_iterations,
                           double tolerance,
                           int max_iterations) {
  step::Description d;
  d.vertices = to_vector(vertices);
  d.rest_vertices = to_vector(rest_vertices);
  d.faces = to_faces(faces);
  d.cloth_vertex_start = to_vector(cloth_vertex_start);
  d.cloth_face_start = to_vector(cloth_face_start);
  for (const std::string& model : bending_models) {
    d.bending_models.push_back(model == "hinge" ? mesh::BendingModel::kHinge
                                                : mesh::BendingModel::kPatch);
  }
  d.pins = to_vector(pins);
  d.soft_pins = to_vector(soft_pins);
  d.bodies = {.vertices = to_vector(body_vertices),
              .vertex_start = to_vector(body_vertex_start),
              .pose = {}};
  d.body_faces = to_faces(body_faces);
  d.self_contact = self_contact;
  d.dt = dt;
  d.scheme = scheme;
  d.metric = to_metric(metric);
  d.friction_iterations = friction_iterations;
  d.options = {.tolerance = tolerance, .max_iterations = max_iterations};
  return d;
}

/// Trees of links, from the arrays that say what they are; see bodies::MechanismsDescription.
bodies::MechanismsDescription describe_mechanisms(const nb::kwargs& k, Index surfaces) {
  const auto doubles = [&](const char* name) { return to_vector(nb::cast<Doubles>(k[name])); };
  const auto indices = [&](const char* name) { return to_vector(nb::cast<Indices>(k[name])); };
  bodies::MechanismsDescription m;
  for (const Index free : indices("tree_free")) m.tree_free.push_back(free != 0 ? 1 : 0);
  for (const Index given : indices("coordinate_prescribed")) {
    m.prescribed.push_back(given != 0 ? 1 : 0);
  }
  m.lower = doubles("coordinate_lower");
  m.upper = doubles("coordinate_upper");
  m.limit_stiffness = doubles("limit_stiffness");
  m.limit_zone = nb::cast<double>(k["limit_zone"]);
  m.surface_link = indices("surface_link");
  m.links = to_links({.tree = indices("link_tree"),
                      .parent = indices("link_parent"),
                      .kind = indices("link_kind"),
                      .offset = doubles("link_offset"),
                      .axis = doubles("link_axis"),
                      .coordinate = indices("link_coordinate"),
                      .multiplier = doubles("link_multiplier"),
                      .constant = doubles("link_constant")},
                     static_cast<Index>(m.prescribed.size()));
  const std::size_t n = m.prescribed.size();
  for (const std::size_t size : {m.lower.size(), m.upper.size(), m.limit_stiffness.size()}) {
    if (size != n) throw nb::value_error("trees: arrays of coordinates must have equal lengths");
  }
  m.coordinate_tree.assign(n, -1);
  for (const bodies::Link& link : m.links) {
    if (link.coordinate >= 0) m.coordinate_tree[link.coordinate] = link.tree;
  }
  for (const Index l : m.surface_link) {
    if (l < 0 || l >= static_cast<Index>(m.links.size())) {
      throw nb::value_error("trees: `surface_link` must name links");
    }
  }
  // What no joint has is the six of a free root, tree after tree.
  std::size_t c = 0;
  for (std::size_t t = 0; t < m.tree_free.size(); ++t) {
    for (int i = 0; m.tree_free[t] != 0 && i < 6; ++i, ++c) {
      if (c >= n || m.coordinate_tree[c] != -1) {
        throw nb::value_error("trees: a free root must have six coordinates");
      }
      m.coordinate_tree[c] = static_cast<Index>(t);
    }
    while (c < n && m.coordinate_tree[c] == static_cast<Index>(t)) ++c;
  }
  if (c != n) throw nb::value_error("trees: coordinates must go tree after tree");
  check_mechanisms(m, surfaces);
  return m;
}

}  // namespace

void simulator(nb::module_& m) {
  static nb::object simulation_error =
      nb::exception<std::domain_error>(m, "SimulationError", PyExc_RuntimeError);

  nb::class_<KeptSteps>(m, "Kept");
  nb::class_<Simulator>(m, "Simulator")
      .def("__init__",
           [](Simulator* self, nb::kwargs k) {
             const auto doubles = [&](const char* name) { return nb::cast<Doubles>(k[name]); };
             const auto indices = [&](const char* name) { return nb::cast<Indices>(k[name]); };
             step::Description description = describe(
                 doubles("vertices"), doubles("rest_vertices"), indices("faces"),
                 indices("cloth_vertex_start"), indices("cloth_face_start"),
                 nb::cast<std::vector<std::string>>(k["bending_models"]), indices("pins"),
                 indices("soft_pins"), doubles("body_vertices"), indices("body_faces"),
                 indices("body_vertex_start"), nb::cast<bool>(k["self_contact"]),
                 nb::cast<double>(k["dt"]), nb::cast<std::string>(k["scheme"]),
                 nb::cast<std::string>(k["metric"]), nb::cast<int>(k["friction_iterations"]),
                 nb::cast<double>(k["tolerance"]), nb::cast<int>(k["max_iterations"]));
             description.elastic = to_elastic_solver(nb::cast<std::string>(k["elastic"]));
             if (k.contains("primitive_kinds")) {
               const auto sizes = doubles("primitive_sizes");
               const auto kinds = nb::cast<std::vector<std::string>>(k["primitive_kinds"]);
               if (sizes.size() != 3 * kinds.size()) {
                 throw nb::value_error("`primitive_sizes` must have three numbers a primitive");
               }
               for (const auto& kind : kinds) {
                 const auto i = static_cast<Index>(description.primitives.size());
                 description.primitives.push_back(
                     {.kind = projective::primitive_kind(kind), .size = row(sizes.data(), i)});
               }
             }
             if (k.contains("large_factor")) {  // only tests say it
               description.options.large_factor = nb::cast<std::size_t>(k["large_factor"]);
             }
             if (k.contains("link_names")) {
               description.link_names = nb::cast<std::vector<std::string>>(k["link_names"]);
             }
             if (k.contains("ignored_pairs")) {
               const std::vector<Index> pairs = to_vector(indices("ignored_pairs"));
               for (std::size_t p = 0; p + 1 < pairs.size(); p += 2) {
                 description.ignored_pairs.push_back({pairs[p], pairs[p + 1]});
               }
             }
             check_description(description);
             if (k.contains("tree_free")) {
               description.mechanisms = describe_mechanisms(k, description.bodies.count());
             }
             new (self) Simulator(std::move(description));
           })
      .def("forward", &Simulator::forward, "inputs"_a, "tape"_a, "threads"_a)
      .def("backward", &Simulator::backward, "inputs"_a, "tape"_a, "kept"_a, "cotangents"_a,
           "losses"_a, "needs"_a, "threads"_a,
           "Gradients [losses, ...] of the inputs that are needed, from cotangents [losses, ...].")
      .def("stored_energy", &Simulator::stored_energy, "inputs"_a)
      .def("path", &Simulator::path, "inputs"_a,
           "Accepted iterates of the first environment's step [M, N + V, 3].")
      .def("smallest_nonadjacent_distance", &Simulator::smallest_nonadjacent_distance)
      .def("default_barrier_stiffness", &Simulator::default_barrier_stiffness, "inputs"_a,
           "barrier_distance"_a)
      .def("reference_factorization_seconds", &Simulator::reference_factorization_seconds,
           "inputs"_a, "repeats"_a,
           "Seconds of one factorization of the contact-free Hessian by Eigen, for benchmarks.")
      .def("find_overlap", &Simulator::find_overlap, "inputs"_a,
           "Where surfaces overlap at the start of the first environment's step, or None.")
      .def("find_close_start", &Simulator::find_close_start, "inputs"_a,
           "Elements that are closest at the start of the first environment's step, their gap and "
           "the one at rest [m], or None.")
      .def("forget_factors", &Simulator::forget_factors,
           "Drop the factors kept for backward; they are made again when needed.")
      .def_prop_ro("factor_bytes", &Simulator::factor_bytes,
                   "What the factors kept for backward take up; at most `largest_factor_bytes`.")
      .def_prop_ro_static("largest_factor_bytes",
                          [](nb::handle) { return step::FactorCache::kBytes; });
  m.attr("input_names") =
      std::vector<std::string>(step::kInputNames.begin(), step::kInputNames.end());
  m.def("are_within", &are_within, "arrays"_a, "largest"_a,
        "Whether all numbers are at most `largest` in size; NaN is not.");
  m.def("have_quaternions", &have_quaternions, "poses"_a, "shortest"_a,
        "Whether all poses [.., 7] have quaternions longer than `shortest`.");
  m.attr("number_names") = number_names();
}

}  // namespace diffcloth::bind
