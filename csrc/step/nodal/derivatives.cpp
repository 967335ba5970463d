// Shared by the adjoint and the tangent of nodal contact.

#include <stdexcept>

#include "solver/stopping.h"
#include "step/nodal/system.h"

namespace diffcloth::step {

using solver::stopping::kNodal;

using Array = std::vector<double>;

Array solve_derivative(const NodalSystem& system,
                       const NodalSystem::Point& at,
                       const linalg::BlockMatrix& H,
                       const linalg::CholeskyFactor& S,
                       bool transposed,
                       const Array& b) {
  Array w;
  if (!system.solve(at, H, S, transposed, b, kNodal.derivative_tolerance, w).converged) {
    // Rounding may exceed the tolerance; a larger residual is then accepted.
    Array again;
    if (!system.solve(at, H, S, transposed, b, kNodal.largest_derivative_error, again).converged) {
      throw std::domain_error("a derivative of nodal friction did not converge");
    }
  }
  return w;
}

solver::Factor certified(const NodalSystem& system,
                         solver::LinearSystem& linear,
                         const NodalSystem::Point& at,
                         const linalg::BlockMatrix& H,
                         solver::Factor factor) {
  if (!factor) factor = linear.factor_in_doubles(system.without_coupling(at, H));
  if (!factor) throw std::domain_error("the Hessian is not positive definite at the solution");
  return factor;
}

std::array<std::size_t, 2> friction_entries(const Problem& problem,
                                            const NodalContacts& contacts,
                                            const projective::NodalContact& c) {
  const auto surfaces = static_cast<std::size_t>(problem.scene.surface_count());
  const auto a = static_cast<std::size_t>(problem.scene.vertex_cloth[c.vertex]);
  const auto b = static_cast<std::size_t>(c.partner >= 0 ? problem.scene.vertex_cloth[c.partner]
                                                         : problem.scene.cloth_count() +
                                                               contacts.obstacles[c.obstacle].body);
  return {a * surfaces + b, b * surfaces + a};
}

}  // namespace diffcloth::step
