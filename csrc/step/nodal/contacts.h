#pragma once

#include <memory>
#include <vector>

#include "potential/potential.h"
#include "projective/nodal_contact.h"
#include "step/problem.h"

namespace diffcloth::step {

/// Contacts of a stage with contact at nodes: found once, on the straight path from x_n to the inertial
/// prediction.
struct NodalContacts {
  explicit NodalContacts(Problem& problem);

  std::vector<projective::Obstacle> obstacles;
  std::vector<projective::NodalContact> list;
  std::vector<Index> partner;            ///< [N] vertex in contact with each, or -1
  std::vector<double> inertia;           ///< [N] rho, see nodal/system.cpp [kg]
  std::unique_ptr<Potential> couplings;  ///< couplings of pairs, without energy; null without pairs
};

/// The cloths on that path.
projective::Swept swept(const Problem& problem);

}  // namespace diffcloth::step
