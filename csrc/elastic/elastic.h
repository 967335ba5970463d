#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <list>
#include <memory>
#include <mutex>
#include <vector>

#include "common/types.h"
#include "elastic/bending_batches.h"
#include "elastic/stretch_lanes.h"
#include "linalg/block_pattern.h"
#include "mesh/rest_shape.h"
#include "mesh/topology.h"
#include "potential/potential.h"

namespace diffcloth::elastic {

/// Slots of the blocks of every element in a BlockPattern.
struct Slots {
  Index block_count = 0;             ///< number of blocks in the pattern
  std::vector<Index> stretch;        ///< [F, 6] lower-triangle pairs of a face
  std::vector<Index> bending_start;  ///< [B + 1] into `bending`
  std::vector<Index> bending;        ///< lower-triangle pairs of each bending element
};

/// Vertices coupled by each element: they determine the pattern of the Hessian.
std::vector<std::vector<Index>> cliques(const mesh::Topology& topology,
                                        const mesh::BendingStencils& stencils);

Slots slots(const mesh::Topology& topology,
            const mesh::BendingStencils& stencils,
            const linalg::BlockPattern& pattern);

/// Some of the elements, ascending.
struct Elements {
  std::vector<Index> faces;
  std::vector<Index> bending;
};

/// Elements with a marked corner.
///
/// @param marked  [points], beginning with the topology's vertices
Elements elements_at(const mesh::Topology& topology,
                     const mesh::BendingStencils& stencils,
                     const std::vector<char>& marked);

/// Results of prepare() for a Model: constant during one step.
struct Prepared {
  std::vector<double> bending;        ///< [B] weight of an element, see bending.h
  std::vector<Mat3> form;             ///< [B]
  std::vector<double> damping;        ///< [B] k_d / h [-]
  std::vector<std::uint8_t> flat;     ///< [B] no rest curvature and no damping: a constant Hessian
  std::vector<Mat3> curvature_n;      ///< [B] bending::start_curvature(), zero if not damped
  std::vector<double> constant;       ///< [slots] sum of the flat elements' Hessians, times I
  std::vector<double> identity;       ///< [slots] sum of all elements' multiples of I
  std::vector<StretchBatch> stretch;  ///< batches of isotropic faces
  std::vector<WovenBatch> woven;      ///< batches of all other faces
  std::vector<DampingBatch> damping_of_stretch;  ///< batches of damped faces
  std::vector<Index> damped;                     ///< damped faces, ascending
  BendingBatches bent;                           ///< elements that are not flat
  bool has_damping = false;                      ///< true if some face is damped
  bool by_matrix = true;  ///< energy and gradient of flat elements are computed by their matrix
};

/// The elastic energy of all cloths and its damping over one step.
struct Model {
  const mesh::Topology* topology = nullptr;
  const mesh::BendingStencils* stencils = nullptr;
  const mesh::RestShape* rest = nullptr;
  std::vector<double> stretch;  ///< [F] k_s [N/m]; of the warp in woven faces
  std::vector<double> bending;  ///< [F] D [N m]; likewise
  std::vector<double> poisson;  ///< [F] nu [-]
  std::vector<double> damping;  ///< [F] k_d [s]
  // [F] each; all four kinds empty: every face is isotropic.
  std::vector<double> stretch_weft;         ///< k_f [N/m]
  std::vector<double> stretch_shear;        ///< k_wf [N/m]
  std::vector<double> bending_weft;         ///< D_f [N m]
  std::vector<double> bending_twill;        ///< D_t [N m]
  const std::vector<Vec2>* axes = nullptr;  ///< [F] the warp in the rest frames
  double h = 0.0;                           ///< time step [s]; only damping needs it
  const double* x_n = nullptr;              ///< [N, 3] start of the step [m]; only damping needs it
  const double* ahead = nullptr;            ///< [N, 3] prediction of its end, if any: see damping.h
  double least_inertia = 0.0;               ///< smallest M / h^2 of a vertex [N/m]
  const Elements* held = nullptr;  ///< elements with a prescribed corner; only for backward
  std::shared_ptr<const Prepared> prepared;  ///< result of prepare()
};

/// Compute model.prepared. Must be called after every change of the model.
///
/// @throws std::invalid_argument if damping has no start of the step or no time step
void prepare(Model& model, const Slots& slots);

/// Cache of prepare() for models of one rest shape. Inputs often repeat: the backward pass of a step has
/// the inputs of the step, a step has the inputs of the previous one, except for the start of the step,
/// on which damping depends.
class PreparedCache {
 public:
  PreparedCache() = default;
  PreparedCache(const PreparedCache&) = delete;
  PreparedCache& operator=(const PreparedCache&) = delete;

  void prepare(Model& model, const Slots& slots);

 private:
  static constexpr std::size_t kFields = 8;  ///< fields of a model with one number per face
  static constexpr std::size_t kCapacity = std::size_t{8} << 20;  ///< [bytes]

  struct Entry {
    std::array<std::vector<double>, kFields> fields;
    double least_inertia;
    double h;                   ///< time step of a model with damping, else zero
    std::vector<double> start;  ///< x_n and the prediction of a model with damping, else empty
    std::shared_ptr<const Prepared> prepared;
    std::size_t bytes;
  };

  std::mutex mutex_;
  std::list<Entry> entries_;  // most recent first
  std::size_t bytes_ = 0;
};

/// Energy of the membranes, without damping [J].
double stretch_energy(const Model& model, const double* x);

/// Energy of bending, without damping [J].
double bending_energy(const Model& model, const double* x);

/// Sum of both [J].
inline double energy(const Model& model, const double* x) {
  return stretch_energy(model, x) + bending_energy(model, x);
}

/// States of the batches of elements that are not flat, at one point.
using BendingStates = std::vector<BendingState>;

/// States at x.
BendingStates bending_states(const Model& model, const double* x);

// The functions below leave out the flat elements of bending if `prepared.by_matrix`: the energy of
// these elements is the quadratic form of their matrix. See ConstantForm::of_flat_bending().

/// Energy at x1 minus energy at x0, damping included, as a sum of differences of the elements that
/// do not cancel [J].
///
/// @param dx     x1 - x0
/// @param start  states at x0
/// @param end    set to the states at x1
/// @param g1     += grad E(x1), with the bits of add_gradient()
double energy_change(const Model& model,
                     const double* x0,
                     const double* x1,
                     const double* dx,
                     const BendingStates& start,
                     BendingStates& end,
                     double* g1);

/// g += grad E(x), damping included, [N, 3] [N].
///
/// @param at  states at x
void add_gradient(const Model& model, const double* x, const BendingStates& at, double* g);

/// blocks += the Hessian at x, damping and flat elements included [N/m].
///
/// @param at     states at x
/// @param place  [slots] index of each slot in blocks, 9 doubles each
void add_hessian(const Model& model,
                 const Slots& slots,
                 const double* x,
                 const BendingStates& at,
                 Curvature curvature,
                 const std::vector<Index>& place,
                 double* blocks);

/// Second stress of each face after a straight motion from x, in the linear model of that motion,
/// without the contribution of damping.
std::vector<Mat2> extrapolated_stresses(const Model& model, const double* x, const double* to);

/// blocks += the Hessian at x with these second stresses minus the Hessian with the actual ones.
void add_extrapolation(const Model& model,
                       const Slots& slots,
                       const double* x,
                       const std::vector<Mat2>& stresses,
                       Curvature curvature,
                       const std::vector<Index>& place,
                       double* blocks);

/// y += H(x) z over all vertices, with the exact Hessian and without a matrix.
void add_hessian_product(const Model& model, const double* x, const double* z, double* y);

/// Likewise, for some elements alone.
void add_hessian_product(
    const Model& model, const Elements& elements, const double* x, const double* z, double* y);

/// Cotangents of the inputs of a Model.
struct Bar {
  std::vector<double> stretch, bending, poisson, damping;                        ///< [F]
  std::vector<double> stretch_weft, stretch_shear, bending_weft, bending_twill;  ///< [F]
  mesh::RestShapeBar rest;
  std::vector<double> x_n, ahead;  ///< [3 N] through damping

  Bar() = default;
  /// All zero.
  Bar(const mesh::Topology& topology, const mesh::BendingStencils& stencils);
};

/// bar += d/d theta (z . grad_x E(x; theta)) for each theta of the model, damping included.
///
/// The cotangents of damping and of x_n are left out if model.x_n is null; k_d has a cotangent also if
/// it is zero.
///
/// @param with_rest  true to compute the cotangents of the rest shape
void add_mixed(const Model& model, const double* x, const double* z, bool with_rest, Bar& bar);

/// Groups of a model's inputs with nonzero tangents.
struct Changing {
  bool materials = false;
  bool rest = false;
  bool start = false;  ///< x_n, and the prediction if the model has one
};

/// y += d/d theta (grad_x E(x; theta)) theta_dot over all vertices, damping included: add_mixed(),
/// transposed.
///
/// @param dot  tangents, in the layout of the cotangents; read for the groups in `changing`
void add_tangent(
    const Model& model, const double* x, const Bar& dot, const Changing& changing, double* y);

/// A number for each part of the energy.
struct Energies {
  double stretch;
  double bending;
};

/// bar += d/d theta of  seed.stretch stretch_energy() + seed.bending bending_energy()  for each theta of
/// the model, and x_bar += its derivative by x [N, 3]: all elements, no damping.
void add_energy_bars(const Model& model,
                     const double* x,
                     const Energies& seed,
                     bool with_rest,
                     Bar& bar,
                     double* x_bar);

}  // namespace diffcloth::elastic
