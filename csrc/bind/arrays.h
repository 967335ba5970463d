#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace diffcloth::bind {

namespace nb = nanobind;

using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Integers = nb::ndarray<const std::int64_t, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<const std::int32_t, nb::c_contig, nb::device::cpu>;

/// A NumPy array that owns its memory.
template <class T>
struct Owned {
  T* data;
  nb::object array;
};

/// An array of zeros.
template <class T>
Owned<T> make_array(const std::vector<std::size_t>& shape) {
  std::size_t size = 1;
  for (const std::size_t n : shape) size *= n;
  auto memory = std::make_unique<T[]>(std::max<std::size_t>(size, 1));
  T* data = memory.get();
  nb::capsule owner(memory.release(), [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return {data, nb::cast(nb::ndarray<nb::numpy, T>(data, shape.size(), shape.data(), owner))};
}

template <class T>
std::vector<T> to_vector(const nb::ndarray<const T, nb::c_contig, nb::device::cpu>& array) {
  return {array.data(), array.data() + array.size()};
}

}  // namespace diffcloth::bind
