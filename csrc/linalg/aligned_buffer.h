#pragma once

#include <cstddef>
#include <memory>

#include "common/recycled_memory.h"

namespace diffcloth::linalg {

/// Uninitialized numbers, aligned to a cache line.
template <class T>
class AlignedBuffer {
 public:
  AlignedBuffer() = default;
  explicit AlignedBuffer(std::size_t size)
      : data_(size == 0 ? nullptr : static_cast<T*>(take_recycled(size * sizeof(T))), {size, {}}) {}

  /// Allocate from the room of a step, in which large buffers reuse memory that was freed in the same
  /// step.
  AlignedBuffer(std::size_t size, const std::shared_ptr<SpareRoom>& room)
      : data_(size == 0 ? nullptr : static_cast<T*>(room->take(size * sizeof(T))), {size, room}) {}

  T* data() { return data_.get(); }
  const T* data() const { return data_.get(); }
  std::size_t size() const { return data_.get_deleter().size; }
  std::size_t bytes() const { return size() * sizeof(T); }

 private:
  struct GiveBack {
    std::size_t size;
    std::weak_ptr<SpareRoom> room;  // of a step, which may have ended
    void operator()(T* p) const {
      if (const std::shared_ptr<SpareRoom> open = room.lock()) {
        open->give_back(p, size * sizeof(T));
      } else {
        give_back(p, size * sizeof(T));
      }
    }
  };

  std::unique_ptr<T, GiveBack> data_{nullptr, {0, {}}};
};

}  // namespace diffcloth::linalg
