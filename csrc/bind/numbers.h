#pragma once

#include <vector>

#include "bind/arrays.h"

namespace diffcloth::bind {

/// True if all magnitudes are at most `largest`; false for NaN.
bool is_within(const Doubles& array, double largest);
bool are_within(const std::vector<Doubles>& arrays, double largest);

bool is_finite(const Doubles& array);

/// True if the quaternions of all poses [.., 7] are longer than `shortest`.
bool have_quaternions(const Doubles& poses, double shortest);

}  // namespace diffcloth::bind
