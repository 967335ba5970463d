// Tangents of all environments and directions: layout of the rows, and of the outputs that each row
// writes.

#include <algorithm>
#include <array>
#include <cstddef>
#include <functional>
#include <span>
#include <string>
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

/// Tangents of inputs by name, [directions, environments or 1, count].
class TangentArrays {
 public:
  TangentArrays(const InputArrays& inputs, const nb::dict& tangents, std::size_t directions)
      : inputs_(inputs) {
    for (const auto [key, value] : tangents) {
      const auto name = nb::cast<std::string>(key);
      std::size_t input = 0;
      while (input < kInputCount && kInputTable[input].name != name) ++input;
      if (input == kInputCount || !inputs.present[input]) {
        throw nb::value_error(("tangent: `tangents` has an unknown input " + name).c_str());
      }
      const auto array = nb::cast<Doubles>(value);
      const std::size_t copies = array.ndim() < 2 ? 0 : array.shape(1);
      if (array.ndim() < 2 || array.shape(0) != directions ||
          (copies != 1 && copies != inputs.environments) ||
          array.size() != directions * copies * count_of(input)) {
        throw nb::value_error(("tangent: that of `" + name + "` must have " +
                               std::to_string(directions) + " directions, the rows of one " +
                               "environment or of all, and numbers like the input")
                                  .c_str());
      }
      given_.push_back({.input = input, .copies = copies, .array = array});
    }
  }

  /// Tangents of one environment along one direction; null if all are zero.
  step::Inputs row(std::size_t row) const {
    const std::size_t direction = row / inputs_.environments;
    const std::size_t e = row % inputs_.environments;
    step::Inputs result;
    for (const Given& given : given_) {
      const std::size_t count = count_of(given.input);
      const double* const data =
          given.array.data() + count * (direction * given.copies + (given.copies > 1 ? e : 0));
      if (std::all_of(data, data + count, [](double value) { return value == 0.0; })) continue;
      result.views[given.input] = {.data = data, .count = count};
    }
    return result;
  }

  bool is_zero(std::size_t row_index) const {
    return std::ranges::all_of(row(row_index).views,
                               [](const step::View& view) { return view.data == nullptr; });
  }

 private:
  struct Given {
    std::size_t input, copies;
    Doubles array;
  };

  /// Number of values of an input in one environment.
  std::size_t count_of(std::size_t input) const {
    return inputs_.environment(0).views[input].count;
  }

  const InputArrays& inputs_;
  std::vector<Given> given_;
};

/// Push directions of an environment forward, with this number of threads.
using PushForward = std::function<void(
    std::size_t environment, std::span<const step::Direction>, int threads, const Checkpoint&)>;

/// Tangents of the outputs [directions, environments, ...] along all directions. Tangents of an
/// environment whose inputs do not change are zero: its step may even have failed.
///
/// @param costs  expected cost of one direction in each environment
/// @param turns  out: order and time of the portions of directions
nb::dict push_forward_all(const InputArrays& arrays,
                          const std::vector<step::Field>& fields,
                          const nb::dict& tangents,
                          std::size_t directions,
                          int threads,
                          const std::vector<double>& costs,
                          std::vector<Turn>& turns,
                          const PushForward& push_forward) {
  const TangentArrays given(arrays, tangents, directions);
  nb::dict out;
  const Outputs outputs(fields, {directions, arrays.environments}, "", out);
  const std::vector<Portion> portions = make_portions(
      arrays.environments, directions, [&](std::size_t row) { return given.is_zero(row); });
  const std::vector<double> expected = expected_costs(portions, costs);
  turns = for_environments(
      portions.size(), threads, expected, [&](Index i, const Checkpoint& checkpoint) {
        const auto& [e, rows] = portions[static_cast<std::size_t>(i)];
        std::vector<step::Direction> of_rows;
        of_rows.reserve(rows.size());
        for (const std::size_t row : rows) {
          of_rows.push_back({.tangents = given.row(row), .outputs = outputs.environment(row)});
        }
        push_forward(e, of_rows, threads_each(portions.size(), threads), checkpoint);
      });
  return out;
}

}  // namespace

nb::dict Simulator::tangent(const nb::dict& inputs,
                            const nb::dict& tape,
                            const KeptSteps& kept,
                            const nb::dict& tangents,
                            std::size_t directions,
                            int threads) {
  const InputArrays arrays(scene_, inputs, true);
  const Saved tapes = taken_steps(arrays.environments, tape, kept);
  return push_forward_all(arrays, outputs_, tangents, directions, threads, kept.costs, last_turns_,
                          [&](std::size_t e, std::span<const step::Direction> of_environment,
                              int each, const Checkpoint& checkpoint) {
                            step::tangent(scene_, arrays.environment(e), tapes.environment(e),
                                          *kept.tickets[e]->find(), of_environment, each,
                                          checkpoint);
                          });
}

nb::dict Simulator::energy_tangent(const nb::dict& inputs,
                                   const nb::dict& tangents,
                                   std::size_t directions,
                                   int threads) const {
  const InputArrays arrays(scene_, inputs, true);
  std::vector<step::Field> parts;
  for (const auto& [name, value] : step::stored_energy(scene_, arrays.environment(0))) {
    parts.push_back({.name = name, .shape = {}});
  }
  const std::vector<double> alike(arrays.environments, 1.0);
  std::vector<Turn> turns;
  return push_forward_all(
      arrays, parts, tangents, directions, threads, alike, turns,
      [&](std::size_t e, std::span<const step::Direction> of_environment, int, const Checkpoint&) {
        step::push_forward_energy(scene_, arrays.environment(e), of_environment);
      });
}

}  // namespace diffcloth::bind
