#include "step/potentials/air.h"
#include "step/potentials/attachments.h"
#include "step/potentials/elasticity.h"
#include "step/potentials/soft_pins.h"
#include "step/problem.h"

namespace diffcloth::step {

std::vector<std::unique_ptr<StepPotential>> make_potentials(const Problem& problem,
                                                            const Gradients* wanted) {
  std::vector<std::unique_ptr<StepPotential>> list;
  list.push_back(std::make_unique<Elasticity>(problem, wanted));
  list.push_back(std::make_unique<Air>(problem, wanted));
  list.push_back(std::make_unique<Attachments>(problem));
  list.push_back(std::make_unique<SoftPins>(problem));
  return list;
}

}  // namespace diffcloth::step
