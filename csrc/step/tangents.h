#pragma once

#include <vector>

#include "mesh/rest_shape.h"
#include "step/problem.h"

namespace diffcloth::step {

/// Tangents of the quantities that the potentials of a step share, along one direction of the inputs:
/// the transpose of Cotangents. Fields with equal names hold the tangents of the same quantities.
class Tangents {
 public:
  /// @param directions  a tangent for each input, with the count of that input; zero where null
  Tangents(const Problem& problem, const Inputs& directions);

  /// Put the tangents into the potentials of the problem, for Potential::add_tangent(): all but contact.
  void push_forward(Problem& problem) const;

  /// Tangent of the origin of friction's displacements, as Problem::moved_from().
  const std::vector<double>& moved_from() const { return origins.empty() ? start : origins; }

  Inputs directions;

  std::vector<double> start;       ///< x_n and o_n: all points
  std::vector<double> origins;     ///< origins of friction's displacements, if not the start
  std::vector<double> ends;        ///< prescribed points at their ends: all but the points of links
  std::vector<double> masses;      ///< [N]
  std::vector<double> prediction;  ///< y, the target of inertia [3 N]
  contact::ContactModel::Bar contact;
  bool changes_contact = false;  ///< true if `contact` is not zero

  mesh::RestShapeBar rest;  ///< empty if the rest shape does not change

  /// Tangent of an input that is given per face [F].
  std::vector<double> per_face(const Problem& problem, Input input) const;

  /// Tangent of lumped(): of an input per face, and of the areas.
  ///
  /// @param values  of the input [F]
  std::vector<double> lumped(const Problem& problem,
                             Input input,
                             const std::vector<double>& values) const;
};

}  // namespace diffcloth::step
