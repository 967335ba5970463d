#pragma once

#include <cstdint>

namespace diffcloth {

/// Pseudo-random numbers in [-0.5, 0.5), identical in every run: for vectors that share no symmetry with
/// a scene.
class FixedNoise {
 public:
  double operator()() {
    seed_ = seed_ * 1664525U + 1013904223U;
    return static_cast<double>(seed_ >> 8) / (1U << 24) - 0.5;
  }

 private:
  std::uint32_t seed_ = 1;
};

}  // namespace diffcloth
