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
#ifdef __linux__
#include <sys/mman.h>
#endif

namespace diffcloth {

namespace {

constexpr std::size_t kLine = 64;

/// Arrays of some huge pages begin with one: they take a five hundredth of the page faults, and of the
/// processor's tables of pages [bytes].
constexpr std::size_t kHugePage = std::size_t{1} << 21;
constexpr std::size_t kWorthHugePages = 2 * kHugePage;

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
  const std::size_t step = std::max(std::bit_floor(bytes) / 8, kLine);
  return (bytes + step - 1) / step * step;
}

std::align_val_t alignment(std::size_t bytes) {
  return std::align_val_t{bytes < kWorthHugePages ? kLine : kHugePage};
}

void* allocate(std::size_t bytes) {
  void* const memory = ::operator new(bytes, alignment(bytes));
#ifdef MADV_HUGEPAGE
  // Where the system has none it stays as it is.
  if (bytes >= kWorthHugePages) madvise(memory, bytes / kHugePage * kHugePage, MADV_HUGEPAGE);
#endif
  return memory;
}

void free(void* memory, std::size_t bytes) noexcept { ::operator delete(memory, alignment(bytes)); }

/// Memory that nobody uses. Who finds it locked goes to the system instead: that is no dearer than to
/// wait, and in a forked process the lock may belong to a thread that is not there.
class Unused {
 public:
  void* take(std::size_t bytes) {
    const std::unique_lock lock(mutex_, std::try_to_lock);
    if (!lock) return nullptr;
    for (std::size_t k = count_; k-- > 0;) {  // the last that came is the one that caches remember
      if (blocks_[k].bytes == bytes) return remove(k).memory;
    }
    return nullptr;
  }

  /// Whether it is kept; else it is still the caller's.
  bool keep(void* memory, std::size_t bytes) noexcept {
    const std::unique_lock lock(mutex_, std::try_to_lock);
    if (!lock) return false;
    while (bytes_ + bytes > kKept || count_ == blocks_.size()) {
      const Block oldest = remove(0);
      free(oldest.memory, oldest.bytes);
    }
    blocks_[count_++] = {.memory = memory, .bytes = bytes};
    bytes_ += bytes;
    return true;
  }

 private:
  struct Block {
    void* memory;
    std::size_t bytes;
  };

  Block remove(std::size_t k) noexcept {
    const Block block = blocks_[k];
    std::move(blocks_.begin() + k + 1, blocks_.begin() + count_, blocks_.begin() + k);
    --count_;
    bytes_ -= block.bytes;
    return block;
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
  const std::size_t size = rounded(bytes);
  void* const memory = is_recycled(bytes) ? unused().take(size) : nullptr;
  return memory != nullptr ? memory : allocate(size);
}

void give_back(void* memory, std::size_t bytes) noexcept {
  const std::size_t size = rounded(bytes);
  if (!is_recycled(bytes) || !unused().keep(memory, size)) free(memory, size);
}

SpareRoom::~SpareRoom() { free(memory_, bytes_); }

void* SpareRoom::take(std::size_t bytes) {
  if (bytes <= kLargest) return take_recycled(bytes);
  const std::size_t wanted = rounded(bytes);
  void* spare = nullptr;
  std::size_t size = 0;
  {
    const std::lock_guard lock(mutex_);
    spare = std::exchange(memory_, nullptr);
    size = std::exchange(bytes_, 0);
  }
  if (size == wanted) return spare;
  free(spare, size);  // never both at once
  if (wanted >= kHuge) return_free_memory();
  return allocate(wanted);
}

void SpareRoom::give_back(void* memory, std::size_t bytes) noexcept {
  if (bytes <= kLargest) {
    diffcloth::give_back(memory, bytes);
    return;
  }
  std::size_t size = rounded(bytes);
  {
    const std::lock_guard lock(mutex_);
    std::swap(memory_, memory);
    std::swap(bytes_, size);
  }
  free(memory, size);
}

std::size_t SpareRoom::bytes() const {
  const std::lock_guard lock(mutex_);
  return bytes_;
}

}  // namespace diffcloth
