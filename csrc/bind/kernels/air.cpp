#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include <nanobind/eigen/dense.h>
#include <nanobind/ndarray.h>

#include "air/drag_potential.h"
#include "bind/kernels/kernels.h"
#include "bind/kernels/potential.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;

using Faces = nb::ndarray<const std::int32_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

std::vector<std::array<Index, 3>> face_list(const Faces& faces) {
  std::vector<std::array<Index, 3>> result(faces.shape(0));
  for (std::size_t f = 0; f < result.size(); ++f) {
    result[f] = {faces(f, 0), faces(f, 1), faces(f, 2)};
  }
  return result;
}

std::vector<std::vector<Index>> cliques(const std::vector<std::array<Index, 3>>& faces) {
  std::vector<std::vector<Index>> result;
  for (const auto& face : faces) result.emplace_back(face.begin(), face.end());
  return result;
}

/// Drag of faces over one step; a test creates one for each set of inputs.
class FaceDrag {
 public:
  FaceDrag(const Faces& faces,
           const Eigen::VectorXd& across,
           const Eigen::VectorXd& along,
           const PointRows& start,
           const Vec3& wind,
           double h)
      : faces_(face_list(faces)),
        start_(start),
        pattern_(static_cast<Index>(start.rows()), cliques(faces_)),
        potential_({.faces = faces_,
                    .across = per_face("across", across),
                    .along = per_face("along", along),
                    .start = start_.data(),
                    .wind = wind,
                    .h = h},
                   pattern_.size(),
                   true) {}
  FaceDrag(const FaceDrag&) = delete;
  FaceDrag& operator=(const FaceDrag&) = delete;

  const linalg::BlockPattern& pattern() const { return pattern_; }
  Potential& between(const double* /*x*/, const double* /*to*/) { return potential_; }

  /// Cotangents of all inputs after one accumulate().
  nb::dict mixed(const PointRows& x, const PointRows& z) {
    for (auto* bar : {&potential_.across_bar, &potential_.along_bar, &potential_.start_bar,
                      &potential_.wind_bar}) {
      std::ranges::fill(*bar, 0.0);
    }
    potential_.accumulate(x.data(), z.data());
    nb::dict result;
    result["across"] = vector(potential_.across_bar);
    result["along"] = vector(potential_.along_bar);
    result["start"] = Rows3(Eigen::Map<const Rows3>(potential_.start_bar.data(), x.rows(), 3));
    result["wind"] = vector(potential_.wind_bar);
    return result;
  }

  /// Change of the gradient with all inputs.
  Rows3 tangent(const PointRows& x,
                const Eigen::VectorXd& across,
                const Eigen::VectorXd& along,
                const PointRows& start,
                const Vec3& wind) {
    potential_.across_dot = per_face("across", across);
    potential_.along_dot = per_face("along", along);
    potential_.start_dot.assign(start.data(), start.data() + start.size());
    potential_.wind_dot = wind;
    Rows3 y = Rows3::Zero(x.rows(), 3);
    potential_.add_tangent(x.data(), y.data());
    return y;
  }

 private:
  std::vector<double> per_face(const char* name, const Eigen::VectorXd& values) const {
    if (static_cast<std::size_t>(values.size()) != faces_.size()) {
      throw std::invalid_argument("air: `" + std::string(name) + "` must have one value a face");
    }
    return {values.data(), values.data() + values.size()};
  }

  static Eigen::VectorXd vector(const std::vector<double>& values) {
    return Eigen::Map<const Eigen::VectorXd>(values.data(),
                                             static_cast<Eigen::Index>(values.size()));
  }

  std::vector<std::array<Index, 3>> faces_;
  Rows3 start_;
  linalg::BlockPattern pattern_;
  air::DragPotential potential_;
};

}  // namespace

void air_kernels(nb::module_& m) {
  nb::class_<FaceDrag> drag(m, "FaceDrag", "Drag of faces over one step.");
  bind_potential(drag);
  drag.def(nb::init<const Faces&, const Eigen::VectorXd&, const Eigen::VectorXd&, const PointRows&,
                    const Vec3&, double>(),
           "faces"_a.noconvert(), "across"_a, "along"_a, "start"_a.noconvert(), "wind"_a, "h"_a)
      .def("mixed", &FaceDrag::mixed, "x"_a.noconvert(), "z"_a.noconvert())
      .def("tangent", &FaceDrag::tangent, "x"_a.noconvert(), "across"_a, "along"_a,
           "start"_a.noconvert(), "wind"_a);
}

}  // namespace diffcloth::bind
