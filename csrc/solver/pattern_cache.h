#pragma once

#include <cstddef>
#include <list>
#include <memory>
#include <mutex>
#include <vector>

#include "linalg/block_matrix.h"
#include "linalg/cholesky.h"

namespace diffcloth::solver {

/// A matrix pattern that includes contacts, and its symbolic factorization, computed at first use.
class AnalyzedPattern {
 public:
  AnalyzedPattern(const linalg::BlockPattern& base,
                  const std::vector<char>& fixed,
                  const linalg::Couplings& pairs)
      : merged(linalg::merge(base, pairs)), fixed_(fixed) {}

  const linalg::MergedPattern merged;

  struct Found {
    std::shared_ptr<const linalg::CholeskyAnalysis> analysis;
    bool is_new;  ///< computed by this call
  };
  Found analysis() const;

 private:
  const std::vector<char>& fixed_;
  mutable std::once_flag once_;
  mutable std::shared_ptr<const linalg::CholeskyAnalysis> analysis_;
};

/// Known patterns and symbolic factorizations, keyed by the couplings that contact adds to the base
/// pattern.
///
/// A cache bounded in bytes: an entry is a function of its key, so results do not depend on the contents
/// of the cache.
class PatternCache {
 public:
  PatternCache(const linalg::BlockPattern& base, std::vector<char> fixed);

  PatternCache(const PatternCache&) = delete;
  PatternCache& operator=(const PatternCache&) = delete;

  /// @param pairs  sorted couplings of vertices that are not fixed, none of them in the base
  std::shared_ptr<const AnalyzedPattern> find(const linalg::Couplings& pairs);

  const linalg::BlockPattern& base() const { return plain_->merged.pattern; }
  const std::vector<char>& fixed() const { return fixed_; }

 private:
  struct Entry {
    linalg::Couplings key;
    std::shared_ptr<const AnalyzedPattern> pattern;
    std::size_t bytes;
  };
  static constexpr std::size_t kCapacity = std::size_t{32} << 20;  // [bytes]

  std::vector<char> fixed_;
  std::shared_ptr<const AnalyzedPattern> plain_;  ///< base pattern alone
  std::mutex mutex_;
  std::list<Entry> entries_;  // most recent first
  std::size_t bytes_ = 0;
};

}  // namespace diffcloth::solver
