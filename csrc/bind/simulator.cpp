#include "bind/simulator.h"

#include <algorithm>
#include <map>

#include <nanobind/stl/string.h>

#include "bind/environments.h"
#include "bind/field_arrays.h"
#include "bind/input_arrays.h"
#include "bind/reports.h"
#include "bind/without_gil.h"
#include "contact/nonadjacent_distance.h"

namespace diffcloth::bind {

nb::dict Simulator::forward(const nb::dict& inputs, bool tape, int threads) {
  const InputArrays arrays(scene_, inputs);
  const std::size_t b = arrays.environments;
  nb::dict out;
  const Outputs outputs(outputs_, {b}, "", out);
  const Outputs tapes(tape ? tape_ : std::vector<step::Field>(), {b}, "tape_", out);
  std::vector<step::Report> reports(b);
  KeptSteps kept{.tickets = decltype(KeptSteps::tickets)(b), .costs = std::vector<double>(b)};
  const std::vector<double> expected = step_seconds_;  // another call may write meanwhile
  last_turns_ = for_environments(b, threads, expected, [&](Index i, const Checkpoint& checkpoint) {
    const auto e = static_cast<std::size_t>(i);
    solver::KeptSolves found;
    reports[e] = step::forward(scene_, arrays.environment(e), checkpoint, outputs.environment(e),
                               tapes.environment(e), found, threads_each(b, threads), nullptr);
    if (tape) kept.tickets[e] = factors_.insert(std::move(found));
    kept.costs[e] = scene_.vertex_count() + reports[e].contact_count;
  });
  step_seconds_.resize(b);
  std::ranges::transform(last_turns_, step_seconds_.begin(), &Turn::seconds);
  if (tape) out["kept"] = nb::cast(std::move(kept));
  out["numbers"] = to_lists(reports);
  nb::list messages;
  for (const step::Report& report : reports) messages.append(report.message);
  out["message"] = messages;
  out["ended"] = ended_poses(reports);
  out["pairs"] = pair_contacts(reports);
  out["points"] = contact_points(reports);
  return out;
}

nb::object Simulator::path(const nb::dict& inputs) {
  const InputArrays arrays(scene_, inputs);
  nb::dict unused;
  const Outputs outputs(outputs_, {1}, "", unused);
  std::vector<std::vector<double>> path;
  for_environments(1, 1, {}, [&](Index, const Checkpoint& checkpoint) {
    solver::KeptSolves kept;
    step::forward(scene_, arrays.environment(0), checkpoint, outputs.environment(0), {}, kept, 1,
                  &path);
  });
  const auto all = static_cast<std::size_t>(scene_.vertex_count());
  Owned<double> result = make_array<double>({path.size(), all, 3});
  for (std::size_t k = 0; k < path.size(); ++k) {
    // Leave out the coordinates of mechanisms, which follow the vertices.
    std::copy_n(path[k].begin(), 3 * all, result.data + 3 * all * k);
  }
  return result.array;
}

nb::dict Simulator::stored_energy(const nb::dict& inputs) const {
  const InputArrays arrays(scene_, inputs);
  nb::dict result;
  std::map<std::string, double*> parts;
  for (std::size_t e = 0; e < arrays.environments; ++e) {
    for (const auto& [name, value] : step::stored_energy(scene_, arrays.environment(e))) {
      if (!parts.contains(name)) {
        Owned<double> part = make_array<double>({arrays.environments});
        parts[name] = part.data;
        result[name] = part.array;
      }
      parts[name][e] = value;
    }
  }
  return result;
}

double Simulator::smallest_nonadjacent_distance() const {
  // Positions of bodies do not matter: only cloths are measured.
  std::vector<double> x = scene_.given.rest_embedding;
  x.resize(3 * static_cast<std::size_t>(scene_.vertex_count()), 0.0);
  return contact::smallest_nonadjacent_distance(scene_.collision_mesh, x.data());
}

nb::object Simulator::default_barrier_stiffness(const nb::dict& inputs,
                                                double barrier_distance) const {
  const InputArrays arrays(scene_, inputs);
  if (!arrays.has(step::Input::kThickness)) {
    throw nb::value_error("core: `thickness` is missing");
  }
  const auto surfaces = static_cast<std::size_t>(scene_.surface_count());
  const Owned<double> owned = make_array<double>({surfaces, surfaces});
  std::ranges::copy(
      step::default_barrier_stiffness(scene_, arrays.environment(0), barrier_distance), owned.data);
  return owned.array;
}

nb::object Simulator::find_overlap(const nb::dict& inputs) const {
  const InputArrays arrays(scene_, inputs);
  const std::string text = step::find_overlap(scene_, arrays.environment(0));
  return text.empty() ? nb::none() : nb::cast(text);
}

nb::list Simulator::find_throws(const nb::dict& inputs, int threads) const {
  const InputArrays arrays(scene_, inputs);
  std::vector<std::optional<step::Throw>> found(arrays.environments);
  for_environments(found.size(), threads, {}, [&](Index i, const Checkpoint&) {
    const auto e = static_cast<std::size_t>(i);
    found[e] = step::find_throw(scene_, arrays.environment(e));
  });
  nb::list result;
  for (const auto& one : found) {
    if (one) {
      result.append(nb::make_tuple(one->elements, one->gap, one->barrier_distance, one->speed));
    } else {
      result.append(nb::none());
    }
  }
  return result;
}

double Simulator::reference_factorization_seconds(const nb::dict& inputs, int repeats) const {
  const InputArrays arrays(scene_, inputs);
  if (repeats < 1) throw nb::value_error("core: `repeats` must be at least 1");
  const WithoutGil nogil;
  return step::reference_factorization_seconds(scene_, arrays.environment(0), repeats);
}

}  // namespace diffcloth::bind
