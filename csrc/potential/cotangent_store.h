#pragma once

#include <any>
#include <cstddef>
#include <utility>
#include <vector>

namespace diffcloth {

/// What potentials have accumulated for one loss, set aside while another loss has its turn.
///
/// Each time the same potentials come by in the same order, and swap what they have with what is here:
/// zero, the first time.
class CotangentStore {
 public:
  /// Begin a round of swaps.
  void begin() { next_ = 0; }

  /// @param bar  of any type that can be copied; zero where it comes by for the first time
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
