#pragma once

#include <cstddef>
#include <memory>
#include <mutex>

namespace diffcloth {

/// Memory for large arrays, aligned to a cache line.
///
/// Released memory is kept for later arrays of about the same size, up to a bound for the whole process.
/// Otherwise the system would clear each new page, and threads, which live for one step only, would
/// request their pages again in every step.
void* take_recycled(std::size_t bytes);

/// @param bytes  the size passed to take_recycled()
void give_back(void* memory, std::size_t bytes) noexcept;

/// Room for one array beyond the sizes of take_recycled(), during a step: keeps the last one returned.
/// Its owner has just used it, so the peak memory of the step does not increase.
class SpareRoom {
 public:
  SpareRoom() = default;
  ~SpareRoom();
  SpareRoom(const SpareRoom&) = delete;
  SpareRoom& operator=(const SpareRoom&) = delete;

  /// Same as take_recycled() and give_back(); thread-safe.
  void* take(std::size_t bytes);
  void give_back(void* memory, std::size_t bytes) noexcept;

  /// Size of the kept array [bytes].
  std::size_t bytes() const;

 private:
  mutable std::mutex mutex_;
  void* memory_ = nullptr;  ///< guarded by mutex_, as is bytes_
  std::size_t bytes_ = 0;
};

/// Allocator of recycled memory for containers.
template <typename T>
struct RecyclingAllocator {
  using value_type = T;

  RecyclingAllocator() = default;
  template <typename U>
  explicit RecyclingAllocator(const RecyclingAllocator<U>& /*other*/) {}

  T* allocate(std::size_t count) { return static_cast<T*>(take_recycled(count * sizeof(T))); }
  void deallocate(T* memory, std::size_t count) noexcept { give_back(memory, count * sizeof(T)); }

  friend bool operator==(const RecyclingAllocator&, const RecyclingAllocator&) { return true; }
};

}  // namespace diffcloth
