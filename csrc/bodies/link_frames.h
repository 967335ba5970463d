#pragma once

#include <memory>

#include "bodies/smooth_function.h"
#include "bodies/tree.h"

namespace diffcloth::bodies {

/// Frames of all links in the root's frame, from the values of the joints.
///
/// The input is `joints` [J]; the outputs are row-major matrices:
///
///   frames  [L, 4, 4]  F_l
///   twists  [L, 4, 4]  S_l of the joint that carries link l, as a matrix; zero if the joint is fixed
///
/// A change dq of the coordinate of that joint changes the frames of link l and of all links that it
/// carries, and their twists, by
///
///   dF = dq S_l F,   dS = dq (S_l S - S S_l).
std::unique_ptr<SmoothFunction> link_frames(const Tree& tree);

}  // namespace diffcloth::bodies
