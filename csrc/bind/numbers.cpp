#include "bind/numbers.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

namespace diffcloth::bind {

bool is_within(const Doubles& array, double largest) {
  std::int64_t beyond = 0;  // branch-free, so that the compiler can vectorize
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

bool have_quaternions(const Doubles& poses, double shortest) {
  for (std::size_t k = 0; k + 7 <= poses.size(); k += 7) {
    const double* const q = poses.data() + k + 3;
    if (!(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] > shortest * shortest))
      return false;
  }
  return true;
}

}  // namespace diffcloth::bind
