#include "contact/direction_lanes.h"

namespace diffcloth::contact {

extern const DirectionLevel kPortableDirectionLanes;
#ifdef DIFFCLOTH_X86_KERNELS
extern const DirectionLevel kAvx2DirectionLanes;
extern const DirectionLevel kAvx512DirectionLanes;
#endif

const DirectionLevel& direction_kernels(linalg::KernelLevel level) {
  linalg::check_supported(level);
#ifdef DIFFCLOTH_X86_KERNELS
  if (level == linalg::KernelLevel::kAvx512) return kAvx512DirectionLanes;
  if (level == linalg::KernelLevel::kAvx2) return kAvx2DirectionLanes;
#endif
  return kPortableDirectionLanes;
}

void DirectionRows::read(std::span<const double* const> vectors) {
  const std::size_t size = rows_.size() / lanes_;
  for (std::size_t i = 0; i < size; ++i) {
    for (std::size_t l = 0; l < vectors.size(); ++l) rows_[lanes_ * i + l] = vectors[l][i];
  }
}

void DirectionRows::read(std::span<double* const> vectors) {
  const std::vector<const double*> from(vectors.begin(), vectors.end());
  read(std::span<const double* const>(from));
}

void DirectionRows::write(std::span<double* const> vectors) const {
  const std::size_t size = rows_.size() / lanes_;
  for (std::size_t i = 0; i < size; ++i) {
    for (std::size_t l = 0; l < vectors.size(); ++l) vectors[l][i] = rows_[lanes_ * i + l];
  }
}

}  // namespace diffcloth::contact
