#pragma once

#include "common/types.h"

namespace diffcloth {

/// A += u w^T, column by column: for a whole product the compiler creates a copy, which costs more than
/// the product.
template <class U, class W>
inline void add_outer_product(const U& u, const W& w, Mat3& A) {
  for (int k = 0; k < 3; ++k) A.col(k) += w[k] * u;
}

}  // namespace diffcloth
