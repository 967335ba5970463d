#pragma once

#include <cstddef>
#include <list>
#include <memory>
#include <mutex>
#include <vector>

#include "contact/contact_set.h"
#include "solver/linear_system.h"

namespace diffcloth::step {

/// What forward leaves for backward to use again. All of it is a function of the inputs and the tape:
/// backward finds what is gone again, with the same bits.
struct Kept {
  /// Of one step, each in its scheme's own order.
  std::vector<solver::Certificate> certificates;
  std::vector<std::vector<contact::Contact>> contacts;

  std::size_t bytes() const;

  /// Add a certificate, or none where the cache has no room for it.
  void add(solver::Certificate certificate);
};

/// What is kept of steps whose backward can still be asked for, up to a number of bytes; the oldest go
/// first.
class FactorCache {
 public:
  class Ticket;

  FactorCache() : room_(std::make_shared<Room>()) {}

  /// Keep something for as long as its ticket lives, and there is room.
  std::unique_ptr<Ticket> insert(Kept kept);

  void clear() { room_->shrink(0); }

  /// What everything that is kept takes up; at most kBytes.
  std::size_t bytes() const;

  static constexpr std::size_t kBytes = std::size_t{256} << 20;

 private:
  struct Entry {
    std::size_t bytes;
    std::shared_ptr<const Kept> kept;
    Ticket* ticket;
  };

  /// Shared with the tickets, which may outlive the cache.
  struct Room {
    mutable std::mutex mutex;
    std::list<Entry> entries;  // oldest first
    std::size_t bytes = 0;

    /// Drop the oldest until no more than this is left.
    void shrink(std::size_t largest);
  };

  std::shared_ptr<Room> room_;
};

/// The right to what is kept of one step.
class FactorCache::Ticket {
 public:
  ~Ticket();
  Ticket(const Ticket&) = delete;
  Ticket& operator=(const Ticket&) = delete;

  /// What is kept; nothing where it had to go.
  std::shared_ptr<const Kept> find() const;

 private:
  friend class FactorCache;

  Ticket(std::shared_ptr<Room> room, Kept kept);

  std::shared_ptr<Room> room_;
  std::list<Entry>::iterator entry_;  // the end where it had to go
};

}  // namespace diffcloth::step
