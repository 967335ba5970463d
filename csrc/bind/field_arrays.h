#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "bind/arrays.h"
#include "step/inputs.h"

namespace diffcloth::bind {

/// Arrays of all environments by name, and views of one environment.
class Outputs {
 public:
  /// Create zero arrays [rows.., ...] for these fields, and add them to `out` as prefix + name. Rows are
  /// environments, or directions and environments.
  Outputs(const std::vector<step::Field>& fields,
          const std::vector<std::size_t>& rows,
          const std::string& prefix,
          nb::dict& out);

  step::Arrays<double> environment(std::size_t row) const;

 private:
  struct Entry {
    std::string name;
    double* data;
    std::size_t size;
  };
  std::vector<Entry> entries_;
};

/// Arrays returned by Python under prefix + name. Their shapes are checked, because hooks on saved
/// tensors may return anything.
class Saved {
 public:
  Saved(const std::vector<step::Field>& fields,
        std::size_t environments,
        const std::string& prefix,
        const nb::dict& from);

  bool is_finite() const;

  /// True if all arrays of an environment are zero.
  bool is_zero(std::size_t e) const;

  step::Arrays<const double> environment(std::size_t e) const;

 private:
  struct Entry {
    std::string name;
    Doubles array;
    std::size_t size;
  };
  std::vector<Entry> entries_;
};

}  // namespace diffcloth::bind
