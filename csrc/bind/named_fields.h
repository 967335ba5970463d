#pragma once

#include <set>
#include <string>
#include <utility>
#include <vector>

#include "bind/arrays.h"
#include "common/types.h"

namespace diffcloth::bind {

/// Fields of a description by name; every field must be consumed.
class NamedFields {
 public:
  explicit NamedFields(nb::kwargs fields) : fields_(std::move(fields)) {}

  bool has(const char* name) const { return fields_.contains(name); }

  /// @throws nb::value_error if it is missing, nb::type_error if it cannot be converted to T
  template <class T>
  T take(const char* name) {
    if (!has(name)) throw nb::value_error(("core: `" + std::string(name) + "` is missing").c_str());
    T value;
    const nb::object field = fields_[name];
    if (!nb::try_cast(field, value)) {
      throw nb::type_error(
          ("core: `" + std::string(name) + "` is of a type that is not accepted").c_str());
    }
    taken_.insert(name);
    return value;
  }
  std::vector<double> doubles(const char* name) { return to_vector(take<Doubles>(name)); }
  std::vector<Index> indices(const char* name) { return to_vector(take<Indices>(name)); }

  /// @throws nb::value_error that names a field that was not consumed
  void refuse_others() const;

 private:
  nb::kwargs fields_;
  std::set<std::string> taken_;
};

}  // namespace diffcloth::bind
