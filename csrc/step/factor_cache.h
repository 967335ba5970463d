#pragma once

#include <cstdint>
#include <list>
#include <memory>
#include <mutex>
#include <vector>

#include "contact/contact_set.h"
#include "linalg/cholesky.h"

namespace diffcloth::step {

/// Factors and contacts of recent steps, by key, up to a number of bytes; the oldest go first.
///
/// Both are functions of the point where they were found: backward finds what is gone again, with the
/// same bits.
class FactorCache {
 public:
  using Factors = std::vector<std::shared_ptr<const linalg::CholeskyFactor>>;
  using Contacts = std::vector<std::vector<contact::Contact>>;

  /// Of one step, each in its scheme's own order.
  struct Kept {
    Factors factors;
    Contacts contacts;
  };

  std::int64_t insert(Kept kept);

  /// What is kept of a key; empty where it is gone.
  std::shared_ptr<const Kept> find(std::int64_t key) const;

  void clear();

  /// What everything that is kept takes up; at most kBytes.
  std::size_t bytes() const;

  static constexpr std::size_t kBytes = std::size_t{256} << 20;

 private:
  struct Entry {
    std::int64_t key;
    std::size_t bytes;
    std::shared_ptr<const Kept> kept;
  };
  mutable std::mutex mutex_;
  std::list<Entry> entries_;  // oldest first
  std::size_t bytes_ = 0;
  std::int64_t next_ = 1;
};

}  // namespace diffcloth::step
