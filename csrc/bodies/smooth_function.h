#pragma once

#include <cstddef>
#include <functional>
#include <numeric>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "common/recorded.h"

namespace diffcloth::bodies {

/// Function of arrays of numbers, whose derivatives are computed by recording its operations.
class SmoothFunction {
 public:
  struct Array {
    Array(std::string name, std::vector<std::size_t> shape, bool is_optional = false)
        : name(std::move(name)), shape(std::move(shape)), is_optional(is_optional) {}

    std::string name;
    std::vector<std::size_t> shape;  ///< of one environment
    bool is_optional;

    std::size_t size() const {
      return std::accumulate(shape.begin(), shape.end(), std::size_t{1}, std::multiplies<>());
    }
  };

  /// Arrays of one environment; null for an optional one that is missing.
  template <class T>
  using Inputs = std::span<const T* const>;
  template <class T>
  using Outputs = std::span<T* const>;

  virtual ~SmoothFunction() = default;

  virtual void evaluate(Inputs<double> in, Outputs<double> out) const = 0;
  virtual void evaluate(Inputs<Recorded> in, Outputs<Recorded> out) const = 0;

  const std::vector<Array>& inputs() const { return inputs_; }
  const std::vector<Array>& outputs() const { return outputs_; }

 protected:
  SmoothFunction(std::vector<Array> inputs, std::vector<Array> outputs)
      : inputs_(std::move(inputs)), outputs_(std::move(outputs)) {}

 private:
  std::vector<Array> inputs_, outputs_;
};

/// A function evaluated at a point, with the derivatives by some of its inputs.
class Linearized {
 public:
  /// @param varies  [inputs] nonzero for variables; the others are constants
  Linearized(const SmoothFunction& function,
             SmoothFunction::Inputs<double> in,
             const std::vector<char>& varies);

  /// Gradients by the variables, array by array, from cotangents of the outputs.
  ///
  /// @param cotangents  [outputs]; null: zero
  /// @param gradients   [inputs]; null for constants
  void pull_back(std::span<const double* const> cotangents, std::span<double* const> gradients);

  /// Tangents of the outputs from tangents of the variables.
  ///
  /// @param given     [inputs]; null: zero
  /// @param tangents  [outputs]
  void push_forward(std::span<const double* const> given, std::span<double* const> tangents);

 private:
  const SmoothFunction& function_;
  const std::vector<char>& varies_;
  Recording recording_;
  std::vector<std::vector<Recorded>> outputs_;
  std::vector<double> change_;  // tangents or cotangents of the recorded results
};

}  // namespace diffcloth::bodies
