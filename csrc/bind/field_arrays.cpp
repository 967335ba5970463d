#include "bind/field_arrays.h"

#include <algorithm>

#include "bind/numbers.h"

namespace diffcloth::bind {

Outputs::Outputs(const std::vector<step::Field>& fields,
                 const std::vector<std::size_t>& rows,
                 const std::string& prefix,
                 nb::dict& out) {
  for (const step::Field& field : fields) {
    std::vector<std::size_t> shape = rows;
    shape.insert(shape.end(), field.shape.begin(), field.shape.end());
    Owned<double> owned = make_array<double>(shape);
    out[(prefix + field.name).c_str()] = owned.array;
    entries_.push_back({.name = field.name, .data = owned.data, .size = field.size()});
  }
}

step::Arrays<double> Outputs::environment(std::size_t row) const {
  step::Arrays<double> arrays;
  for (const Entry& entry : entries_) arrays.set(entry.name, entry.data + row * entry.size);
  return arrays;
}

Saved::Saved(const std::vector<step::Field>& fields,
             std::size_t environments,
             const std::string& prefix,
             const nb::dict& from) {
  for (const step::Field& field : fields) {
    const std::string name = prefix + field.name;
    auto array = nb::cast<Doubles>(from[name.c_str()]);
    if (array.size() != environments * field.size()) {
      throw nb::value_error(("core: `" + name + "` must have " +
                             std::to_string(environments * field.size()) + " numbers, got " +
                             std::to_string(array.size()))
                                .c_str());
    }
    entries_.push_back({.name = field.name, .array = array, .size = field.size()});
  }
}

bool Saved::is_finite() const {
  return std::ranges::all_of(entries_,
                             [](const Entry& entry) { return bind::is_finite(entry.array); });
}

bool Saved::is_zero(std::size_t e) const {
  return std::ranges::all_of(entries_, [&](const Entry& entry) {
    const double* const first = entry.array.data() + e * entry.size;
    return std::all_of(first, first + entry.size, [](double value) { return value == 0.0; });
  });
}

step::Arrays<const double> Saved::environment(std::size_t e) const {
  step::Arrays<const double> arrays;
  for (const Entry& entry : entries_) arrays.set(entry.name, entry.array.data() + e * entry.size);
  return arrays;
}

}  // namespace diffcloth::bind
