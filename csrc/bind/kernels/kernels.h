#pragma once

#include <array>
#include <string>
#include <vector>

#include <nanobind/nanobind.h>

#include "contact/surface_pairs.h"
#include "linalg/kernel_level.h"

namespace diffcloth::bind {

namespace nb = nanobind;

/// Pairs of surfaces of a test's mesh that may touch; their number follows from the vertices and flags.
contact::SurfacePairs touching_surfaces(const std::vector<Index>& vertex_surface,
                                        Index cloth_count,
                                        bool self_contact,
                                        const std::vector<bool>& body_dynamic,
                                        const std::vector<std::array<Index, 2>>& ignored_pairs);

/// Level with this name, among the supported levels of this machine.
linalg::KernelLevel level_named(const std::string& name);

/// Drag of faces, for tests against its formula and differences.
void air_kernels(nb::module_& m);

/// Functions of bodies, for tests against independent references.
void body_kernels(nb::module_& m);

/// Threads, for tests of failures and interrupts.
void common_kernels(nb::module_& m);

/// Contact kernels one by one, for tests against independent references.
void contact_kernels(nb::module_& m);

/// Barrier and friction of a whole mesh, for tests of their derivatives and weights.
void contact_potentials(nb::module_& m);

/// Derivatives of contacts along several directions, for tests of bitwise equality.
void direction_kernels(nb::module_& m);

/// Sparse Cholesky factorizations, for tests against independent references and for benchmarks.
void linalg_kernels(nb::module_& m);

/// Rest shape and elastic potentials one by one, for tests against independent references.
void elastic_kernels(nb::module_& m);

/// The constant matrix of Projective Dynamics, for tests against independent references.
void projective_kernels(nb::module_& m);

}  // namespace diffcloth::bind
