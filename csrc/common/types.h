#pragma once

#include <cstdint>

#include <Eigen/Core>
#include <Eigen/Geometry>  // cross()

namespace diffcloth {

/// Index of a vertex, edge, face or contact in the kernels; int64 only at the Python boundary.
using Index = std::int32_t;

using Vec2 = Eigen::Vector2d;
using Vec3 = Eigen::Vector3d;
using Vec4 = Eigen::Vector4d;
using Mat2 = Eigen::Matrix2d;
using Mat3 = Eigen::Matrix3d;
using Vec12 = Eigen::Matrix<double, 12, 1>;
using Mat12 = Eigen::Matrix<double, 12, 12>;

/// Positions, forces, ... of n vertices, one a row; memory layout of the arrays that Python owns.
using Rows3 = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;
using ConstRows3 = Eigen::Map<const Rows3>;

/// Vertex i of an array of rows, as a column vector.
inline Vec3 row(const double* rows, Index i) { return Eigen::Map<const Vec3>(rows + 3 * i); }

/// The 12x12 matrix of four points from its 3x3 blocks.
template <class Block>
Mat12 all_blocks(const Block& block) {
  Mat12 h;
  for (int p = 0; p < 4; ++p) {
    for (int q = 0; q < 4; ++q) h.block<3, 3>(3 * p, 3 * q) = block(p, q);
  }
  return h;
}

}  // namespace diffcloth
