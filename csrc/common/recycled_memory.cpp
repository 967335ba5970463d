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

/// Size of a huge page [bytes]. Arrays of several huge pages are aligned to one: this reduces page
/// faults, and the size of the page tables, by a factor of five hundred.
constexpr std::size_t kHugePage = std::size_t{1} << 21;
constexpr std::size_t kWorthHugePages = 2 * kHugePage;

/// Bounds of recycled sizes [bytes]: smaller arrays are as fast from the allocator, larger ones too
/// expensive to keep.
constexpr std::size_t kSmallest = std::size_t{1} << 16;
#ifdef __SANITIZE_ADDRESS__
constexpr std::size_t kLargest = 0;  // the sanitizer must see each of them freed
#else
constexpr std::size_t kLargest = std::size_t{1} << 24;
#endif

/// Bound of the total kept memory [bytes].
constexpr std::size_t kKept = std::size_t{1} << 25;

/// Size from which it is worthwhile to return free memory to the system before an allocation [bytes].
constexpr std::size_t kHuge = std::size_t{1} << 27;

/// Return free memory to the system that the C library would keep: small arrays, and arrays of some
/// megabytes.
void return_free_memory() {
#ifdef __GLIBC__
  malloc_trim(0);
#endif
}

bool is_recycled(std::size_t bytes) { return bytes >= kSmallest && bytes <= kLargest; }

/// Size rounded up by at most an eighth: contact changes the sizes of matrices slightly, and the memory
/// of one should fit the next.
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
  // The call is a hint: it fails without effect if the system has no huge pages.
  if (bytes >= kWorthHugePages) madvise(memory, bytes / kHugePage * kHugePage, MADV_HUGEPAGE);
#endif
  return memory;
}

void free(void* memory, std::size_t bytes) noexcept { ::operator delete(memory, alignment(bytes)); }

/// Pool of unused memory. A caller that finds it locked uses the system allocator: that costs no more
/// than to wait, and in a forked process the lock may be held by a thread that does not exist.
class Unused {
 public:
  void* take(std::size_t bytes) {
    const std::unique_lock lock(mutex_, std::try_to_lock);
    if (!lock) return nullptr;
    for (std::size_t k = count_; k-- > 0;) {  // the latest is the likeliest to be cached
      if (blocks_[k].bytes == bytes) return remove(k).memory;
    }
    return nullptr;
  }

  /// True if the memory was kept; otherwise the caller still owns it.
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
  std::array<Block, 256> blocks_;  // in the order of their return
  std::size_t count_ = 0;
  std::size_t bytes_ = 0;
};

Unused& unused() {
  static Unused& all = *new Unused;  // never destroyed: arrays may outlive static objects
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
  free(spare, size);  // free the old array first, to limit the peak
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
