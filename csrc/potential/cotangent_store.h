#pragma once

#include <any>
#include <cstddef>
#include <utility>
#include <vector>

namespace diffcloth {

/// Cotangents that potentials accumulated for one loss, stored while another loss is processed.
///
/// In each round the same potentials swap their cotangents with the stored ones in the same order; the
/// first stored ones are zero.
class CotangentStore {
 public:
  /// Begin a round of swaps.
  void begin() { next_ = 0; }

  /// @param bar  of any copyable type; must be zero in the first round
  template <class T>
  void exchange(T& bar) {
    if (next_ == bars_.size()) bars_.emplace_back(bar);
    std::swap(std::any_cast<T&>(bars_[next_++]), bar);
  }

 private:
  std::vector<std::any> bars_;
  std::size_t next_ = 0;
};

}  // namespace diffcloth
