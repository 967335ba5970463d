#pragma once

#include <array>
#include <span>
#include <vector>

#include "common/types.h"

namespace diffcloth::contact {

/// Pairs of surfaces that may touch: symmetric, including a surface with itself.
class SurfacePairs {
 public:
  SurfacePairs() = default;
  explicit SurfacePairs(Index surface_count)
      : surface_count_(surface_count),
        contains_(static_cast<std::size_t>(surface_count) * surface_count, 0) {}

  Index surface_count() const { return surface_count_; }
  bool contains(Index a, Index b) const { return contains_[a * surface_count_ + b] != 0; }
  void set(Index a, Index b, bool may_touch) {
    contains_[a * surface_count_ + b] = contains_[b * surface_count_ + a] = char{may_touch};
  }

 private:
  Index surface_count_ = 0;
  std::vector<char> contains_;  // [surfaces^2]
};

/// Rules that determine which surfaces may touch: cloths (0 .. cloth_count - 1), then bodies.
struct TouchRules {
  Index surface_count;
  Index cloth_count;
  bool self_contact;                              ///< True if a cloth touches itself.
  std::span<const char> body_dynamic;             ///< [bodies] true if dynamic; empty: none is.
  std::span<const std::array<Index, 2>> ignored;  ///< Pairs of surfaces that never touch.
};

/// Cloths touch each other and bodies; two bodies touch if dynamics moves at least one of them.
SurfacePairs touching_surfaces(const TouchRules& rules);

}  // namespace diffcloth::contact
