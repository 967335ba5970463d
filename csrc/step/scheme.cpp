#include "step/scheme.h"

#include <array>
#include <stdexcept>
#include <string>

#include "step/schemes/coupled.h"
#include "step/schemes/projective.h"
#include "step/schemes/split.h"

namespace diffcloth::step {

std::span<const Scheme* const> schemes() {
  static const Coupled coupled;
  static const Split split;
  static const Projective projective;
  static const std::array<const Scheme*, 3> all{&coupled, &split, &projective};
  return all;
}

const Scheme& find_scheme(std::string_view name) {
  std::string names;
  for (const Scheme* scheme : schemes()) {
    if (scheme->name() == name) return *scheme;
    names += (names.empty() ? "'" : ", '") + std::string(scheme->name()) + "'";
  }
  throw std::invalid_argument("scheme must be one of " + names + ", got '" + std::string(name) +
                              "'");
}

}  // namespace diffcloth::step
