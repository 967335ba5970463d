#include "solver/assembly_cache.h"

#include <utility>

namespace diffcloth::solver {

Assembly::Found Assembly::analysis() const {
  bool is_new = false;
  std::call_once(once_, [&] {
    analysis_ = std::make_shared<linalg::CholeskyAnalysis>(merged.pattern, fixed_);
    is_new = true;
  });
  return {.analysis = analysis_, .is_new = is_new};
}

AssemblyCache::AssemblyCache(const linalg::BlockPattern& base, std::vector<char> fixed)
    : fixed_(std::move(fixed)),
      plain_(std::make_shared<Assembly>(base, fixed_, linalg::Couplings())) {}

std::shared_ptr<const Assembly> AssemblyCache::find(const linalg::Couplings& pairs) {
  if (pairs.empty()) return plain_;
  {
    const std::lock_guard lock(mutex_);
    for (auto entry = entries_.begin(); entry != entries_.end(); ++entry) {
      if (entry->key != pairs) continue;
      entries_.splice(entries_.begin(), entries_, entry);
      return entry->assembly;
    }
  }
  const auto assembly = std::make_shared<const Assembly>(base(), fixed_, pairs);
  // The analysis, which may come later, holds about five times as many indices as the pattern.
  const std::vector<Index>& row = assembly->merged.pattern.row();
  const std::size_t bytes = sizeof(pairs.front()) * pairs.size() + 12 * sizeof(Index) * row.size();
  const std::lock_guard lock(mutex_);
  entries_.push_front({.key = pairs, .assembly = assembly, .bytes = bytes});
  bytes_ += bytes;
  while (bytes_ > kCapacity) {
    bytes_ -= entries_.back().bytes;
    entries_.pop_back();
  }
  return assembly;
}

}  // namespace diffcloth::solver
