#pragma once

#include <cstdint>
#include <list>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

#include "linalg/cholesky.h"

namespace diffcloth::step {

/// What backward needs of forward beyond the inputs: positions only. Contacts are found again from
/// them, and a factor is found in the cache or made again where it was made: the same bits.
template <class T, class Integer>
struct BasicTape {
  T* iterates = nullptr;  ///< [K, N, 3] the solution of each friction iteration
  T* factored = nullptr;  ///< [K, N, 3] where its last Hessian was factored
  T* elastic = nullptr;   ///< [2, N, 3] `split`: x^D, and where the elastic Hessian was factored
  Integer* solves = nullptr;  ///< [1] friction iterations that were made
  Integer* key = nullptr;     ///< [1] of the factors in the cache
};
using Tape = BasicTape<double, std::int64_t>;
using ConstTape = BasicTape<const double, const std::int64_t>;

/// Factors of recent steps, by key, up to a number of bytes; the oldest go first.
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
