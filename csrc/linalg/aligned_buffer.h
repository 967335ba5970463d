#pragma once

#include <cstddef>
#include <memory>

#include "common/recycled_memory.h"

namespace diffcloth::linalg {

/// Doubles at an address that is a multiple of a cache line, not initialized.
class AlignedBuffer {
 public:
  AlignedBuffer() = default;
  explicit AlignedBuffer(std::size_t size)
      : data_(size == 0 ? nullptr : static_cast<double*>(take_recycled(size * sizeof(double))),
              {size}) {}

  double* data() { return data_.get(); }
  const double* data() const { return data_.get(); }
  std::size_t size() const { return data_.get_deleter().size; }
  std::size_t bytes() const { return size() * sizeof(double); }

 private:
  struct GiveBack {
    std::size_t size;
    void operator()(double* p) const { give_back(p, size * sizeof(double)); }
  };

  std::unique_ptr<double, GiveBack> data_{nullptr, {0}};
};

}  // namespace diffcloth::linalg
