#include "step/tape.h"

namespace diffcloth::step {

std::int64_t FactorCache::insert(Factors factors) {
  std::size_t bytes = 0;
  for (const auto& factor : factors) {
    if (factor) bytes += factor->bytes();
  }
  const std::lock_guard lock(mutex_);
  const std::int64_t key = next_++;
  entries_.push_back({.key = key, .bytes = bytes, .factors = std::move(factors)});
  bytes_ += bytes;
  while (bytes_ > kBytes) {
    bytes_ -= entries_.front().bytes;
    entries_.pop_front();
  }
  return key;
}

FactorCache::Factors FactorCache::find(std::int64_t key) const {
  const std::lock_guard lock(mutex_);
  for (const Entry& entry : entries_) {
    if (entry.key == key) return entry.factors;
  }
  return {};
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
