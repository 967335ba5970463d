#include <stdexcept>

#include "step/nodal_stage.h"

namespace diffcloth::step {

std::vector<double> NodalStage::tangent(const Pushforward& /*step*/,
                                        const std::vector<double>& /*x*/,
                                        solver::Factor /*factor*/,
                                        std::size_t /*direction*/) const {
  throw std::logic_error("step: frictional contact at nodes has no tangent");
}

}  // namespace diffcloth::step
