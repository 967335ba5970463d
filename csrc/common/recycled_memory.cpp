#include "common/recycled_memory.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cstdlib>
#include <iterator>
#include <mutex>
#include <new>
#include <utility>

#ifdef __GLIBC__
#include <malloc.h>
#endif

namespace diffcloth {

namespace {

constexpr std::align_val_t kAlignment{64};

/// Arrays below are as quick from the allocator, those above too dear to keep [bytes].
constexpr std::size_t kSmallest = std::size_t{1} << 16;
#ifdef __SANITIZE_ADDRESS__
constexpr std::size_t kLargest = 0;  // the sanitizer is to see each of them freed
#else
constexpr std::size_t kLargest = std::size_t{1} << 24;
#endif

/// What is kept at most, of all sizes [bytes].
constexpr std::size_t kKept = std::size_t{1} << 25;

/// From here on it is worth the time to look for memory that is free before more is taken [bytes].
constexpr std::size_t kHuge = std::size_t{1} << 27;

/// Give what is free to the system, where the C library would hold on to it: small arrays, and those of
/// some megabytes.
void return_free_memory() {
#ifdef __GLIBC__
  malloc_trim(0);
#endif
}

bool is_recycled(std::size_t bytes) { return bytes >= kSmallest && bytes <= kLargest; }

/// Up to an eighth more than asked for: contact changes the sizes of matrices a little, and what held
/// one is to hold the next.
std::size_t rounded(std::size_t bytes) {
  const std::size_t step = std::bit_floor(bytes) / 8;
  return (bytes + step - 1) / step * step;
}

void* allocate(std::size_t bytes) { return ::operator new(bytes, kAlignment); }
void free(void* memory) noexcept { ::operator delete(memory, kAlignment); }

/// Memory that nobody uses. Who finds it locked goes to the system instead: that is no dearer than to
/// wait, and in a forked process the lock may belong to a thread that is not there.
class Unused {
 public:
  void* take(std::size_t bytes) {
    const std::unique_lock lock(mutex_, std::try_to_lock);
    if (!lock) return nullptr;
    for (std::size_t k = count_; k-- > 0;) {  // the last that came is the one that caches remember
      if (blocks_[k].bytes == bytes) return remove(k);
    }
    return nullptr;
  }

  /// Whether it is kept; else it is still the caller's.
  bool keep(void* memory, std::size_t bytes) noexcept {
    const std::unique_lock lock(mutex_, std::try_to_lock);
    if (!lock) return false;
    while (bytes_ + bytes > kKept || count_ == blocks_.size()) free(remove(0));
    blocks_[count_++] = {.memory = memory, .bytes = bytes};
    bytes_ += bytes;
    return true;
  }

 private:
  struct Block {
    void* memory;
    std::size_t bytes;
  };

  void* remove(std::size_t k) noexcept {
    const Block block = blocks_[k];
    std::move(blocks_.begin() + k + 1, blocks_.begin() + count_, blocks_.begin() + k);
    --count_;
    bytes_ -= block.bytes;
    return block.memory;
  }

  std::mutex mutex_;
  std::array<Block, 256> blocks_;  // in the order in which they came
  std::size_t count_ = 0;
  std::size_t bytes_ = 0;
};

Unused& unused() {
  static Unused& all = *new Unused;  // never destroyed: arrays may outlive every static object
  return all;
}

}  // namespace

void* take_recycled(std::size_t bytes) {
  if (!is_recycled(bytes)) return allocate(bytes);
  void* const memory = unused().take(rounded(bytes));
  return memory != nullptr ? memory : allocate(rounded(bytes));
}

void give_back(void* memory, std::size_t bytes) noexcept {
  if (!is_recycled(bytes) || !unused().keep(memory, rounded(bytes))) free(memory);
}

SpareRoom::~SpareRoom() { free(memory_); }

void* SpareRoom::take(std::size_t bytes) {
  if (bytes <= kLargest) return take_recycled(bytes);
  const std::size_t wanted = rounded(bytes);
  void* spare = nullptr;
  {
    const std::lock_guard lock(mutex_);
    spare = std::exchange(memory_, nullptr);
    if (std::exchange(bytes_, 0) == wanted) return spare;
  }
  free(spare);  // never both at once
  if (wanted >= kHuge) return_free_memory();
  return allocate(wanted);
}

void SpareRoom::give_back(void* memory, std::size_t bytes) noexcept {
  if (bytes <= kLargest) {
    diffcloth::give_back(memory, bytes);
    return;
  }
  {
    const std::lock_guard lock(mutex_);
    std::swap(memory_, memory);
    bytes_ = rounded(bytes);
  }
  free(memory);
}

std::size_t SpareRoom::bytes() const {
  const std::lock_guard lock(mutex_);
  return bytes_;
}

}  // namespace diffcloth
