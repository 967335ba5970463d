#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include <Eigen/Core>

namespace diffcloth {

/// Operations of an evaluation, in order, for its derivatives. One derivative costs a pass over the
/// operations in either direction, for any number of inputs (Griewank and Walther, "Evaluating
/// Derivatives", 2008).
class Recording {
 public:
  /// Active recording of this thread; null outside of `Recorder`.
  static Recording*& current() {
    thread_local Recording* recording = nullptr;
    return recording;
  }

  /// Remove all operations, but keep their memory.
  void clear() { operations_.assign(1, {}); }

  /// @return index of a result with these partial derivatives by two earlier ones
  std::uint32_t add(std::uint32_t a, double rate_a, std::uint32_t b, double rate_b) {
    operations_.push_back({.a = a, .b = b, .rate_a = rate_a, .rate_b = rate_b});
    return static_cast<std::uint32_t>(operations_.size() - 1);
  }

  /// Number of results; result 0 represents all constants.
  std::size_t size() const { return operations_.size(); }

  /// Accumulate cotangents of results, [size], into cotangents of their inputs.
  void pull_back(std::vector<double>& of) const {
    for (std::size_t i = operations_.size() - 1; i > 0; --i) {
      const Operation& by = operations_[i];
      if (of[i] == 0.0) continue;
      of[by.a] += by.rate_a * of[i];
      of[by.b] += by.rate_b * of[i];
    }
  }

  /// Compute tangents of all results, [size], from tangents of the first `variables` ones.
  void push_forward(std::size_t variables, std::vector<double>& of) const {
    of[0] = 0.0;
    for (std::size_t i = 1 + variables; i < operations_.size(); ++i) {
      const Operation& by = operations_[i];
      of[i] = by.rate_a * of[by.a] + by.rate_b * of[by.b];
    }
  }

 private:
  struct Operation {
    std::uint32_t a = 0, b = 0;
    double rate_a = 0.0, rate_b = 0.0;
  };
  std::vector<Operation> operations_{1};
};

/// Scope in which this thread records into a cleared recording.
class Recorder {
 public:
  explicit Recorder(Recording& recording) : before_(Recording::current()) {
    recording.clear();
    Recording::current() = &recording;
  }
  ~Recorder() { Recording::current() = before_; }
  Recorder(const Recorder&) = delete;
  Recorder& operator=(const Recorder&) = delete;

 private:
  Recording* before_;
};

/// A number whose operations are recorded, unless it is constant. Its value has the same bits as with
/// double.
struct Recorded {
  double value = 0.0;
  std::uint32_t place = 0;  ///< index in the recording; 0 for a constant

  Recorded() = default;
  Recorded(double v) : value(v) {}  // NOLINT(google-explicit-constructor): constants mix in

  static Recorded variable(double v) {
    return result(v, Recording::current()->add(0, 0.0, 0, 0.0));
  }

  /// Result f(a) with the derivative df/da.
  static Recorded of(double f, const Recorded& a, double slope) {
    if (a.place == 0 || slope == 0.0) return f;
    return result(f, Recording::current()->add(a.place, slope, 0, 0.0));
  }
  static Recorded of(
      double f, const Recorded& a, double slope_a, const Recorded& b, double slope_b) {
    if (b.place == 0 || slope_b == 0.0) return of(f, a, slope_a);
    if (a.place == 0 || slope_a == 0.0) return of(f, b, slope_b);
    return result(f, Recording::current()->add(a.place, slope_a, b.place, slope_b));
  }

  Recorded& operator+=(const Recorded& b) { return *this = *this + b; }
  Recorded& operator-=(const Recorded& b) { return *this = *this - b; }
  Recorded& operator*=(const Recorded& b) { return *this = *this * b; }
  Recorded& operator/=(const Recorded& b) { return *this = *this / b; }

  friend Recorded operator-(const Recorded& a) { return of(-a.value, a, -1.0); }
  friend Recorded operator+(const Recorded& a, const Recorded& b) {
    return of(a.value + b.value, a, 1.0, b, 1.0);
  }
  friend Recorded operator-(const Recorded& a, const Recorded& b) {
    return of(a.value - b.value, a, 1.0, b, -1.0);
  }
  friend Recorded operator*(const Recorded& a, const Recorded& b) {
    return of(a.value * b.value, a, b.value, b, a.value);
  }
  friend Recorded operator/(const Recorded& a, const Recorded& b) {
    const double quotient = a.value / b.value;
    return of(quotient, a, 1.0 / b.value, b, -quotient / b.value);
  }
  friend bool operator<(const Recorded& a, const Recorded& b) { return a.value < b.value; }
  friend bool operator>(const Recorded& a, const Recorded& b) { return a.value > b.value; }
  friend bool operator==(const Recorded& a, const Recorded& b) { return a.value == b.value; }

  friend Recorded sqrt(const Recorded& a) {
    const double root = std::sqrt(a.value);
    return of(root, a, 0.5 / root);
  }
  friend Recorded sin(const Recorded& a) { return of(std::sin(a.value), a, std::cos(a.value)); }
  friend Recorded cos(const Recorded& a) { return of(std::cos(a.value), a, -std::sin(a.value)); }
  friend Recorded atan2(const Recorded& y, const Recorded& x) {
    const double size_sq = x.value * x.value + y.value * y.value;
    return of(std::atan2(y.value, x.value), y, x.value / size_sq, x, -y.value / size_sq);
  }

 private:
  static Recorded result(double v, std::uint32_t place) {
    Recorded r(v);
    r.place = place;
    return r;
  }
};

/// Value without derivatives.
inline double value_of(double x) { return x; }
inline double value_of(const Recorded& x) { return x.value; }

}  // namespace diffcloth

namespace Eigen {

template <>
struct NumTraits<diffcloth::Recorded> : NumTraits<double> {
  using Real = diffcloth::Recorded;
  using NonInteger = diffcloth::Recorded;
  using Nested = diffcloth::Recorded;
  // NOLINTBEGIN(readability-identifier-naming): Eigen's names
  enum {
    IsComplex = 0,
    IsInteger = 0,
    IsSigned = 1,
    RequireInitialization = 1,
    ReadCost = 1,
    AddCost = 3,
    MulCost = 3
  };
  // NOLINTEND(readability-identifier-naming)
};

}  // namespace Eigen
