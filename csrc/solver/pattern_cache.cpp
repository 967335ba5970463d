#include "solver/pattern_cache.h"

#include <utility>

namespace diffcloth::solver {

AnalyzedPattern::Found AnalyzedPattern::analysis() const {
  bool is_new = false;
  std::call_once(once_, [&] {
    analysis_ = std::make_shared<linalg::CholeskyAnalysis>(merged.pattern, fixed_);
    is_new = true;
  });
  return {.analysis = analysis_, .is_new = is_new};
}

PatternCache::PatternCache(const linalg::BlockPattern& base, std::vector<char> fixed)
    : fixed_(std::move(fixed)),
      plain_(std::make_shared<AnalyzedPattern>(base, fixed_, linalg::Couplings())) {}

std::shared_ptr<const AnalyzedPattern> PatternCache::find(const linalg::Couplings& pairs) {
  if (pairs.empty()) return plain_;
  {
    const std::lock_guard lock(mutex_);
    for (auto entry = entries_.begin(); entry != entries_.end(); ++entry) {
      if (entry->key != pairs) continue;
      entries_.splice(entries_.begin(), entries_, entry);
      return entry->pattern;
    }
  }
  const auto pattern = std::make_shared<const AnalyzedPattern>(base(), fixed_, pairs);
  // The analysis, which may be computed later, holds about five times as many indices as the pattern.
  const std::vector<Index>& row = pattern->merged.pattern.row();
  const std::size_t bytes = sizeof(pairs.front()) * pairs.size() + 12 * sizeof(Index) * row.size();
  const std::lock_guard lock(mutex_);
  entries_.push_front({.key = pairs, .pattern = pattern, .bytes = bytes});
  bytes_ += bytes;
  while (bytes_ > kCapacity) {
    bytes_ -= entries_.back().bytes;
    entries_.pop_back();
  }
  return pattern;
}

}  // namespace diffcloth::solver
