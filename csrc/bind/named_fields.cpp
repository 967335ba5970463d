#include "bind/named_fields.h"

#include <nanobind/stl/string.h>

namespace diffcloth::bind {

void NamedFields::refuse_others() const {
  for (const auto [name, value] : fields_) {
    const auto text = nb::cast<std::string>(name);
    if (!taken_.contains(text)) {
      throw nb::value_error(("core: `" + text + "` is not known, or not needed here").c_str());
    }
  }
}

}  // namespace diffcloth::bind
