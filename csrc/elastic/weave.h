#pragma once

#include "common/types.h"

namespace diffcloth::elastic {

/// Stiffnesses of a woven triangle, and the directions of its yarns.
struct Weave {
  double warp;   ///< k_w [N/m]; times the area for an energy
  double weft;   ///< k_f likewise
  double shear;  ///< k_wf likewise
  Vec2 axis;     ///< unit vector along the warp in the rest frame; the weft is to its left

  /// Q = [warp, weft], the material axes as columns: F Q has the columns of F along them.
  Mat2 axes() const {
    Mat2 Q;
    Q << axis.x(), -axis.y(), axis.y(), axis.x();
    return Q;
  }

  /// K o A, entry by entry, of a symmetric matrix in material axes: K = [[k_w, k_wf], [k_wf, k_f]].
  Mat2 times(const Mat2& A) const {
    Mat2 result;
    result << warp * A(0, 0), shear * A(0, 1), shear * A(1, 0), weft * A(1, 1);
    return result;
  }

  /// K o A of a matrix in the rest frame: Q (K o Q^T A Q) Q^T.
  Mat2 times_in_rest_frame(const Mat2& A) const {
    const Mat2 Q = axes();
    return Q * times(Q.transpose() * A * Q) * Q.transpose();
  }

  Weave scaled(double factor) const {
    return {.warp = factor * warp, .weft = factor * weft, .shear = factor * shear, .axis = axis};
  }
};

}  // namespace diffcloth::elastic
