#pragma once

#include <algorithm>
#include <utility>
#include <vector>

#include "bodies/rotations.h"
#include "bodies/smooth_function.h"

namespace diffcloth::bodies {

/// Both evaluations of a function from one template, Derived::of.
template <class Derived>
class TemplatedFunction : public SmoothFunction {
 public:
  void evaluate(Inputs<double> in, Outputs<double> out) const final { self().of(in, out); }
  void evaluate(Inputs<Recorded> in, Outputs<Recorded> out) const final { self().of(in, out); }

 private:
  friend Derived;
  TemplatedFunction(std::vector<Array> inputs, std::vector<Array> outputs)
      : SmoothFunction(std::move(inputs), std::move(outputs)) {}

  const Derived& self() const { return static_cast<const Derived&>(*this); }
};

// Parts of arrays as matrices, and back.

template <class T>
Eigen::Matrix<T, Eigen::Dynamic, 1> vector(const T* numbers, Index size) {
  return Eigen::Map<const Eigen::Matrix<T, Eigen::Dynamic, 1>>(numbers, size);
}

template <class T>
Vector3<T> vector3(const T* numbers) {
  return {numbers[0], numbers[1], numbers[2]};
}

template <class T>
Eigen::Matrix<T, 4, 1> vector4(const T* numbers) {
  return {numbers[0], numbers[1], numbers[2], numbers[3]};
}

/// From row-major numbers.
template <class T>
Matrix3<T> matrix3(const T* numbers) {
  return Eigen::Map<const Eigen::Matrix<T, 3, 3, Eigen::RowMajor>>(numbers);
}

/// The unit quaternion of a pose [7].
template <class T>
Quaternion4<T> orientation(const T* pose) {
  return normalized<T>(vector4(pose + 3));
}

/// A vector and its negative, as separate recorded results: cotangents of the two are accumulated
/// separately, and cancel to the last bit if both vectors are rotated alike.
template <class T>
std::pair<Vector3<T>, Vector3<T>> both_ways(const Vector3<T>& v) {
  return {T(1.0) * v, -v};
}

template <class T, class Values>
void put(const Values& values, T* out) {
  std::copy_n(values.data(), values.size(), out);
}

template <class T>
void put(const Vector3<T>& position, const Quaternion4<T>& quaternion, T* pose) {
  put(position, pose);
  put(quaternion, pose + 3);
}

}  // namespace diffcloth::bodies
