#include "bind/input_arrays.h"

#include <string>

#include "bind/checks.h"
#include "bind/numbers.h"

namespace diffcloth::bind {
namespace {

using step::Input;
using step::kInputCount;
using step::kInputTable;

[[noreturn]] void refuse(std::size_t k, const char* accepted) {
  throw nb::value_error((std::string("core: `") + kInputTable[k].name + "` " + accepted).c_str());
}

}  // namespace

InputArrays::InputArrays(const step::Scene& scene, const nb::dict& inputs, bool finite) {
  for (std::size_t k = 0; k < kInputCount; ++k) {
    const nb::str name(kInputTable[k].name);
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

step::Inputs InputArrays::environment(std::size_t b) const {
  step::Inputs inputs;
  for (std::size_t k = 0; k < kInputCount; ++k) {
    if (!present[k]) continue;
    const std::size_t copies = array[k].shape(0);
    const std::size_t count = copies == 0 ? 0 : array[k].size() / copies;
    inputs.views[k] = {.data = array[k].data() + (copies > 1 ? b * count : 0), .count = count};
  }
  return inputs;
}

}  // namespace diffcloth::bind
