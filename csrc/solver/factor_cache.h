#pragma once

#include <cstddef>
#include <list>
#include <memory>
#include <mutex>
#include <vector>

#include "contact/contact_set.h"
#include "solver/linear_system.h"

namespace diffcloth::solver {

/// Certificates and contacts of the solves of one step, kept for backward. Both are functions of the
/// inputs and the tape: recomputed if evicted, with the same bits.
struct KeptSolves {
  // Both in the order of the scheme.
  std::vector<Certificate> certificates;
  std::vector<std::vector<contact::Contact>> contacts;

  std::size_t bytes() const;

  /// Add a certificate, or none where the cache has no room for it.
  void add(Certificate certificate);

  /// Certificate k; none if it was not kept or is evicted.
  Certificate certificate(std::size_t k) const {
    return k < certificates.size() ? certificates[k] : Certificate{};
  }
};

/// Kept solves of the steps that may still be differentiated, up to a number of bytes; the oldest are
/// evicted first.
class FactorCache {
 public:
  class Ticket;

  FactorCache() : room_(std::make_shared<Room>()) {}

  /// Keep solves as long as their ticket lives and the bound on bytes allows.
  std::unique_ptr<Ticket> insert(KeptSolves kept);

  void clear() { room_->shrink(0); }

  /// Size of all that is kept; at most kBytes.
  std::size_t bytes() const;

  static constexpr std::size_t kBytes = std::size_t{256} << 20;

 private:
  struct Entry {
    std::size_t bytes;
    std::shared_ptr<const KeptSolves> kept;
    Ticket* ticket;
  };

  /// Shared with the tickets, which may outlive the cache.
  struct Room {
    mutable std::mutex mutex;
    std::list<Entry> entries;  // oldest first
    std::size_t bytes = 0;

    /// Drop the oldest entries until at most `largest` bytes are left.
    void shrink(std::size_t largest);
  };

  std::shared_ptr<Room> room_;
};

/// Access to the kept solves of one step, which are dropped with it.
class FactorCache::Ticket {
 public:
  ~Ticket();
  Ticket(const Ticket&) = delete;
  Ticket& operator=(const Ticket&) = delete;

  /// The kept solves; empty if evicted.
  std::shared_ptr<const KeptSolves> find() const;

 private:
  friend class FactorCache;

  Ticket(std::shared_ptr<Room> room, KeptSolves kept);

  std::shared_ptr<Room> room_;
  std::list<Entry>::iterator entry_;  // the end if evicted
};

}  // namespace diffcloth::solver
