#include "elastic/elastic.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <numeric>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include "bind/kernels/kernels.h"
#include "bind/kernels/potential.h"
#include "elastic/constant_form.h"
#include "elastic/elastic_potential.h"
#include "elastic/elements.h"
#include "elastic/face_batches.h"
#include "linalg/block_pattern.h"
#include "mesh/rest_shape.h"
#include "mesh/topology.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;

using Positions = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Faces = nb::ndarray<const std::int32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<const std::int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Values = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Array = nb::ndarray<nb::numpy, double>;
using IndexArray = nb::ndarray<nb::numpy, std::int32_t>;

/// A numpy array that owns a copy of the values.
template <class Scalar>
nb::ndarray<nb::numpy, Scalar> owned(const Scalar* values,
                                     std::initializer_list<std::size_t> shape) {
  using Buffer = std::vector<Scalar>;
  std::size_t size = 1;
  for (const std::size_t extent : shape) size *= extent;
  auto buffer = std::make_unique<Buffer>(values, values + size);
  Scalar* data = buffer->data();
  const nb::capsule owner(buffer.get(), [](void* p) noexcept {
    std::unique_ptr<Buffer>(static_cast<Buffer*>(p)).reset();
  });
  buffer.release();  // the capsule owns it now
  return nb::ndarray<nb::numpy, Scalar>(data, shape, owner);
}

/// 0, 1, 2 ..
std::vector<Index> counting(std::size_t count) {
  std::vector<Index> numbers(count);
  std::iota(numbers.begin(), numbers.end(), 0);
  return numbers;
}

Array vector_array(const std::vector<double>& values) {
  return owned(values.data(), {values.size()});
}

Array rows_array(const std::vector<double>& values) {
  return owned(values.data(), {values.size() / 3, 3});
}

void check_rows(const char* name, std::size_t rows, std::size_t expected) {
  if (rows != expected) {
    throw std::invalid_argument("elastic: `" + std::string(name) + "` must have " +
                                std::to_string(expected) + " rows, got " + std::to_string(rows));
  }
}

std::vector<std::array<Index, 3>> face_list(const Faces& faces) {
  std::vector<std::array<Index, 3>> result(faces.shape(0));
  for (std::size_t f = 0; f < result.size(); ++f) {
    result[f] = {faces(f, 0), faces(f, 1), faces(f, 2)};
  }
  return result;
}

std::vector<mesh::BendingModel> model_list(const std::string& name, std::size_t faces) {
  if (name == "patch") return std::vector(faces, mesh::BendingModel::kPatch);
  if (name == "hinge") return std::vector(faces, mesh::BendingModel::kHinge);
  throw std::invalid_argument("elastic: `bending_model` must be 'patch' or 'hinge', got '" + name +
                              "'");
}

/// A rest mesh with its stencils and one elastic model on it, with all inputs that a test varies.
class Elastic {
 public:
  /// @param rest_faces  the faces in the mesh of X; if absent, `faces`
  Elastic(const Positions& X,
          const Faces& faces,
          const std::string& bending_model,
          const std::optional<Faces>& rest_faces)
      : X_(X.data(), X.data() + X.size()),
        topology_(vertex_count(X, faces, rest_faces),
                  face_list(faces),
                  static_cast<Index>(X.shape(0)),
                  face_list(rest_faces ? *rest_faces : faces)),
        stencils_(
            mesh::choose_stencils(topology_, X_.data(), model_list(bending_model, faces.shape(0)))),
        pattern_(topology_.vertex_count, elastic::cliques(topology_, stencils_)),
        slots_(elastic::slots(topology_, stencils_, pattern_)) {
    model_.topology = &topology_;
    model_.stencils = &stencils_;
    model_.rest = &rest_;
    set_rest(X);
  }
  Elastic(const Elastic&) = delete;
  Elastic& operator=(const Elastic&) = delete;

  /// Move the rest positions; the stencils stay.
  void set_rest(const Positions& X) {
    check_rows("X", X.shape(0), topology_.rest_vertex_count);
    std::copy(X.data(), X.data() + X.size(), X_.begin());
    rest_ = mesh::rest_shape(topology_, stencils_, X_.data());
  }

  void set_parameters(const Values& stretch,
                      const Values& bending,
                      const Values& poisson,
                      const Values& damping,
                      double h,
                      const std::optional<Positions>& x_n) {
    const auto fill = [this](const char* name, const Values& values) {
      check_rows(name, values.shape(0), topology_.faces.size());
      return std::vector<double>(values.data(), values.data() + values.size());
    };
    model_.stretch = fill("stretch", stretch);
    model_.bending = fill("bending", bending);
    model_.poisson = fill("poisson", poisson);
    model_.damping = fill("damping", damping);
    model_.h = h;
    model_.x_n = nullptr;
    if (x_n) {
      x_n_ = positions("x_n", *x_n);
      model_.x_n = x_n_.data();
    }
    model_.least_inertia =
        std::numeric_limits<double>::infinity();  // flat elements by their matrix
    elastic::prepare(model_, slots_);
  }

  /// Make the faces woven, or isotropic again if `axes` is empty. Call this before set_parameters(),
  /// which sets the stiffnesses of the warp.
  ///
  /// @param axes     [2 F] unit vectors of the warp in the rest frames
  /// @param woven    [4 F] k_f, k_s, D_f and D_t, one after the other
  void set_weave(const Values& axes, const Values& woven) {
    const std::size_t faces = topology_.faces.size();
    const bool is_woven = axes.shape(0) > 0;
    check_rows("axes", axes.shape(0), is_woven ? 2 * faces : 0);
    check_rows("woven", woven.shape(0), is_woven ? 4 * faces : 0);
    axes_.clear();
    for (std::size_t f = 0; 2 * f < axes.shape(0); ++f)
      axes_.emplace_back(axes(2 * f), axes(2 * f + 1));
    const std::array fields{&model_.stretch_weft, &model_.stretch_shear, &model_.bending_weft,
                            &model_.bending_twill};
    for (std::size_t k = 0; k < fields.size(); ++k) {
      const double* const first = woven.data() + k * faces;
      if (is_woven) {
        fields[k]->assign(first, first + faces);
      } else {
        fields[k]->clear();
      }
    }
    model_.axes = &axes_;
  }

  Array hessian_blocks(const Positions& x, bool positive) const {
    std::vector<double> blocks(9 * static_cast<std::size_t>(pattern_.block_count()), 0.0);
    const auto curvature = positive ? Curvature::kPositive : Curvature::kExact;
    const std::vector<double> at = positions("x", x);
    elastic::add_hessian(model_, slots_, at.data(), elastic::bending_states(model_, at.data()),
                         curvature, own_places(), blocks.data());
    return owned(blocks.data(), {blocks.size() / 9, 9});
  }

  /// Stretch and its damping by the kernels of a level: change of the energy, gradient and blocks of the
  /// Hessian.
  nb::tuple stretch(const std::string& level,
                    const Positions& x0,
                    const Positions& x1,
                    bool positive) const {
    const elastic::StretchKernels& kernels = elastic::stretch_kernels(level_named(level));
    const std::vector<elastic::StretchBatch>& batches = model_.prepared->stretch;
    const std::vector<double> from = positions("x0", x0);
    const std::vector<double> to = positions("x1", x1);
    std::vector<double> g(from.size(), 0.0);
    std::vector<double> blocks(9 * static_cast<std::size_t>(pattern_.block_count()), 0.0);
    kernels.add_gradient(batches.data(), batches.size(), from.data(), g.data());
    kernels.add_hessian(batches.data(), batches.size(), from.data(), positive, own_places().data(),
                        blocks.data());
    double change =
        kernels.energy_change(batches.data(), batches.size(), from.data(), to.data(), nullptr);
    const std::vector<elastic::WovenBatch>& woven = model_.prepared->woven;
    kernels.add_woven_gradient(woven.data(), woven.size(), from.data(), g.data());
    kernels.add_woven_hessian(woven.data(), woven.size(), from.data(), positive,
                              own_places().data(), blocks.data());
    change += kernels.woven_energy_change(woven.data(), woven.size(), from.data(), to.data());
    const std::vector<elastic::DampingBatch>& damped = model_.prepared->damping_of_stretch;
    kernels.add_damping_gradient(damped.data(), damped.size(), from.data(), g.data());
    kernels.add_damping_hessian(damped.data(), damped.size(), from.data(), positive,
                                own_places().data(), blocks.data());
    change += kernels.damping_energy_change(damped.data(), damped.size(), from.data(), to.data(),
                                            nullptr);
    return nb::make_tuple(change, rows_array(g), owned(blocks.data(), {blocks.size() / 9, 9}));
  }

  /// Same for the resistance to chords, with all faces and their stretch stiffness.
  nb::tuple chords(const std::string& level,
                   const Positions& x0,
                   const Positions& x1,
                   const Positions& shift,
                   const Positions& center) const {
    const elastic::StretchKernels& kernels = elastic::stretch_kernels(level_named(level));
    const std::vector<double> from = positions("x0", x0);
    const std::vector<double> to = positions("x1", x1);
    std::vector<double> weight(model_.rest->area);
    for (Index f = 0; f < elastic::face_count(model_); ++f) weight[f] *= model_.stretch[f];
    const std::vector<elastic::ChordBatch> batches =
        elastic::chord_batches(model_, slots_, positions("shift", shift).data(),
                               positions("center", center).data(), weight);
    std::vector<double> g(from.size(), 0.0);
    std::vector<double> blocks(9 * static_cast<std::size_t>(pattern_.block_count()), 0.0);
    kernels.add_chord_gradient(batches.data(), batches.size(), from.data(), g.data());
    kernels.add_chord_hessian(batches.data(), batches.size(), from.data(), own_places().data(),
                              blocks.data());
    const double change =
        kernels.chord_energy_change(batches.data(), batches.size(), from.data(), to.data());
    return nb::make_tuple(change, rows_array(g), owned(blocks.data(), {blocks.size() / 9, 9}),
                          kernels.chord_energy(batches.data(), batches.size(), from.data()));
  }

  /// Same for bending that is not flat; the Hessian's blocks exclude their multiples of the identity.
  nb::tuple bending(const std::string& level,
                    const Positions& x0,
                    const Positions& x1,
                    bool positive) const {
    const elastic::BendingKernels& kernels = elastic::bending_kernels(level_named(level));
    const std::vector<elastic::BendingBatch>& batches = model_.prepared->bent.batches;
    const std::vector<elastic::BendingPoint>& points = model_.prepared->bent.points;
    const std::vector<double> from = positions("x0", x0);
    const std::vector<double> to = positions("x1", x1);
    std::vector<double> g(from.size(), 0.0);
    std::vector<double> blocks(9 * static_cast<std::size_t>(pattern_.block_count()), 0.0);
    std::vector<double> dx(from.size());
    for (std::size_t a = 0; a < dx.size(); ++a) dx[a] = to[a] - from[a];
    elastic::BendingStates start(batches.size());
    elastic::BendingStates end(batches.size());
    kernels.evaluate(batches.data(), batches.size(), points.data(), from.data(), start.data());
    kernels.add_gradient(batches.data(), batches.size(), points.data(), start.data(), g.data());
    kernels.add_hessian(batches.data(), batches.size(), points.data(), start.data(), positive,
                        own_places().data(), blocks.data());
    return nb::make_tuple(
        kernels.energy_change(batches.data(), batches.size(), points.data(), to.data(), dx.data(),
                              start.data(), end.data(), nullptr),
        rows_array(g), owned(blocks.data(), {blocks.size() / 9, 9}));
  }

  /// (row, column) of every block, in the order of hessian_blocks().
  IndexArray block_pairs() const {
    std::vector<std::int32_t> pairs;
    for (Index j = 0; j < pattern_.size(); ++j) {
      for (Index k = pattern_.column_start()[j]; k < pattern_.column_start()[j + 1]; ++k) {
        pairs.push_back(pattern_.row()[k]);
        pairs.push_back(j);
      }
    }
    return owned(pairs.data(), {pairs.size() / 2, 2});
  }

  /// The Hessian at x with stresses extrapolated along the straight motion from x0.
  Array extrapolated_hessian(const Positions& x0, const Positions& x, bool positive) const {
    const Curvature curvature = positive ? Curvature::kPositive : Curvature::kExact;
    const std::vector<double> from = positions("x0", x0);
    const std::vector<double> to = positions("x", x);
    std::vector<double> blocks(9 * static_cast<std::size_t>(slots_.block_count), 0.0);
    elastic::add_hessian(model_, slots_, to.data(), elastic::bending_states(model_, to.data()),
                         curvature, own_places(), blocks.data());
    elastic::add_extrapolation(model_, slots_, to.data(),
                               elastic::extrapolated_stresses(model_, from.data(), to.data()),
                               curvature, own_places(), blocks.data());
    return dense(blocks.data());
  }

  /// Identity map of the slots of the base pattern.
  std::vector<Index> own_places() const {
    std::vector<Index> place(pattern_.block_count());
    std::iota(place.begin(), place.end(), 0);
    return place;
  }

  Array dense(const double* blocks) const {
    const Index n = topology_.vertex_count;
    Eigen::MatrixXd matrix = Eigen::MatrixXd::Zero(3 * n, 3 * n);
    for (Index j = 0; j < n; ++j) {
      for (Index s = pattern_.column_start()[j]; s < pattern_.column_start()[j + 1]; ++s) {
        const Index i = pattern_.row()[s];
        const Mat3 block = Eigen::Map<const Mat3>(blocks + 9 * s);
        matrix.block<3, 3>(3 * i, 3 * j) = block;
        matrix.block<3, 3>(3 * j, 3 * i) = block.transpose();
      }
    }
    const std::size_t size = 3 * static_cast<std::size_t>(n);
    return owned(matrix.data(), {size, size});
  }

  static void add_materials(const elastic::Bar& bar, nb::dict& result) {
    result["stretch"] = vector_array(bar.stretch);
    result["bending"] = vector_array(bar.bending);
    result["poisson"] = vector_array(bar.poisson);
    result["damping"] = vector_array(bar.damping);
    result["stretch_weft"] = vector_array(bar.stretch_weft);
    result["stretch_shear"] = vector_array(bar.stretch_shear);
    result["bending_weft"] = vector_array(bar.bending_weft);
    result["bending_twill"] = vector_array(bar.bending_twill);
  }

  nb::dict mixed(const Positions& x, const Positions& z, bool with_rest) const {
    elastic::Bar bar(topology_, stencils_);
    elastic::add_mixed(model_, positions("x", x).data(), positions("z", z).data(), with_rest, bar);
    std::vector<double> X_bar(X_.size(), 0.0);
    if (with_rest) {
      mesh::rest_shape_vjp(topology_, stencils_, X_.data(), bar.rest, X_bar.data());
    }
    nb::dict result;
    add_materials(bar, result);
    result["x_n"] = rows_array(bar.x_n);
    result["X"] = rows_array(X_bar);
    return result;
  }

  /// L of the constant form with springs to targets, a product with it, the energy change from u by s,
  /// and the cotangents of  z . L u.
  nb::dict constant_form(const Indices& vertex,
                         const Values& stiffness,
                         const Positions& u,
                         const Positions& s,
                         const Positions& z) const {
    check_rows("stiffness", stiffness.shape(0), vertex.shape(0));
    const std::vector<Index> rows = counting(vertex.size() + 1);
    const std::vector<double> ones(vertex.size(), 1.0);
    const std::array springs{elastic::Springs{.start = rows,
                                              .point = {vertex.data(), vertex.size()},
                                              .coefficient = ones,
                                              .stiffness = {stiffness.data(), stiffness.size()},
                                              .rest_length = {},
                                              .target_row = {rows.data(), vertex.size()},
                                              .target = nullptr}};
    const elastic::ConstantForm form(model_, slots_, springs, pattern_);
    std::vector<double> product(u.size(), 0.0);
    form.add_product(positions("u", u).data(), product.data());
    elastic::Bar bar(topology_, stencils_);
    elastic::add_constant_form_mixed(model_, u.data(), positions("z", z).data(), true, bar);
    std::vector<double> X_bar(X_.size(), 0.0);
    mesh::rest_shape_vjp(topology_, stencils_, X_.data(), bar.rest, X_bar.data());
    nb::dict result;
    result["values"] = vector_array({form.values().begin(), form.values().end()});
    result["product"] = rows_array(product);
    result["energy_change"] = form.energy_change(u.data(), positions("s", s).data());
    add_materials(bar, result);
    result["X"] = rows_array(X_bar);
    return result;
  }

  nb::dict rest() const {
    std::vector<double> gradients;
    for (const mesh::ShapeGradient& g : rest_.shape_gradient) {
      for (int k = 0; k < 6; ++k) gradients.push_back(g(k / 2, k % 2));
    }
    std::vector<double> curvature;
    for (const Mat3& b : rest_.curvature) curvature.insert(curvature.end(), b.data(), b.data() + 9);
    nb::dict result;
    result["area"] = vector_array(rest_.area);
    result["shape_gradient"] = owned(gradients.data(), {rest_.area.size(), 3, 2});
    result["curvature_operator"] = rows_array(rest_.curvature_operator);
    result["curvature"] = owned(curvature.data(), {rest_.curvature.size(), 3, 3});
    result["bending_area"] = vector_array(rest_.bending_area);
    result["vertex_area"] = vector_array(rest_.vertex_area);
    result["edge_area"] = vector_array(rest_.edge_area);
    result["edge_length_sq"] = vector_array(rest_.edge_length_sq);
    result["curved"] = rest_.curved;
    return result;
  }

  /// Pull cotangents of every field of the rest shape back to X. The cotangent of entry k of a field is
  /// cos(k + 1): a test repeats it.
  Array rest_vjp() const {
    mesh::RestShapeBar bar(topology_, stencils_);
    for_each_entry(bar, [](double& entry, std::size_t k) { entry = std::cos(k + 1.0); });
    std::vector<double> X_bar(X_.size(), 0.0);
    mesh::rest_shape_vjp(topology_, stencils_, X_.data(), bar, X_bar.data());
    return rows_array(X_bar);
  }

  /// Sum of the cotangents of rest_vjp() times the changes of the fields along X_dot.
  double rest_jvp(const Positions& X_dot) const {
    check_rows("X_dot", X_dot.shape(0), topology_.rest_vertex_count);
    mesh::RestShapeBar dot = mesh::rest_shape_jvp(topology_, stencils_, X_.data(), X_dot.data());
    double total = 0.0;
    for_each_entry(dot, [&](double entry, std::size_t k) { total += std::cos(k + 1.0) * entry; });
    return total;
  }

  IndexArray stencil_start() const {
    return owned(stencils_.start.data(), {stencils_.start.size()});
  }
  IndexArray stencil_vertices() const {
    return owned(stencils_.vertices.data(), {stencils_.vertices.size()});
  }
  IndexArray edges() const {
    return owned(topology_.edges.data()->data(), {topology_.edges.size(), 2});
  }
  IndexArray edge_faces() const {
    return owned(topology_.edge_faces.data()->data(), {topology_.edges.size(), 2});
  }
  IndexArray face_edges() const {
    return owned(topology_.face_edges.data()->data(), {topology_.faces.size(), 3});
  }

  const linalg::BlockPattern& pattern() const { return pattern_; }

  Potential& between(const double* /*x*/, const double* /*to*/) {
    return potential_.emplace(model_, slots_, pattern_, elastic::Wanted::kNone);
  }

  /// Changes of energy, gradients and Hessians in the order of a solve that returns to earlier points:
  /// numbers of one potential, or of a new potential for each evaluation.
  Array evaluations(const Positions& x0, const Positions& x1, const Positions& x2, bool fresh) {
    const std::array points{positions("x0", x0), positions("x1", x1), positions("x2", x2)};
    std::vector<double> numbers;
    const auto own = [&]() -> Potential& {
      return fresh || !potential_ ? between(nullptr, nullptr) : *potential_;
    };
    between(nullptr, nullptr);
    for (const auto& [from, to] : {std::pair{0, 1}, {0, 2}, {2, 1}, {2, 0}, {1, 2}}) {
      const std::vector<double>& x = points[from];
      const std::vector<double>& end = points[to];
      numbers.push_back(own().energy_change(x.data(), end.data()));
      for (const std::vector<double>* at : {&points[1], &end, &x}) {
        std::vector<double> g(at->size(), 0.0);
        own().add_gradient(at->data(), g.data());
        numbers.insert(numbers.end(), g.begin(), g.end());
        const Eigen::MatrixXd h = dense_hessian(own(), pattern_, at->data(), Curvature::kExact);
        numbers.insert(numbers.end(), h.data(), h.data() + h.size());
      }
    }
    return vector_array(numbers);
  }

 private:
  static Index vertex_count(const Positions& X,
                            const Faces& faces,
                            const std::optional<Faces>& rest_faces) {
    if (!rest_faces) return static_cast<Index>(X.shape(0));
    return *std::max_element(faces.data(), faces.data() + faces.size()) + 1;
  }

  std::vector<double> positions(const char* name, const Positions& x) const {
    check_rows(name, x.shape(0), topology_.vertex_count);
    return {x.data(), x.data() + x.size()};
  }

  /// Call visit(entry, k) for all entries of all fields; k counts within a field.
  template <class Visit>
  static void for_each_entry(mesh::RestShapeBar& fields, Visit&& visit) {
    for (std::vector<double>* field :
         {&fields.area, &fields.curvature_operator, &fields.bending_area, &fields.vertex_area,
          &fields.edge_area, &fields.edge_length_sq}) {
      for (std::size_t k = 0; k < field->size(); ++k) visit((*field)[k], k);
    }
    for (std::size_t k = 0; k < 6 * fields.shape_gradient.size(); ++k) {
      visit(fields.shape_gradient[k / 6](k % 6 / 2, k % 2), k);
    }
    for (std::size_t k = 0; k < 9 * fields.curvature.size(); ++k) {
      visit(fields.curvature[k / 9].data()[k % 9], k);
    }
  }

  std::vector<double> X_;
  mesh::Topology topology_;
  mesh::BendingStencils stencils_;
  mesh::RestShape rest_;
  linalg::BlockPattern pattern_;
  elastic::Slots slots_;
  elastic::Model model_;
  std::vector<double> x_n_;
  std::vector<Vec2> axes_;
  std::optional<elastic::ElasticPotential> potential_;  // of the model at the last call
};

template <class Given>
auto copied(const Given& values) {
  return std::vector(values.data(), values.data() + values.size());
}

/// Springs and their targets; a test creates one for each set of inputs.
class Springs {
 public:
  Springs(const Indices& start,
          const Indices& point,
          const Values& coefficient,
          const Values& stiffness,
          const Values& rest_length,
          const Indices& target_row,
          const Positions& target,
          Index point_count)
      : start_(copied(start)),
        point_(copied(point)),
        coefficient_(copied(coefficient)),
        stiffness_(copied(stiffness)),
        rest_length_(copied(rest_length)),
        target_row_(copied(target_row)),
        target_(copied(target)),
        pattern_(point_count, {}),
        potential_({.start = start_,
                    .point = point_,
                    .coefficient = coefficient_,
                    .stiffness = stiffness_,
                    .rest_length = rest_length_,
                    .target_row = target_row_,
                    .target = target_.data()},
                   0,
                   static_cast<Index>(target.shape(0))) {
    check_rows("stiffness", stiffness_.size(), start_.size() - 1);
    check_rows("rest_length", rest_length_.size(), start_.size() - 1);
    check_rows("target_row", target_row_.size(), start_.size() - 1);
  }
  Springs(const Springs&) = delete;
  Springs& operator=(const Springs&) = delete;

  const linalg::BlockPattern& pattern() const { return pattern_; }
  Potential& between(const double* /*x*/, const double* /*to*/) { return potential_; }

  /// The second derivative of each spring along its vector.
  Array hessians(const PointRows& x, bool positive) const {
    std::vector<double> blocks;
    for (Index a = 0; a < potential_.springs().size(); ++a) {
      const Mat3 block = elastic::hessian(potential_.springs(), a, x.data(), positive);
      blocks.insert(blocks.end(), block.data(), block.data() + 9);
    }
    return owned(blocks.data(), {stiffness_.size(), 3, 3});
  }

  Rows3 left_out_product(const PointRows& x, const PointRows& d, bool positive) const {
    Rows3 y = Rows3::Zero(x.rows(), 3);
    const double* const motion = d.data();
    double* const sum = y.data();
    potential_.add_left_out_products(x.data(), positive ? Curvature::kPositive : Curvature::kExact,
                                     {.z = {&motion, 1}, .y = {&sum, 1}});
    return y;
  }

  /// Cotangents of stiffness and targets after one accumulate().
  nb::dict mixed(const PointRows& x, const PointRows& z) {
    std::ranges::fill(potential_.stiffness_bar, 0.0);
    std::ranges::fill(potential_.target_bar, 0.0);
    potential_.accumulate(x.data(), z.data());
    nb::dict result;
    result["stiffness"] = vector_array(potential_.stiffness_bar);
    result["target"] = rows_array(potential_.target_bar);
    return result;
  }

 private:
  std::vector<Index> start_;
  std::vector<Index> point_;
  std::vector<double> coefficient_;
  std::vector<double> stiffness_;
  std::vector<double> rest_length_;
  std::vector<Index> target_row_;
  std::vector<double> target_;
  linalg::BlockPattern pattern_;
  elastic::SpringPotential potential_;
};

}  // namespace

void elastic_kernels(nb::module_& m) {
  nb::class_<Elastic> model(m, "Elastic", "An elastic model on one rest mesh.");
  bind_potential(model);
  model
      .def(nb::init<const Positions&, const Faces&, const std::string&,
                    const std::optional<Faces>&>(),
           "X"_a.noconvert(), "faces"_a.noconvert(), "bending_model"_a,
           "rest_faces"_a.noconvert().none() = nb::none())
      .def("set_rest", &Elastic::set_rest, "X"_a.noconvert())
      .def("set_weave", &Elastic::set_weave, "axes"_a.noconvert(), "woven"_a.noconvert())
      .def("set_parameters", &Elastic::set_parameters, "stretch"_a.noconvert(),
           "bending"_a.noconvert(), "poisson"_a.noconvert(), "damping"_a.noconvert(), "h"_a,
           "x_n"_a.noconvert().none())
      .def("stretch", &Elastic::stretch, "level"_a, "x0"_a.noconvert(), "x1"_a.noconvert(),
           "positive"_a = false)
      .def("chords", &Elastic::chords, "level"_a, "x0"_a.noconvert(), "x1"_a.noconvert(),
           "shift"_a.noconvert(), "center"_a.noconvert())
      .def("evaluations", &Elastic::evaluations, "x0"_a, "x1"_a, "x2"_a, "fresh"_a)
      .def("bending", &Elastic::bending, "level"_a, "x0"_a.noconvert(), "x1"_a.noconvert(),
           "positive"_a = false)
      .def("extrapolated_hessian", &Elastic::extrapolated_hessian, "x0"_a.noconvert(),
           "x"_a.noconvert(), "positive"_a)
      .def("hessian_blocks", &Elastic::hessian_blocks, "x"_a.noconvert(), "positive"_a)
      .def("block_pairs", &Elastic::block_pairs)
      .def("mixed", &Elastic::mixed, "x"_a.noconvert(), "z"_a.noconvert(), "with_rest"_a)
      .def("constant_form", &Elastic::constant_form, "vertex"_a.noconvert(),
           "stiffness"_a.noconvert(), "u"_a.noconvert(), "s"_a.noconvert(), "z"_a.noconvert())
      .def("rest", &Elastic::rest)
      .def("rest_vjp", &Elastic::rest_vjp)
      .def("rest_jvp", &Elastic::rest_jvp)
      .def_prop_ro("stencil_start", &Elastic::stencil_start, nb::rv_policy::automatic)
      .def_prop_ro("stencil_vertices", &Elastic::stencil_vertices, nb::rv_policy::automatic)
      .def_prop_ro("edges", &Elastic::edges, nb::rv_policy::automatic)
      .def_prop_ro("edge_faces", &Elastic::edge_faces, nb::rv_policy::automatic)
      .def_prop_ro("face_edges", &Elastic::face_edges, nb::rv_policy::automatic);
  nb::class_<Springs> springs(m, "Springs", "Springs between points and to targets.");
  bind_potential(springs);
  springs
      .def(nb::init<const Indices&, const Indices&, const Values&, const Values&, const Values&,
                    const Indices&, const Positions&, Index>(),
           "start"_a.noconvert(), "point"_a.noconvert(), "coefficient"_a.noconvert(),
           "stiffness"_a.noconvert(), "rest_length"_a.noconvert(), "target_row"_a.noconvert(),
           "target"_a.noconvert(), "point_count"_a)
      .def("hessians", &Springs::hessians, "x"_a.noconvert(), "positive"_a)
      .def("left_out_product", &Springs::left_out_product, "x"_a.noconvert(), "d"_a.noconvert(),
           "positive"_a)
      .def("mixed", &Springs::mixed, "x"_a.noconvert(), "z"_a.noconvert());
}

}  // namespace diffcloth::bind
