#pragma once

#include <cstddef>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace diffcloth::step {

/// Name and shape of an array that a step has for each environment, of doubles.
struct Field {
  std::string name;
  std::vector<std::size_t> shape;

  std::size_t size() const {
    std::size_t result = 1;
    for (const std::size_t extent : shape) result *= extent;
    return result;
  }
};

/// One environment's arrays by name. T is double or const double.
template <class T>
class Arrays {
 public:
  void set(std::string_view name, T* data) { entries_.emplace_back(name, data); }
  bool empty() const { return entries_.empty(); }

  T* operator[](std::string_view name) const {
    for (const auto& [own, data] : entries_) {
      if (own == name) return data;
    }
    throw std::out_of_range("step: no array '" + std::string(name) + "'");
  }

 private:
  std::vector<std::pair<std::string, T*>> entries_;
};

}  // namespace diffcloth::step
