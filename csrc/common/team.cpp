#include "common/team.h"

#include <cstddef>
#include <system_error>

#include "common/processor_time.h"

namespace diffcloth {

Team::~Team() {
  {
    const std::lock_guard lock(mutex_);
    ends_ = true;
  }
  changed_.notify_all();
  helpers_.clear();  // joined before the members they use are destroyed
}

void Team::run(Index count, const Ready& ready, const Body& body) {
  if (size_ == 1) {
    for (Index i = 0; i < count; ++i) body(i, 0);
    return;
  }
  start();
  std::unique_lock lock(mutex_);
  taken_.assign(static_cast<std::size_t>(count), 0);
  done_.assign(static_cast<std::size_t>(count), 0);
  ready_ = &ready;
  body_ = &body;
  first_ = 0;
  left_ = count;
  changed_.notify_all();
  work(lock, 0);
}

void Team::start() {
  if (started_) return;
  started_ = true;
  helpers_.reserve(static_cast<std::size_t>(size_ - 1));
  for (int member = 1; member < size_; ++member) {
    try {
      helpers_.emplace_back([this, member] { help(member); });
    } catch (const std::system_error&) {
      break;  // the system has no more threads to give
    }
  }
}

void Team::help(int member) {
  std::unique_lock lock(mutex_);
  while (!ends_) {
    work(lock, member);
    changed_.wait(lock, [&] { return ends_ || find_ready() >= 0; });
  }
}

/// Participate in a loop until it is complete.
void Team::work(std::unique_lock<std::mutex>& lock, int member) {
  while (left_ > 0) {
    const Index i = find_ready();
    if (i < 0) {
      changed_.wait(lock);
      continue;
    }
    taken_[i] = 1;
    lock.unlock();
    const double before = member == 0 ? 0.0 : processor_seconds();
    (*body_)(i, member);
    const double spent = member == 0 ? 0.0 : processor_seconds() - before;
    lock.lock();
    helpers_seconds_ += spent;
    done_[i] = 1;
    --left_;
    changed_.notify_all();
  }
}

/// Lowest index that may begin, or -1.
Index Team::find_ready() {
  if (left_ == 0) return -1;
  const auto count = static_cast<Index>(taken_.size());
  while (first_ < count && taken_[first_] != 0) ++first_;
  for (Index i = first_; i < count; ++i) {
    if (taken_[i] == 0 && (*ready_)(i, done_)) return i;
  }
  return -1;
}

}  // namespace diffcloth
