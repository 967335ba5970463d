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

/// Outputs of a step: "positions" and "velocities" [N, 3], "body_forces" [V, 3], "contact_forces"
/// [N, 3], "pin_forces" [P, 3], and, where there are any, "coordinates" [n].
std::vector<Field> output_fields(const Scene& scene);

/// Fields that backward needs beyond the inputs: those that the scheme keeps.
std::vector<Field> tape_fields(const Scene& scene);

/// One step of the scene's scheme.
///
/// @param outputs  named like output_fields(), zeroed
/// @param tape     named like tape_fields(), zeroed; empty where no tape is wanted
/// @param kept     for backward; nothing where it failed
/// @param threads  that share the work of a large scene; they change no bit
/// @param path     where the accepted iterates (all vertices) are appended, or null
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
  Arrays<const double> cotangents;  ///< of the outputs, by their names
  Gradients gradients;              ///< the same inputs for all losses
};

/// How many losses are worth one call of backward(), or directions one of tangent(): those that one pass
/// over a factor solves for.
inline constexpr std::size_t kAtOnce = linalg::kMaxVectors;

/// Gradients of a step that forward() took, of several losses, each with the bits that it has alone: see
/// schemes/contact_stage.cpp for the derivation.
///
/// @param kept  what forward kept, or nothing
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
  Inputs tangents;         ///< of the counts of the inputs; zero where null
  Arrays<double> outputs;  ///< named like output_fields(), zeroed
};

/// How the outputs of a step that forward() took change along several directions of its inputs, each with
/// the bits that it has alone.
///
/// @param kept  what forward kept, or nothing
/// @throws std::domain_error when the solution is not a local minimum.
void tangent(const Scene& scene,
             const Inputs& inputs,
             const Arrays<const double>& tape,
             const solver::KeptSolves& kept,
             std::span<const Direction> directions,
             int threads,
             const Checkpoint& checkpoint);

/// Where surfaces overlap at the start of the step, or are closer than their thickness; else empty.
std::string find_overlap(const Scene& scene, const Inputs& inputs);

/// Two surfaces that the barrier throws apart from the start of a step.
struct Throw {
  std::string elements;     ///< the nearest ones of both
  double gap;               ///< between them [m]
  double barrier_distance;  ///< d_hat [m]
  double speed;             ///< the largest of a point that it moves [m/s]
};

/// The pair of surfaces that the barrier throws apart fastest if everything rests at the start of a step;
/// absent where the barrier moves nothing. See throw.cpp.
std::optional<Throw> find_throw(const Scene& scene, const Inputs& inputs);

/// Parts of an energy by their names [J].
using Energies = std::vector<std::pair<const char*, double>>;

/// Energy of the potentials of the cloths and of the barrier at the positions of the inputs. Gravity is
/// computed in Python.
Energies stored_energy(const Scene& scene, const Inputs& inputs);

/// Gradients of these parts, of several losses, whose cotangents are numbers by the names of the parts.
///
/// The gradient is zero for inputs of motion and dissipation.
///
/// @throws std::domain_error where surfaces overlap, if the barrier's part has a cotangent
void pull_back_energy(const Scene& scene, const Inputs& inputs, std::span<const Loss> losses);

/// How these parts change along several directions of the inputs; the outputs are numbers by the names of
/// the parts.
///
/// @throws std::domain_error where surfaces overlap
void push_forward_energy(const Scene& scene,
                         const Inputs& inputs,
                         std::span<const Direction> directions);

/// The unit EF that speeds are stated in: seconds of one numeric factorization of the contact-free
/// Hessian at the inputs' positions by Eigen's SimplicialLDLT, minimum degree order, no BLAS; the
/// median of several.
double reference_factorization_seconds(const Scene& scene, const Inputs& inputs, int repeats);

/// kappa of each pair of surfaces, from these two alone [surfaces^2], [Pa]: the larger of the stiffness that
/// balances a cloth's contact-free Hessian at rest and the stiffness that carries a free body; of joints if a
/// pair has neither. Pairs that never touch have the number of the first that may; zero where none may.
std::vector<double> default_barrier_stiffness(const Scene& scene,
                                              const Inputs& inputs,
                                              double barrier_distance);

}  // namespace diffcloth::step
