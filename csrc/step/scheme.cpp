#include "step/scheme.h"

#include <array>
#include <stdexcept>
#include <string>

#include "step/coupled.h"
#include "step/projective.h"
#include "step/split.h"

namespace diffcloth::step {
namespace {

/// All schemes: a new one is a line here.
std::array<const Scheme*, 3> schemes() {
  static const Coupled coupled;
  static const Split split;
  static const Projective projective;
  return {&coupled, &split, &projective};
}

}  // namespace

const Scheme& find_scheme(std::string_view name) {
  std::string names;
  for (const Scheme* scheme : schemes()) {
    if (scheme->name() == name) return *scheme;
    names += (names.empty() ? "'" : ", '") + std::string(scheme->name()) + "'";
  }
  throw std::invalid_argument("scheme must be one of " + names + ", got '" + std::string(name) +
                              "'");
}

std::vector<std::string_view> scheme_names() {
  std::vector<std::string_view> names;
  for (const Scheme* scheme : schemes()) names.push_back(scheme->name());
  return names;
}

}  // namespace diffcloth::step
