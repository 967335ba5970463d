#include "solver/factor_cache.h"

#include <iterator>
#include <utility>

namespace diffcloth::solver {

std::size_t KeptSolves::bytes() const {
  std::size_t sum = 0;
  for (const auto& certificate : certificates) sum += certificate.bytes();
  for (const auto& list : contacts) sum += list.size() * sizeof(contact::Contact);
  return sum;
}

void KeptSolves::add(Certificate certificate) {
  // A certificate above the limit would be evicted at once, but hold memory meanwhile.
  if (certificate.bytes() > FactorCache::kBytes) certificate = {};
  certificates.push_back(std::move(certificate));
}

void FactorCache::Room::shrink(std::size_t largest) {
  const std::lock_guard lock(mutex);
  while (bytes > largest) {
    bytes -= entries.front().bytes;
    entries.front().ticket->entry_ = entries.end();
    entries.pop_front();
  }
}

std::unique_ptr<FactorCache::Ticket> FactorCache::insert(KeptSolves kept) {
  std::unique_ptr<Ticket> ticket(new Ticket(room_, std::move(kept)));
  room_->shrink(kBytes);
  return ticket;
}

std::size_t FactorCache::bytes() const {
  const std::lock_guard lock(room_->mutex);
  return room_->bytes;
}

FactorCache::Ticket::Ticket(std::shared_ptr<Room> room, KeptSolves kept) : room_(std::move(room)) {
  const std::size_t bytes = kept.bytes();
  auto shared = std::make_shared<const KeptSolves>(std::move(kept));
  const std::lock_guard lock(room_->mutex);
  room_->entries.push_back({.bytes = bytes, .kept = std::move(shared), .ticket = this});
  room_->bytes += bytes;
  entry_ = std::prev(room_->entries.end());
}

FactorCache::Ticket::~Ticket() {
  const std::lock_guard lock(room_->mutex);
  if (entry_ == room_->entries.end()) return;
  room_->bytes -= entry_->bytes;
  room_->entries.erase(entry_);
}

std::shared_ptr<const KeptSolves> FactorCache::Ticket::find() const {
  const std::lock_guard lock(room_->mutex);
  return entry_ != room_->entries.end() ? entry_->kept : std::make_shared<const KeptSolves>();
}

}  // namespace diffcloth::solver
