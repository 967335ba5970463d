#pragma once

#include <cstddef>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "bind/arrays.h"
#include "bind/environments.h"
#include "bind/field_arrays.h"
#include "solver/factor_cache.h"
#include "step/inputs.h"
#include "step/scene.h"
#include "step/step.h"

namespace diffcloth::bind {

/// Data that a step with a tape keeps for its backward pass, by environment; released with the tape.
struct KeptSteps {
  std::vector<std::shared_ptr<solver::FactorCache::Ticket>> tickets;
  std::vector<double> costs;  ///< expected cost of a derivative, in any unit
};

/// Handle of a scene in Python: each call processes the arrays of all environments.
class Simulator {
 public:
  explicit Simulator(step::Description description)
      : scene_(std::move(description)),
        outputs_(step::output_fields(scene_)),
        tape_(step::tape_fields(scene_)) {}

  nb::dict forward(const nb::dict& inputs, bool tape, int threads);
  nb::dict backward(const nb::dict& inputs,
                    const nb::dict& tape,
                    const KeptSteps& kept,
                    const nb::dict& cotangents,
                    std::size_t losses,
                    const std::vector<std::string>& needs,
                    int threads);
  nb::dict tangent(const nb::dict& inputs,
                   const nb::dict& tape,
                   const KeptSteps& kept,
                   const nb::dict& tangents,
                   std::size_t directions,
                   int threads);
  nb::dict stored_energy(const nb::dict& inputs) const;
  nb::dict energy_backward(const nb::dict& inputs,
                           const nb::dict& cotangents,
                           std::size_t losses,
                           const std::vector<std::string>& needs,
                           int threads) const;
  nb::dict energy_tangent(const nb::dict& inputs,
                          const nb::dict& tangents,
                          std::size_t directions,
                          int threads) const;
  nb::object path(const nb::dict& inputs);
  double smallest_nonadjacent_distance() const;
  nb::object default_barrier_stiffness(const nb::dict& inputs, double barrier_distance) const;
  nb::object find_overlap(const nb::dict& inputs) const;
  nb::list find_throws(const nb::dict& inputs, int threads) const;
  double reference_factorization_seconds(const nb::dict& inputs, int repeats) const;
  void forget_factors() { factors_.clear(); }
  std::size_t factor_bytes() const { return factors_.bytes(); }

  /// Order and time of the environments of the last forward(), or of the portions of the last
  /// derivative.
  const std::vector<Turn>& last_turns() const { return last_turns_; }

 private:
  /// Check and return the tapes of steps computed by forward().
  Saved taken_steps(std::size_t environments, const nb::dict& tape, const KeptSteps& kept) const;

  step::Scene scene_;
  std::vector<step::Field> outputs_;
  std::vector<step::Field> tape_;
  solver::FactorCache factors_;

  // Accessed with the GIL held. The time of a step is the best estimate for the next one, and affects
  // only the order in which threads process environments.
  std::vector<double> step_seconds_;
  std::vector<Turn> last_turns_;
};

}  // namespace diffcloth::bind
