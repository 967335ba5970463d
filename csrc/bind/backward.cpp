// Backward of all environments and losses: layout of the rows, and of the gradients that each row
// writes.

#include <algorithm>
#include <cstddef>
#include <functional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include <nanobind/stl/string.h>

#include "bind/environments.h"
#include "bind/field_arrays.h"
#include "bind/input_arrays.h"
#include "bind/portions.h"
#include "bind/simulator.h"

namespace diffcloth::bind {
namespace {

using step::kInputCount;
using step::kInputTable;

/// Gradient of an input, [losses, environments or 1, count]. Each environment of a loss writes into its
/// own copy; copies of inputs that environments share are then summed in index order.
struct Wanted {
  std::size_t input, count, copies;
  double* out;
  std::vector<double> own;  ///< separate copies; empty if the input is not shared

  double* at(std::size_t row) { return (own.empty() ? out : own.data()) + row * count; }

  void sum(std::size_t environments) const {
    for (std::size_t row = 0; row < own.size() / std::max<std::size_t>(count, 1); ++row) {
      double* target = out + row / environments * count;
      for (std::size_t a = 0; a < count; ++a) target[a] += own[row * count + a];
    }
  }
};

/// Create zero gradients of the named inputs, and add them to `out`.
std::vector<Wanted> make_gradients(const InputArrays& arrays,
                                   std::size_t losses,
                                   const std::vector<std::string>& needs,
                                   nb::dict& out) {
  std::vector<Wanted> wanted;
  for (const std::string& name : needs) {
    std::size_t input = 0;
    while (input < kInputCount && kInputTable[input].name != name) ++input;
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
    const std::size_t b = arrays.environments;
    wanted.push_back({.input = input,
                      .count = count,
                      .copies = copies,
                      .out = owned.data,
                      .own = std::vector<double>(copies < b ? losses * b * count : 0, 0.0)});
  }
  return wanted;
}

/// Pull the losses of an environment back, with this number of threads.
using PullBack = std::function<void(
    std::size_t environment, std::span<const step::Loss>, int threads, const Checkpoint&)>;

/// Gradients of the needed inputs, from cotangents of all losses and environments.
///
/// @param costs  expected cost of one loss in each environment
/// @param turns  out: order and time of the portions of losses
nb::dict pull_back_all(const InputArrays& arrays,
                       const Saved& bars,
                       std::size_t losses,
                       const std::vector<std::string>& needs,
                       int threads,
                       const std::vector<double>& costs,
                       std::vector<Turn>& turns,
                       const PullBack& pull_back) {
  nb::dict out;
  std::vector<Wanted> wanted = make_gradients(arrays, losses, needs, out);
  // Skip losses that do not depend on an environment: its step may even have failed.
  const std::vector<Portion> portions = make_portions(
      arrays.environments, losses, [&](std::size_t row) { return bars.is_zero(row); });
  const std::vector<double> expected = expected_costs(portions, costs);
  turns = for_environments(
      portions.size(), threads, expected, [&](Index i, const Checkpoint& checkpoint) {
        const auto& [e, rows] = portions[static_cast<std::size_t>(i)];
        std::vector<step::Loss> of_rows;
        for (const std::size_t row : rows) {
          of_rows.push_back({.cotangents = bars.environment(row), .gradients = {}});
          step::Gradients& gradients = of_rows.back().gradients;
          for (Wanted& w : wanted) gradients.data[w.input] = w.at(row);
        }
        pull_back(e, of_rows, threads_each(portions.size(), threads), checkpoint);
      });
  for (const Wanted& w : wanted) w.sum(arrays.environments);
  return out;
}

}  // namespace

Saved Simulator::taken_steps(std::size_t environments,
                             const nb::dict& tape,
                             const KeptSteps& kept) const {
  Saved tapes(tape_, environments, "tape_", tape);
  if (!tapes.is_finite()) throw nb::value_error("core: the tape must be finite");
  if (kept.tickets.size() != environments) {
    throw nb::value_error("core: `kept` must be of as many environments as the inputs");
  }
  return tapes;
}

nb::dict Simulator::backward(const nb::dict& inputs,
                             const nb::dict& tape,
                             const KeptSteps& kept,
                             const nb::dict& cotangents,
                             std::size_t losses,
                             const std::vector<std::string>& needs,
                             int threads) {
  const InputArrays arrays(scene_, inputs, true);
  const std::size_t b = arrays.environments;
  const Saved tapes = taken_steps(b, tape, kept);
  const Saved bars(outputs_, losses * b, "", cotangents);
  return pull_back_all(
      arrays, bars, losses, needs, threads, kept.costs, last_turns_,
      [&](std::size_t e, std::span<const step::Loss> of_losses, int each, const Checkpoint& check) {
        step::backward(scene_, arrays.environment(e), tapes.environment(e),
                       *kept.tickets[e]->find(), of_losses, each, check);
      });
}

nb::dict Simulator::energy_backward(const nb::dict& inputs,
                                    const nb::dict& cotangents,
                                    std::size_t losses,
                                    const std::vector<std::string>& needs,
                                    int threads) const {
  const InputArrays arrays(scene_, inputs, true);
  std::vector<step::Field> parts;
  for (const nb::handle name : cotangents.keys()) {
    parts.push_back({.name = nb::cast<std::string>(name), .shape = {}});
  }
  const Saved bars(parts, losses * arrays.environments, "", cotangents);
  const std::vector<double> alike(arrays.environments, 1.0);
  std::vector<Turn> turns;
  return pull_back_all(
      arrays, bars, losses, needs, threads, alike, turns,
      [&](std::size_t e, std::span<const step::Loss> of_losses, int, const Checkpoint&) {
        step::pull_back_energy(scene_, arrays.environment(e), of_losses);
      });
}

}  // namespace diffcloth::bind
