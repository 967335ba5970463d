#pragma once

#include <vector>

#include "mesh/rest_shape.h"
#include "step/problem.h"

namespace diffcloth::step {

/// Tangents of what the potentials of a step depend on, along one direction of the inputs: Cotangents,
/// transposed. Fields whose names there are the same mean the tangents of the same quantities.
class Tangents {
 public:
  /// @param directions  a tangent for each input, of the count of that input; zero where null
  Tangents(const Problem& problem, const Inputs& directions);

  /// Put them into the potentials of the problem, for Potential::add_tangent(): all but contact.
  void push_forward(Problem& problem) const;

  /// Where friction counts motion from, as Problem::moved_from().
  const std::vector<double>& moved_from() const { return origins.empty() ? start : origins; }

  Inputs directions;

  std::vector<double> start;    ///< x_n and o_n: all points
  std::vector<double> origins;  ///< what friction counts motion from, where it is not the start
  std::vector<double> ends;     ///< what is prescribed, at its end: all points but those of links
  std::vector<double> masses;   ///< [N]
  std::vector<double> prediction;  ///< y, the target of inertia [3 N]
  contact::ContactModel::Bar contact;
  bool changes_contact = false;  ///< whether that is not zero

  mesh::RestShapeBar rest;  ///< empty where the rest shape does not change

  /// Those of an input that is given per face [F].
  std::vector<double> per_face(const Problem& problem, Input input) const;

  /// Those of lumped(): of an input per face, and of the areas.
  ///
  /// @param values  of the input [F]
  std::vector<double> lumped(const Problem& problem,
                             Input input,
                             const std::vector<double>& values) const;
};

}  // namespace diffcloth::step
