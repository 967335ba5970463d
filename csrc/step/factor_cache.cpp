#include "step/factor_cache.h"

namespace diffcloth::step {

std::int64_t FactorCache::insert(Kept kept) {
  std::size_t bytes = 0;
  for (const auto& factor : kept.factors) {
    if (factor) bytes += factor->bytes();
  }
  for (const auto& contacts : kept.contacts) bytes += contacts.size() * sizeof(contact::Contact);
  const std::lock_guard lock(mutex_);
  const std::int64_t key = next_++;
  entries_.push_back(
      {.key = key, .bytes = bytes, .kept = std::make_shared<const Kept>(std::move(kept))});
  bytes_ += bytes;
  while (bytes_ > kBytes) {
    bytes_ -= entries_.front().bytes;
    entries_.pop_front();
  }
  return key;
}

std::shared_ptr<const FactorCache::Kept> FactorCache::find(std::int64_t key) const {
  const std::lock_guard lock(mutex_);
  for (const Entry& entry : entries_) {
    if (entry.key == key) return entry.kept;
  }
  return std::make_shared<const Kept>();
}

std::size_t FactorCache::bytes() const {
  const std::lock_guard lock(mutex_);
  return bytes_;
}

void FactorCache::clear() {
  const std::lock_guard lock(mutex_);
  entries_.clear();
  bytes_ = 0;
}

}  // namespace diffcloth::step
