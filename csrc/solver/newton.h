#pragma once

#include <array>
#include <memory>
#include <string>
#include <vector>

#include "common/interrupt.h"
#include "contact/broad_phase.h"
#include "contact/candidate_list.h"
#include "solver/objective.h"

namespace diffcloth::solver {

enum class Status : std::uint8_t { kConverged, kNotConverged, kInfeasibleMotion };

/// Phases that a step's time is reported for.
enum class Phase : std::uint8_t { kDetection, kAssembly, kFactorization, kSolve, kLineSearch };
inline constexpr std::size_t kPhaseCount = 5;
inline constexpr std::array<const char*, kPhaseCount> kPhaseNames{
    "detection", "assembly", "factorization", "solve", "line_search"};
using Seconds = std::array<double, kPhaseCount>;

struct Options {
  double tolerance;    ///< on |p|_inf / h, p the last full Newton step [m/s]
  int max_iterations;  ///< for each portion of the prescribed motion, and for the minimization
};

/// How the prescribed vertices (pins and bodies) move over the step: in portions, each short enough
/// that straight motion between its ends does not distort a turning body.
class PrescribedMotion {
 public:
  virtual ~PrescribedMotion() = default;
  virtual int portions() const = 0;

  /// Write the positions of the prescribed vertices at the end of portion k into x.
  virtual void end_of_portion(int k, double* x) const = 0;
};

/// What a minimization needs besides the objective.
struct Context {
  const contact::BroadPhase* broad_phase;  ///< null: no collision detection at all
  contact::CandidateList* candidates;      ///< kept over the solves of a step
  contact::BroadPhase::Scratch* scratch;
  const Checkpoint* checkpoint;
  Options options;
  Seconds* seconds;
  std::vector<std::vector<double>>* path = nullptr;  ///< accepted iterates, where wanted
};

struct Outcome {
  Status status = Status::kNotConverged;
  int iterations = 0;
  double residual = 0.0;                   ///< |p|_inf / h of the last full Newton step [m/s]
  double motion_fraction = 1.0;            ///< of the prescribed motion that was reached
  std::vector<contact::Contact> contacts;  ///< at the solution
  std::vector<double> factored_at;         ///< where the last exact Hessian was factored
  std::shared_ptr<const linalg::CholeskyFactor> factor;
};

/// Find a local minimum of the objective near x, moving the prescribed vertices to their ends.
///
/// @param x      in: a feasible start, prescribed vertices at the start of their motion; out: the
///               last feasible iterate, whatever the status
/// @param guess  where to start instead if the straight way there is certified free of contact
///               (prescribed vertices at their ends); may be null
///
/// Every segment of the polyline of accepted iterates is free of collisions. Converged means that
/// the last step used an unshifted, unprojected Hessian that is positive definite: a local minimum,
/// not a saddle.
Outcome minimize(const Objective& objective,
                 std::vector<double>& x,
                 const PrescribedMotion& motion,
                 const std::vector<double>* guess,
                 const Context& context);

/// The exact Hessian at `x` factored as minimize() does it; null when it is not positive definite.
std::shared_ptr<const linalg::CholeskyFactor> factor_exact(
    const Objective& objective, const double* x, const std::vector<contact::Contact>& contacts);

/// Contacts at x, found from scratch.
std::vector<contact::Contact> contacts_at(const Objective& objective,
                                          const double* x,
                                          const contact::BroadPhase* broad_phase,
                                          contact::BroadPhase::Scratch* scratch);

}  // namespace diffcloth::solver
