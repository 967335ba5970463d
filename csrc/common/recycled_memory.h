#pragma once

#include <cstddef>

namespace diffcloth {

/// Memory for large arrays, aligned to a cache line.
///
/// What is given back is kept for the next array of about its size, up to a bound for the whole
/// process: the system clears each page that it hands out, and threads, which live for one step only,
/// would ask for theirs again in every step.
void* take_recycled(std::size_t bytes);

/// @param bytes  as they were asked for
void give_back(void* memory, std::size_t bytes) noexcept;

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
