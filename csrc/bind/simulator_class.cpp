// Python interface of a simulator.

#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <nanobind/nanobind.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "bind/bind.h"
#include "bind/description.h"
#include "bind/numbers.h"
#include "bind/reports.h"
#include "bind/simulator.h"
#include "solver/stopping.h"
#include "step/scene.h"

namespace diffcloth::bind {

using namespace nb::literals;  // NOLINT: the literal suffix of nanobind

namespace {

/// Names of the rows of a table.
template <class Table>
std::vector<std::string> names_of(const Table& table) {
  std::vector<std::string> names;
  for (const auto& row : table) names.emplace_back(row.name);
  return names;
}

/// Capabilities of each scheme, by its name.
nb::dict abilities_of_schemes() {
  nb::dict result;
  for (const step::SchemeRow& scheme : step::kSchemes) {
    nb::dict abilities;
    abilities["barrier"] = scheme.has_barrier;
    abilities["moves_bodies"] = scheme.moves_bodies;
    abilities["elastic_stage"] = scheme.has_elastic_stage;
    abilities["metrics"] = scheme.has_metrics;
    result[scheme.name] = abilities;
  }
  return result;
}

std::vector<std::pair<int, double>> places_and_seconds(const Simulator& simulator) {
  std::vector<std::pair<int, double>> result;
  for (const auto& [place, seconds] : simulator.last_turns()) result.emplace_back(place, seconds);
  return result;
}

}  // namespace

void simulator(nb::module_& m) {
  static nb::object simulation_error =
      nb::exception<std::domain_error>(m, "SimulationError", PyExc_RuntimeError);

  nb::class_<KeptSteps>(m, "Kept");
  nb::class_<Simulator>(m, "Simulator")
      .def("__init__",
           [](Simulator* self, nb::kwargs fields) {
             new (self) Simulator(describe(NamedFields(std::move(fields))));
           })
      .def("forward", &Simulator::forward, "inputs"_a, "tape"_a, "threads"_a)
      .def("backward", &Simulator::backward, "inputs"_a, "tape"_a, "kept"_a, "cotangents"_a,
           "losses"_a, "needs"_a, "threads"_a,
           "Gradients [losses, ...] of the inputs that are needed, from cotangents [losses, ...].")
      .def("tangent", &Simulator::tangent, "inputs"_a, "tape"_a, "kept"_a, "tangents"_a,
           "directions"_a, "threads"_a,
           "Tangents [directions, environments, ...] of all outputs, from those of inputs "
           "[directions, environments or 1, ...]; what is left out does not change.")
      .def("stored_energy", &Simulator::stored_energy, "inputs"_a)
      .def("energy_backward", &Simulator::energy_backward, "inputs"_a, "cotangents"_a, "losses"_a,
           "needs"_a, "threads"_a,
           "Gradients [losses, ...] of the inputs that are needed, from cotangents [losses, "
           "environments] of the parts of stored_energy().")
      .def("energy_tangent", &Simulator::energy_tangent, "inputs"_a, "tangents"_a, "directions"_a,
           "threads"_a,
           "Tangents [directions, environments] of the parts of stored_energy(), from those of "
           "inputs "
           "[directions, environments or 1, ...].")
      .def("path", &Simulator::path, "inputs"_a,
           "Accepted iterates of the first environment's step [M, N + V, 3].")
      .def("smallest_nonadjacent_distance", &Simulator::smallest_nonadjacent_distance)
      .def("default_barrier_stiffness", &Simulator::default_barrier_stiffness, "inputs"_a,
           "barrier_distance"_a, "Barrier stiffness of each pair of surfaces [S, S].")
      .def("reference_factorization_seconds", &Simulator::reference_factorization_seconds,
           "inputs"_a, "repeats"_a,
           "Seconds of one factorization of the contact-free Hessian by Eigen, for benchmarks.")
      .def("find_overlap", &Simulator::find_overlap, "inputs"_a,
           "Where surfaces overlap at the start of the first environment's step, or None.")
      .def("find_throws", &Simulator::find_throws, "inputs"_a, "threads"_a,
           "Of each environment, the surfaces that the barrier throws apart fastest from the start "
           "of a step: their nearest elements, the gap and the barrier distance [m], and the speed "
           "[m/s]; or None.")
      .def("forget_factors", &Simulator::forget_factors,
           "Drop the factors kept for backward; they are made again when needed.")
      .def_prop_ro("factor_bytes", &Simulator::factor_bytes,
                   "What the factors kept for backward take up; at most `largest_factor_bytes`.")
      .def_prop_ro("last_turns", &places_and_seconds,
                   "For each environment of the last step, or portion of the last derivative, how "
                   "many began before it, and the seconds that it took.")
      .def_prop_ro_static("largest_factor_bytes",
                          [](nb::handle) { return solver::FactorCache::kBytes; });
  m.attr("input_names") = names_of(step::kInputTable);
  m.attr("criteria") =
      std::vector<std::string>(solver::kCriterionNames.begin(), solver::kCriterionNames.end());
  m.attr("schemes") = abilities_of_schemes();
  m.attr("integrators") = names_of(step::kIntegrators);
  m.attr("metrics") = names_of(step::kMetrics);
  m.attr("elastic_solvers") = names_of(step::kElasticSolvers);
  m.def("are_within", &are_within, "arrays"_a, "largest"_a,
        "Whether all numbers are at most `largest` in size; NaN is not.");
  m.def("have_quaternions", &have_quaternions, "poses"_a, "shortest"_a,
        "Whether all poses [.., 7] have quaternions longer than `shortest`.");
  m.attr("number_names") = number_names();
}

}  // namespace diffcloth::bind
