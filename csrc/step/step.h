#pragma once

#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "common/interrupt.h"
#include "linalg/cholesky.h"
#include "step/inputs.h"
#include "step/scene.h"
#include "step/tape.h"

namespace diffcloth::step {

/// Outcome of an environment's step, as the report states it.
enum class Result : std::int32_t {
  kConverged = 0,
  kNotConverged = 1,
  kInfeasibleMotion = 2,
  kIntersectingStart = 3,
};

struct Report {
  Result result = Result::kConverged;
  Index iterations = 0;
  double residual = 0.0;          ///< |p|_inf / h [m/s]
  double minimum_distance = 0.0;  ///< of the pairs in contact; infinite without contact [m]
  Index contact_count = 0;
  double motion_fraction = 1.0;
  solver::Seconds seconds{};
  std::string message;
};

/// Where the results of one environment go. With a path, the accepted iterates (all vertices) are
/// appended to it.
struct Outputs {
  double* positions;    ///< [N, 3]
  double* velocities;   ///< [N, 3]
  double* body_forces;  ///< [V, 3]
  Tape tape;            ///< pointers are null where no tape is wanted
  std::vector<std::vector<double>>* path = nullptr;
};

/// One step: x_{n+1}, v_{n+1}, the contact forces on the bodies' vertices, and the tape.
///
/// `coupled` minimizes inertia + elasticity + anchors + barrier + friction together. `split` (the
/// paper's Eqs. 21-23) first inertia + elasticity + anchors, which gives x^D, then
/// 1/(2h^2) (x - x^D)^T G (x - x^D) + barrier + friction. Either solves once for each friction
/// iteration, with friction lagged at the solution before.
Report forward(const Scene& scene,
               const Inputs& inputs,
               const Checkpoint& checkpoint,
               Outputs outputs,
               FactorCache* factors);

/// Cotangents of the outputs of a step.
struct Cotangents {
  const double* positions;
  const double* velocities;
  const double* body_forces;
};

/// Gradients of a step that forward() took: see backward.cpp for the derivation.
///
/// @throws std::domain_error when the solution is not a local minimum.
void backward(const Scene& scene,
              const Inputs& inputs,
              const ConstTape& tape,
              const Cotangents& cotangents,
              const Checkpoint& checkpoint,
              const Gradients& gradients,
              FactorCache& factors);

/// Elastic energy + gravity + soft pins + barrier at the positions of the inputs [J].
double potential_energy(const Scene& scene, const Inputs& inputs);

/// The unit EF that speeds are stated in: seconds of one numeric factorization of the contact-free
/// Hessian at the inputs' positions by Eigen's SimplicialLDLT, minimum degree order, no BLAS; the
/// median of several.
double reference_factorization_seconds(const Scene& scene, const Inputs& inputs, int repeats);

/// kappa that balances the barrier with the contact-free Hessian at rest (3-contact, 3.3) [Pa].
double default_barrier_stiffness(const Scene& scene, const Inputs& inputs, double barrier_distance);

}  // namespace diffcloth::step
