#pragma once

#include <array>
#include <cstddef>

#include "bind/arrays.h"
#include "step/inputs.h"
#include "step/scene.h"

namespace diffcloth::bind {

/// Input arrays of a call, and views of one environment.
struct InputArrays {
  std::array<Doubles, step::kInputCount> array;
  std::array<bool, step::kInputCount> present{};
  std::size_t environments = 1;

  /// @param finite  if true, also check that numbers are finite: saved tensors may have been changed in
  /// Python
  InputArrays(const step::Scene& scene, const nb::dict& inputs, bool finite = false);

  bool has(step::Input input) const { return present[static_cast<std::size_t>(input)]; }

  step::Inputs environment(std::size_t b) const;
};

}  // namespace diffcloth::bind
