#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "common/interrupt.h"
#include "linalg/dense_kernels.h"
#include "solver/factor_cache.h"
#include "step/inputs.h"
#include "step/report.h"
#include "step/scene.h"

namespace diffcloth::step {

/// Outputs of a step: "positions" and "velocities" [N, 3], "body_forces" [V, 3], "contact_forces" [N,
/// 3], "pin_forces" [P, 3], and, if there are any, "coordinates" [n].
std::vector<Field> output_fields(const Scene& scene);

/// Fields that backward needs beyond the inputs: the fields that the scheme keeps.
std::vector<Field> tape_fields(const Scene& scene);

/// One step of the scene's scheme.
///
/// @param outputs  named like output_fields(), zeroed
/// @param tape     named like tape_fields(), zeroed; empty: no tape
/// @param kept     data for backward; empty if the step failed
/// @param threads  number of threads for the work of a large scene, without influence on any bit
/// @param path     list to which the accepted iterates (all vertices) are appended, or null
Report forward(const Scene& scene,
               const Inputs& inputs,
               const Checkpoint& checkpoint,
               const Arrays<double>& outputs,
               const Arrays<double>& tape,
               solver::KeptSolves& kept,
               int threads,
               std::vector<std::vector<double>>* path);

/// Output cotangents and input gradients of one loss.
struct Loss {
  Arrays<const double> cotangents;  ///< cotangents of the outputs, by their names
  Gradients gradients;              ///< the same inputs for all losses
};

/// Number of losses that one call of backward() processes best, and of directions for tangent(): the
/// right sides of one pass over a factor.
inline constexpr std::size_t kAtOnce = linalg::kMaxVectors;

/// Gradients of several losses of a step that forward() computed. Each loss has the bits of a separate
/// call; see schemes/contact_adjoint.cpp for the derivation.
///
/// @param kept  data from forward(); may be empty
/// @throws std::domain_error when the solution is not a local minimum.
void backward(const Scene& scene,
              const Inputs& inputs,
              const Arrays<const double>& tape,
              const solver::KeptSolves& kept,
              std::span<const Loss> losses,
              int threads,
              const Checkpoint& checkpoint);

/// Tangents of the inputs, and arrays for the tangents of the outputs.
struct Direction {
  Inputs tangents;         ///< tangents with the counts of the inputs; zero where null
  Arrays<double> outputs;  ///< named like output_fields(), zeroed
};

/// Changes of the outputs of a step that forward() computed, along several directions of its inputs.
/// Each direction has the bits of a separate call.
///
/// @param kept  data from forward(); may be empty
/// @throws std::domain_error when the solution is not a local minimum.
void tangent(const Scene& scene,
             const Inputs& inputs,
             const Arrays<const double>& tape,
             const solver::KeptSolves& kept,
             std::span<const Direction> directions,
             int threads,
             const Checkpoint& checkpoint);

/// Description of surfaces that overlap at the start of the step or are closer than their thickness;
/// else empty.
std::string find_overlap(const Scene& scene, const Inputs& inputs);

/// Two surfaces that the barrier throws apart from the start of a step.
struct Throw {
  std::string elements;     ///< nearest elements of both
  double gap;               ///< distance of these elements [m]
  double barrier_distance;  ///< d_hat [m]
  double speed;             ///< largest speed of a point that the barrier moves [m/s]
};

/// The pair of surfaces that the barrier throws apart fastest if everything rests at the start of a
/// step; absent if the barrier moves nothing. See throw.cpp.
std::optional<Throw> find_throw(const Scene& scene, const Inputs& inputs);

/// Parts of an energy by their names [J].
using Energies = std::vector<std::pair<const char*, double>>;

/// Energy of the potentials of the cloths and of the barrier at the positions of the inputs. Gravity is
/// computed in Python.
Energies stored_energy(const Scene& scene, const Inputs& inputs);

/// Gradients of these parts for several losses, whose cotangents are numbers by the names of the parts.
///
/// The gradient is zero for inputs of motion and dissipation.
///
/// @throws std::domain_error if surfaces overlap and the barrier's part has a cotangent
void pull_back_energy(const Scene& scene, const Inputs& inputs, std::span<const Loss> losses);

/// Changes of these parts along several directions of the inputs; the outputs are numbers by the names
/// of the parts.
///
/// @throws std::domain_error if surfaces overlap
void push_forward_energy(const Scene& scene,
                         const Inputs& inputs,
                         std::span<const Direction> directions);

/// The unit EF of speeds: seconds of one numeric factorization of the contact-free Hessian at the
/// inputs' positions by Eigen's SimplicialLDLT, minimum degree order, no BLAS; the median of several.
double reference_factorization_seconds(const Scene& scene, const Inputs& inputs, int repeats);

/// kappa of each pair of surfaces, from these two alone [surfaces^2], [Pa]: the larger of the stiffness
/// that balances a cloth's contact-free Hessian at rest and the stiffness that carries a free body; the
/// stiffness for joints if a pair has neither. Pairs that never touch have the value of the first pair
/// that may; zero if none may.
std::vector<double> default_barrier_stiffness(const Scene& scene,
                                              const Inputs& inputs,
                                              double barrier_distance);

}  // namespace diffcloth::step
