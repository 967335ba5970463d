#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>

#include "step/cotangents.h"
#include "step/problem.h"
#include "step/step.h"

namespace diffcloth::step {

namespace {

/// Pairs within the reach of the problem's barrier at the start.
contact::Near near_at_start(const Problem& p, const contact::ContactModel& barrier) {
  const double* const x = p.start.data();
  contact::BroadPhase::Scratch scratch;
  std::vector<contact::Candidate> candidates;
  p.scene.broad_phase.find(x, x, barrier.reach(), scratch, candidates);
  contact::Near near;
  barrier.measure(candidates, x, near);
  return near;
}

/// @throws std::domain_error if surfaces overlap
std::vector<contact::Contact> contacts_at_start(const Problem& p,
                                                const contact::ContactModel& barrier) {
  const contact::Near near = near_at_start(p, barrier);
  if (!std::isfinite(near.energy())) {
    throw std::domain_error("contact stores an infinite energy, which has no gradient: " +
                            find_overlap(p.scene, p.inputs));
  }
  std::vector<contact::Contact> contacts;
  barrier.find(near, p.start.data(), contacts);
  return contacts;
}

/// Add the derivatives of seed times the barrier's energy.
void accumulate_contact(const Problem& p,
                        const contact::ContactModel& barrier,
                        const std::vector<contact::Contact>& contacts,
                        double seed,
                        Cotangents& bars) {
  const double* const x = p.start.data();
  std::vector<double> gradient(p.start.size(), 0.0);
  barrier.add_gradient(contacts, x, gradient.data());
  for (std::size_t a = 0; a < gradient.size(); ++a) bars.start[a] += seed * gradient[a];
  barrier.add_energy_bars(contacts, x, seed, bars.contact);
}

}  // namespace

Energies stored_energy(const Scene& scene, const Inputs& inputs) {
  const Problem p(scene, inputs);
  Energies energies;
  for (const auto& potential : p.potentials) {
    potential->visit_energy(p.start.data(), [&](const char* name, double value) {
      energies.emplace_back(name, value);
    });
  }
  energies.emplace_back("contact", p.contact ? near_at_start(p, *p.contact).energy() : 0.0);
  return energies;
}

void pull_back_energy(const Scene& scene, const Inputs& inputs, std::span<const Loss> losses) {
  const Gradients& wanted = losses.front().gradients;
  Problem p(scene, inputs, &wanted);
  const auto of_contact = [](const Loss& loss) { return *loss.cotangents["contact"]; };
  std::vector<contact::Contact> contacts;
  if (p.contact && std::ranges::any_of(losses, [&](auto& l) { return of_contact(l) != 0.0; })) {
    contacts = contacts_at_start(p, *p.contact);
  }
  for (const Loss& loss : losses) {
    Cotangents bars(p, wanted);
    const Turn::Exchange exchange = [&](std::size_t /*loss*/) { bars.exchange(p); };
    const Turn turn(exchange, 0);
    for (const auto& potential : p.potentials) {
      potential->accumulate_energy(
          p.start.data(), [&](const char* name) { return *loss.cotangents[name]; },
          bars.start.data());
    }
    if (p.contact && !contacts.empty()) {
      accumulate_contact(p, *p.contact, contacts, of_contact(loss), bars);
    }
    bars.write(p, loss.gradients);
  }
}

namespace {

/// Gradients with their own storage.
struct OwnGradients {
  std::array<std::vector<double>, kInputCount> numbers;

  /// Gradients of the inputs that change along any of the directions.
  OwnGradients(const Inputs& inputs, std::span<const Direction> directions) {
    for (std::size_t k = 0; k < kInputCount; ++k) {
      const auto changes = [&](const Direction& d) { return d.tangents.views[k].data != nullptr; };
      if (std::ranges::any_of(directions, changes)) numbers[k].assign(inputs.views[k].count, 0.0);
    }
  }

  Gradients views() {
    Gradients result;
    for (std::size_t k = 0; k < kInputCount; ++k) {
      if (!numbers[k].empty()) result.data[k] = numbers[k].data();
    }
    return result;
  }

  double along(const Inputs& tangents) const {
    double sum = 0.0;
    for (std::size_t k = 0; k < kInputCount; ++k) {
      const double* const change = tangents.views[k].data;
      if (change == nullptr) continue;
      for (std::size_t a = 0; a < numbers[k].size(); ++a) sum += numbers[k][a] * change[a];
    }
    return sum;
  }
};

}  // namespace

// Few outputs depend on many inputs: compute their gradients, and multiply them by all directions.
void push_forward_energy(const Scene& scene,
                         const Inputs& inputs,
                         std::span<const Direction> directions) {
  const Energies parts = stored_energy(scene, inputs);
  const double one = 1.0;
  const double zero = 0.0;
  for (const auto& [part, value] : parts) {
    OwnGradients own(inputs, directions);
    Loss loss{.cotangents = {}, .gradients = own.views()};
    for (const auto& [name, unused] : parts) loss.cotangents.set(name, name == part ? &one : &zero);
    pull_back_energy(scene, inputs, {&loss, 1});
    for (const Direction& direction : directions) {
      *direction.outputs[part] = own.along(direction.tangents);
    }
  }
}

}  // namespace diffcloth::step
