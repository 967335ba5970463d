#include "step/potentials/air.h"

#include <algorithm>
#include <cstddef>

#include "step/cotangents.h"
#include "step/problem.h"
#include "step/tangents.h"

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

Array scaled(Array values, double factor) {
  for (double& value : values) value *= factor;
  return values;
}

/// The density of the air; a scene without cloths has none.
double half_density(const Problem& p) {
  const double* const density = p.inputs.data(Input::kAirDensity);
  return density != nullptr ? 0.5 * *density : 0.0;
}

/// Drag of second-order steps acts on the mean velocity, as velocities are half a step before positions.
bool takes_mean(const Problem& p) { return p.scene.given.integrator == Integrator::kSecondOrder; }

bool wants_coefficients(const Gradients* wanted) {
  return wanted != nullptr &&
         ((*wanted)[Input::kNormalDrag] != nullptr || (*wanted)[Input::kTangentialDrag] != nullptr);
}

air::Flow flow(const Problem& p, const Array& normal, const Array& tangential) {
  const double* const wind = p.inputs.data(Input::kWind);
  return {.faces = p.scene.topology.faces,
          .across = scaled(normal, half_density(p)),
          .along = scaled(tangential, half_density(p)),
          .start = p.start.data(),
          .wind = wind != nullptr ? row(wind, 0) : Vec3(Vec3::Zero()),
          .h = p.h,
          .velocities = takes_mean(p) ? p.inputs.data(Input::kVelocities) : nullptr,
          .held = &p.scene.held_elements.faces};
}

}  // namespace

Air::Air(const Problem& p, const Gradients* wanted)
    : half_density_(half_density(p)),
      normal_(values_per_face(p, Input::kNormalDrag)),
      tangential_(values_per_face(p, Input::kTangentialDrag)),
      potential_(
          flow(p, normal_, tangential_), p.scene.cloth_vertex_count(), wants_coefficients(wanted)) {
}

void Air::pull_back(const Problem& p, Cotangents& bars, const Gradients& gradients) {
  const Array& across = potential_.across_bar;
  const Array& along = potential_.along_bar;
  add_per_face(p, Input::kNormalDrag, scaled(across, half_density_), gradients);
  add_per_face(p, Input::kTangentialDrag, scaled(along, half_density_), gradients);
  if (double* const out = gradients[Input::kAirDensity]) {
    for (std::size_t f = 0; f < across.size(); ++f) {
      *out += 0.5 * (normal_[f] * across[f] + tangential_[f] * along[f]);
    }
  }
  add_to(gradients[Input::kWind], potential_.wind_bar);
  add_to(bars.start.data(), potential_.start_bar);
  add_to(bars.velocities.data(), potential_.velocity_bar);
}

void Air::push_forward(const Problem& p, const Tangents& tangents) {
  const double* const density = tangents.directions.data(Input::kAirDensity);
  const double half_dot = density != nullptr ? 0.5 * *density : 0.0;
  potential_.across_dot = scaled(tangents.per_face(p, Input::kNormalDrag), half_density_);
  potential_.along_dot = scaled(tangents.per_face(p, Input::kTangentialDrag), half_density_);
  for (std::size_t f = 0; f < normal_.size(); ++f) {
    potential_.across_dot[f] += half_dot * normal_[f];
    potential_.along_dot[f] += half_dot * tangential_[f];
  }
  potential_.start_dot.assign(tangents.start.begin(),
                              tangents.start.begin() + static_cast<std::ptrdiff_t>(p.cloth_size));
  if (takes_mean(p)) {
    const double* const v = tangents.directions.data(Input::kVelocities);
    potential_.velocity_dot.assign(p.cloth_size, 0.0);
    if (v != nullptr) std::copy_n(v, p.cloth_size, potential_.velocity_dot.begin());
  }
  const double* const wind = tangents.directions.data(Input::kWind);
  potential_.wind_dot = wind != nullptr ? row(wind, 0) : Vec3(Vec3::Zero());
}

}  // namespace diffcloth::step
