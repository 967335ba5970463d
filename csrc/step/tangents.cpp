#include "step/tangents.h"

#include <stdexcept>

#include "step/step.h"

namespace diffcloth::step {

void tangent(const Scene& /*scene*/,
             const Inputs& /*inputs*/,
             const Arrays<const double>& /*tape*/,
             const Kept& /*kept*/,
             std::span<const Direction> /*directions*/,
             int /*threads*/,
             const Checkpoint& /*checkpoint*/) {
  throw std::logic_error("step: no scheme has a tangent");
}

void push_forward_energy(const Scene& /*scene*/,
                         const Inputs& /*inputs*/,
                         std::span<const Direction> /*directions*/) {
  throw std::logic_error("step: no energy has a tangent");
}

}  // namespace diffcloth::step
