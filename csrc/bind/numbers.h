#pragma once

#include <vector>

#include "bind/arrays.h"

namespace diffcloth::bind {

/// Whether all numbers are at most `largest` in size; no NaN is.
bool is_within(const Doubles& array, double largest);
bool are_within(const std::vector<Doubles>& arrays, double largest);

bool is_finite(const Doubles& array);

/// Whether all poses [.., 7] have quaternions longer than this.
bool have_quaternions(const Doubles& poses, double shortest);

}  // namespace diffcloth::bind
