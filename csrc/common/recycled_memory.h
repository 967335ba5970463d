#pragma once

#include <cstddef>
#include <memory>
#include <mutex>

namespace diffcloth {

/// Memory for large arrays, aligned to a cache line.
///
/// What is given back is kept for the next array of about its size, up to a bound for the whole
/// process: the system clears each page that it hands out, and threads, which live for one step only,
/// would ask for theirs again in every step.
void* take_recycled(std::size_t bytes);

/// @param bytes  as they were asked for
void give_back(void* memory, std::size_t bytes) noexcept;

/// Room for the next of the arrays that are too large for that, while a step goes on: the last one that
/// was given back. Its owner needed it a moment ago, so the step takes no more memory at any time.
class SpareRoom {
 public:
  SpareRoom() = default;
  ~SpareRoom();
  SpareRoom(const SpareRoom&) = delete;
  SpareRoom& operator=(const SpareRoom&) = delete;

  /// As take_recycled() and give_back(). May be called from any number of threads.
  void* take(std::size_t bytes);
  void give_back(void* memory, std::size_t bytes) noexcept;

  /// What lies there [bytes].
  std::size_t bytes() const;

 private:
  mutable std::mutex mutex_;
  void* memory_ = nullptr;  ///< guarded, as is its size
  std::size_t bytes_ = 0;
};

/// The same for containers.
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
