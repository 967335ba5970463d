#pragma once

#include <vector>

#include "contact/contact_set.h"
#include "step/scene.h"

namespace diffcloth::step {

/// Which surfaces contacts of a step connect, directly or through others, among those that forces
/// move: what is prescribed takes any momentum, and connects nothing.
class SurfaceGroups {
 public:
  explicit SurfaceGroups(const Scene& scene);

  void connect(const std::vector<contact::Contact>& contacts);

  /// Of each surface the number of its group, below zero if something prescribed touches the group.
  std::vector<Index> numbers() const;

 private:
  Index find(Index surface) const;

  const Scene& scene_;
  std::vector<Index> earlier_;  ///< one of the same group, or the surface itself
  std::vector<char> held_;      ///< whether something prescribed touches the surface
};

}  // namespace diffcloth::step
