#pragma once

#include <cstdint>
#include <list>
#include <memory>
#include <mutex>
#include <vector>

#include "linalg/cholesky.h"

namespace diffcloth::step {

/// Factors of recent steps, by key, up to a number of bytes; the oldest go first.
///
/// A factor is a function of the point where it was made: backward makes what is gone again, with the
/// same bits.
class FactorCache {
 public:
  using Factors = std::vector<std::shared_ptr<const linalg::CholeskyFactor>>;

  std::int64_t insert(Factors factors);

  /// The factors of a key; empty where they are gone.
  Factors find(std::int64_t key) const;

  void clear();

  /// What the factors that are kept take up; at most kBytes.
  std::size_t bytes() const;

  static constexpr std::size_t kBytes = std::size_t{256} << 20;

 private:
  struct Entry {
    std::int64_t key;
    std::size_t bytes;
    Factors factors;
  };
  mutable std::mutex mutex_;
  std::list<Entry> entries_;  // oldest first
  std::size_t bytes_ = 0;
  std::int64_t next_ = 1;
};

}  // namespace diffcloth::step
