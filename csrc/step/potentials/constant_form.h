#pragma once

#include <memory>
#include <vector>

#include "elastic/constant_form.h"
#include "elastic/elastic_potential.h"
#include "projective/constant_matrix.h"
#include "step/problem.h"

namespace diffcloth::step {

/// Potentials of a problem that are springs: soft pins and attachments.
std::vector<elastic::SpringPotential*> springs(const Problem& problem);

/// L of elasticity and springs.
elastic::ConstantForm constant_form(const Problem& problem);

/// A = M/h^2 + L over the cloths' free vertices, factored.
std::shared_ptr<const projective::ConstantMatrix> constant_matrix(const Problem& problem);

}  // namespace diffcloth::step
