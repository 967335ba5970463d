#pragma once

#include <cstddef>
#include <memory>
#include <new>

namespace diffcloth::linalg {

/// Doubles at an address that is a multiple of a cache line, not initialized.
class AlignedBuffer {
 public:
  AlignedBuffer() = default;
  explicit AlignedBuffer(std::size_t size)
      : size_(size),
        data_(size == 0 ? nullptr
                        : static_cast<double*>(::operator new(size * sizeof(double), kAlignment))) {
  }

  double* data() { return data_.get(); }
  const double* data() const { return data_.get(); }
  std::size_t size() const { return size_; }
  std::size_t bytes() const { return size_ * sizeof(double); }

 private:
  static constexpr std::align_val_t kAlignment{64};
  struct Delete {
    void operator()(double* p) const { ::operator delete(p, kAlignment); }
  };

  std::size_t size_ = 0;
  std::unique_ptr<double, Delete> data_;
};

}  // namespace diffcloth::linalg
