#include "step/potentials/constant_form.h"

#include "step/potentials/attachments.h"
#include "step/potentials/elasticity.h"
#include "step/potentials/soft_pins.h"

namespace diffcloth::step {

std::vector<elastic::SpringPotential*> springs(const Problem& p) {
  return {&p.find<SoftPins>().potential(), &p.find<Attachments>().potential()};
}

elastic::ConstantForm constant_form(const Problem& p) {
  std::vector<elastic::Springs> kinds;
  for (const elastic::SpringPotential* const kind : springs(p)) kinds.push_back(kind->springs());
  return {p.find<Elasticity>().model(), p.scene.slots, kinds, p.scene.elastic_patterns.base()};
}

std::shared_ptr<const projective::ConstantMatrix> constant_matrix(const Problem& p) {
  const elastic::ConstantForm form = constant_form(p);
  std::vector<double> values(form.values().begin(), form.values().end());
  for (std::size_t i = 0; i < p.masses.size(); ++i) {
    values[form.pattern().column_start()[i]] += p.masses[i] / (p.h * p.h);
  }
  return p.scene.constant_matrices.find(values);
}

}  // namespace diffcloth::step
