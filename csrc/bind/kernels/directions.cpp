#include <array>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "bind/kernels/kernels.h"
#include "common/fixed_noise.h"
#include "contact/direction_kernels.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;

constexpr std::size_t kPoints = 9;
constexpr std::size_t kLanes = contact::kDirectionLanes;

using Rows = std::vector<double>;

/// Contacts made of noise, because only the arithmetic matters.
struct Noise {
  FixedNoise next;

  template <std::size_t Count>
  std::array<double, Count> numbers() {
    std::array<double, Count> result;
    for (double& value : result) value = next();
    return result;
  }

  template <class Field>
  void fill(Field& field) {
    auto* const first = reinterpret_cast<double*>(&field);
    for (std::size_t k = 0; k < sizeof(Field) / sizeof(double); ++k) first[k] = next();
  }

  contact::FrictionTangent tangent(bool turns, bool slides) {
    contact::FrictionTangent of{};
    fill(of.beta);
    fill(of.c_beta);
    fill(of.t_beta);
    fill(of.r_beta);
    fill(of.r_start_beta);
    fill(of.n);
    fill(of.inv_d);
    fill(of.extension);
    fill(of.extension_by_t);
    fill(of.extension_by_n);
    fill(of.extension_by_r);
    for (contact::FrameTangent& part : of.part) {
      fill(part.share);
      fill(part.a);
      fill(part.b);
      fill(part.extension_by_lag);
      fill(part.extension_by_start);
      fill(part.e1_start);
      fill(part.e2_start);
      fill(part.e1_lag);
      fill(part.e2_lag);
      fill(part.to_lag);
      fill(part.turn);
      fill(part.e1);
      fill(part.e2);
      fill(part.m);
      fill(part.e2_force);
      fill(part.force_e1);
    }
    fill(of.s);
    fill(of.w);
    fill(of.n_s);
    fill(of.by_corners);
    fill(of.by_w);
    fill(of.stiffness);
    fill(of.force);
    of.part_count = 2;
    of.part[0].turns = turns;
    of.part[1].turns = true;
    of.slides = slides;
    return of;
  }
};

/// Add the products of all kernels of one group of lanes to y, for interleaved directions [lanes,
/// kPoints, 3].
void apply(const contact::DirectionKernels& kernels,
           const Rows& z,
           const Rows& lag,
           const Rows& start,
           const double* by_parameters,
           Rows& y) {
  constexpr std::array<std::int32_t, 7> kPoint{4, 2, 7, 0, 3, 8, 1};
  constexpr std::array<std::array<int, 4>, 2> kEdge{{{4, 5, 4, 6}, {1, 2, 1, 3}}};
  Noise noise;
  auto c = noise.numbers<7>();
  c[1] = 0.0;
  const auto left = noise.numbers<36>();
  const auto right = noise.numbers<36>();
  const auto rest = noise.numbers<144>();
  const auto B = noise.numbers<54>();
  const auto core = noise.numbers<9>();
  const auto turn = noise.numbers<6>();
  for (const double* const dense : {static_cast<const double*>(nullptr), rest.data()}) {
    kernels.contact_product({.point = {kPoint[0], kPoint[1], kPoint[2], kPoint[3]},
                             .count = 3,
                             .left = {left.data(), left.data() + 12, left.data() + 24},
                             .right = {right.data(), right.data() + 12, right.data() + 24},
                             .c = c.data(),
                             .along = noise.next(),
                             .rest = dense},
                            z.data(), y.data());
  }
  kernels.friction_product(
      {.point = kPoint.data(),
       .c = c.data(),
       .frame = 1,
       .count = 7,
       .B = {B.data(), B.data() + 9, B.data() + 18, B.data() + 27, B.data() + 36, B.data() + 45},
       .core = core.data(),
       .part_count = 2,
       .edge = {kEdge[0].data(), kEdge[1].data()},
       .turn = {turn.data(), turn.data() + 3}},
      z.data(), y.data());
  for (const bool turns : {false, true}) {
    for (const bool slides : {false, true}) {
      contact::FrictionTangent of = noise.tangent(turns, slides);
      of.corner = kPoint.data();
      of.corner_c = c.data();
      of.point = kPoint.data();
      of.c = c.data();
      for (std::size_t l = 0; l < 2; ++l) of.part[l].edge = kEdge[l].data();
      of.count = 7;
      kernels.friction_tangent(of, lag.data(), start.data(), by_parameters, y.data());
    }
  }
}

/// Result of the kernels of a level for eight directions, [9, 3, 8]: side by side, or each alone.
nb::ndarray<nb::numpy, double> directions(const std::string& level, bool alone) {
  const contact::DirectionLevel& kernels = contact::direction_kernels(level_named(level));
  Noise noise;
  std::array<Rows, 4> rows;  // z, lag, start, y
  for (Rows& of : rows) {
    of.resize(3 * kPoints * kLanes);
    for (double& value : of) value = noise.next();
  }
  const auto by_parameters = noise.numbers<kLanes>();
  if (alone) {
    for (std::size_t l = 0; l < kLanes; ++l) {
      std::array<Rows, 4> own;
      for (std::size_t k = 0; k < own.size(); ++k) {
        for (std::size_t i = l; i < rows[k].size(); i += kLanes) own[k].push_back(rows[k][i]);
      }
      apply(kernels.one, own[0], own[1], own[2], &by_parameters[l], own[3]);
      for (std::size_t i = 0; i < own[3].size(); ++i) rows[3][kLanes * i + l] = own[3][i];
    }
  } else {
    apply(kernels.many, rows[0], rows[1], rows[2], by_parameters.data(), rows[3]);
  }
  auto* const result = new Rows(rows[3]);
  const nb::capsule owner(result, [](void* p) noexcept { delete static_cast<Rows*>(p); });
  return {result->data(), {kPoints, 3, kLanes}, owner};
}

}  // namespace

void direction_kernels(nb::module_& m) {
  m.def("directions", &directions, "level"_a, "alone"_a,
        "Derivatives of contacts made of noise, along eight directions.");
}

}  // namespace diffcloth::bind
