#include <algorithm>
#include <array>
#include <cstddef>
#include <limits>
#include <numeric>
#include <optional>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include <Eigen/Core>
#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include "bind/kernels/kernels.h"
#include "common/friction_law.h"
#include "contact/barrier.h"
#include "contact/box_group.h"
#include "contact/broad_phase.h"
#include "contact/candidate_list.h"
#include "contact/ccd.h"
#include "contact/collision_mesh.h"
#include "contact/distance/closest.h"
#include "contact/distance/mollifier.h"
#include "contact/nonadjacent_distance.h"
#include "contact/separation_lanes.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;
using contact::Corners;
using contact::PairKind;

template <class Scalar, class Shape>
using Array = nb::ndarray<const Scalar, Shape, nb::c_contig, nb::device::cpu>;
using OnePair = Array<double, nb::shape<4, 3>>;
using Pairs = Array<double, nb::shape<-1, 4, 3>>;
using Boxes = Array<double, nb::shape<8, 2, 3>>;
using Positions = Array<double, nb::shape<-1, 3>>;
using Faces = Array<Index, nb::shape<-1, 3>>;
using Surfaces = Array<Index, nb::shape<-1>>;
using IndexRows = Eigen::Matrix<Index, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

Corners corners(const double* x) { return {row(x, 0), row(x, 1), row(x, 2), row(x, 3)}; }

PairKind kind_of(bool edge_edge) {
  return edge_edge ? PairKind::kEdgeEdge : PairKind::kPointTriangle;
}

template <std::size_t kWidth>
IndexRows index_rows(const std::vector<std::array<Index, kWidth>>& rows) {
  IndexRows out(rows.size(), kWidth);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    for (std::size_t k = 0; k < kWidth; ++k) out(i, k) = rows[i][k];
  }
  return out;
}

Eigen::VectorX<Index> index_vector(const std::vector<Index>& values) {
  return Eigen::Map<const Eigen::VectorX<Index>>(values.data(), values.size());
}

contact::CollisionMesh collision_mesh(const Faces& faces,
                                      const Surfaces& vertex_surface,
                                      Index cloth_count,
                                      bool self_contact,
                                      const std::vector<bool>& body_dynamic,
                                      const std::vector<std::array<Index, 2>>& ignored_pairs,
                                      std::vector<double> radius) {
  std::vector<contact::CollisionMesh::Face> rows(faces.shape(0));
  for (std::size_t f = 0; f < rows.size(); ++f) rows[f] = {faces(f, 0), faces(f, 1), faces(f, 2)};
  std::vector<Index> surface(vertex_surface.data(),
                             vertex_surface.data() + vertex_surface.shape(0));
  contact::SurfacePairs touching =
      touching_surfaces(surface, cloth_count, self_contact, body_dynamic, ignored_pairs);
  return {std::move(rows), std::move(surface), cloth_count, std::move(touching), std::move(radius)};
}

void check_rows(const char* name, const Positions& x, const contact::CollisionMesh& mesh) {
  if (x.shape(0) == static_cast<std::size_t>(mesh.vertex_count)) return;
  throw nb::value_error((std::string("broad phase: `") + name + "` must have " +
                         std::to_string(mesh.vertex_count) + " rows, got " +
                         std::to_string(x.shape(0)))
                            .c_str());
}

/// A mesh, its search trees and the lists of earlier searches, as a solver keeps them.
class Search {
 public:
  Search(const Faces& faces,
         const Surfaces& vertex_surface,
         Index cloth_count,
         bool self_contact,
         const Positions& x_reference,
         const std::vector<bool>& body_dynamic,
         const std::vector<std::array<Index, 2>>& ignored_pairs,
         std::vector<double> radius)
      : mesh_(collision_mesh(faces,
                             vertex_surface,
                             cloth_count,
                             self_contact,
                             body_dynamic,
                             ignored_pairs,
                             std::move(radius))),
        broad_phase_(mesh_, checked("x_reference", x_reference)),
        list_(broad_phase_) {}
  Search(const Search&) = delete;
  Search& operator=(const Search&) = delete;

  /// Kind (1: edge-edge), corners, a and b of every candidate, in order. One reach for each surface.
  IndexRows find(const Positions& x_t0, const Positions& x_t1, const std::vector<double>& reach) {
    check_reach(reach);
    broad_phase_.find(checked("x_t0", x_t0), checked("x_t1", x_t1), reach, scratch_, candidates_);
    return rows();
  }

  /// Same without motion, and without most pairs that are near by their boxes only.
  IndexRows find_at_rest(const Positions& x, const std::vector<double>& reach) {
    check_reach(reach);
    broad_phase_.find_at_rest(checked("x", x), reach, scratch_, candidates_);
    return rows();
  }

  /// Same from the list that is kept between searches.
  IndexRows find_kept(const Positions& x_t0,
                      const Positions& x_t1,
                      const std::vector<double>& reach) {
    check_reach(reach);
    list_.find(checked("x_t0", x_t0), checked("x_t1", x_t1), reach, scratch_, found_);
    candidates_ = found_.pairs;
    return rows();
  }

  /// Pairs within reach and a margin at a point.
  IndexRows find_at(const Positions& x,
                    const std::vector<double>& reach,
                    double widened,
                    const std::vector<bool>& wanted) {
    check_reach(reach);
    const std::vector<char> flags(wanted.begin(), wanted.end());
    list_.find_at(checked("x", x), reach, widened, flags, scratch_, candidates_);
    return rows();
  }

  /// Lower bounds of the distances of the pairs of the last find_kept().
  Eigen::VectorXd apart() const {
    return Eigen::Map<const Eigen::VectorXd>(found_.apart.data(), found_.apart.size());
  }

  Index builds() const { return list_.builds(); }

  IndexRows rows() const {
    IndexRows out(candidates_.size(), 7);
    for (std::size_t i = 0; i < candidates_.size(); ++i) {
      const auto& [kind, v, a, b] = candidates_[i];
      out.row(i) << static_cast<Index>(kind), v[0], v[1], v[2], v[3], a, b;
    }
    return out;
  }

  std::optional<std::pair<Index, Index>> find_intersection(const Positions& x) {
    return broad_phase_.find_intersection(checked("x", x), scratch_);
  }

  double smallest_nonadjacent_distance(const Positions& x) const {
    return contact::smallest_nonadjacent_distance(mesh_, checked("x", x));
  }

  const contact::CollisionMesh& mesh() const { return mesh_; }

 private:
  void check_reach(const std::vector<double>& reach) const {
    if (reach.size() == static_cast<std::size_t>(mesh_.surface_count())) return;
    throw nb::value_error("broad phase: `reach` must have one value a surface");
  }

  const double* checked(const char* name, const Positions& x) const {
    check_rows(name, x, mesh_);
    return x.data();
  }

  contact::CollisionMesh mesh_;
  contact::BroadPhase broad_phase_;
  contact::CandidateList list_;
  contact::BroadPhase::Scratch scratch_;
  std::vector<contact::Candidate> candidates_;
  contact::Found found_;
};

void distance_kernels(nb::module_& m) {
  m.def(
      "closest",
      [](bool edge_edge, const OnePair& x) {
        const contact::Closest pair = contact::closest(kind_of(edge_edge), corners(x.data()));
        return std::tuple(pair.c, pair.parameter_count, pair.c_beta, pair.s, pair.M_inv, pair.t,
                          pair.d_sq);
      },
      "edge_edge"_a, "x"_a.noconvert());
  m.def(
      "closest_points",
      [](bool edge_edge, const OnePair& x) {
        const contact::ClosestPoints pair =
            contact::closest_points(kind_of(edge_edge), corners(x.data()));
        return std::tuple(pair.c, pair.parameter_count, pair.d_sq);
      },
      "edge_edge"_a, "x"_a.noconvert());
  m.def(
      "distance_sq_derivatives",
      [](bool edge_edge, const OnePair& x) {
        const contact::Closest pair = contact::closest(kind_of(edge_edge), corners(x.data()));
        return std::tuple(pair.d_sq, contact::distance_sq_gradient(pair),
                          contact::distance_sq_hessian(pair), contact::beta_jacobian(pair));
      },
      "edge_edge"_a, "x"_a.noconvert());
  m.def(
      "distances_sq",
      [](const std::string& level, bool edge_edge, const Pairs& x) {
        std::vector<Index> corners(4 * x.shape(0));
        std::iota(corners.begin(), corners.end(), 0);
        Eigen::VectorXd out(x.shape(0));
        const auto count = static_cast<std::ptrdiff_t>(x.shape(0));
        contact::squared_distances(level_named(level))(edge_edge, x.data(), corners.data(), 4,
                                                       count, out.data());
        return out;
      },
      "level"_a, "edge_edge"_a, "x"_a.noconvert());
  m.def(
      "distance_sq",
      [](bool edge_edge, const Pairs& x) {
        Eigen::VectorXd out(x.shape(0));
        for (std::size_t i = 0; i < x.shape(0); ++i) {
          out[i] = contact::distance_sq(kind_of(edge_edge), corners(x.data() + 12 * i));
        }
        return out;
      },
      "edge_edge"_a, "x"_a.noconvert());
  m.def("mollifier_threshold", &contact::mollifier_threshold, "rest_length_sq_a"_a,
        "rest_length_sq_b"_a, "is_round"_a = false);
  m.def(
      "mollifier",
      [](const OnePair& x, double eps) {
        return std::pair(contact::mollifier(corners(x.data()), eps),
                         contact::mollified(corners(x.data()), eps));
      },
      "x"_a.noconvert(), "eps"_a);
  m.def(
      "mollifier_derivatives",
      [](const OnePair& x, double eps) {
        const contact::Mollifier m = contact::mollifier_derivatives(corners(x.data()), eps);
        return std::tuple(m.m, m.gradient, m.hessian, m.m_eps, m.gradient_eps);
      },
      "x"_a.noconvert(), "eps"_a);
}

void law_kernels(nb::module_& m) {
  m.def("barrier", &contact::barrier, "D"_a, "xi"_a, "d_hat"_a);
  m.def(
      "barrier_derivatives",
      [](double D, double xi, double d_hat) {
        const contact::Barrier b = contact::barrier_derivatives(D, xi, d_hat);
        return std::tuple(b.b, b.b1, b.b2, b.b_d_hat, b.b1_d_hat, b.b_xi, b.b1_xi);
      },
      "D"_a, "xi"_a, "d_hat"_a);
  m.def(
      "friction_law",
      [](double y, double e) {
        const FrictionLaw f = friction_law(y, e);
        return std::tuple(f.f0, f.f1_over_y, f.f2, f.f1_over_y_e, f.f0_e);
      },
      "y"_a, "e"_a);
}

/// Bits of the nearby pairs among the first and the last four boxes.
auto near_boxes(const std::string& level, const Boxes& boxes, double range) {
  std::array<contact::BoxGroup, 2> groups;
  for (int k = 0; k < 2 * contact::kBoxGroup; ++k) {
    contact::BoxGroup& group = groups[k / contact::kBoxGroup];
    for (int axis = 0; axis < 3; ++axis) {
      group.lo[axis][k % contact::kBoxGroup] = boxes(k, 0, axis);
      group.hi[axis][k % contact::kBoxGroup] = boxes(k, 1, axis);
    }
  }
  return contact::near_boxes(level_named(level))(groups[0], groups[1], range);
}

void collision_kernels(nb::module_& m) {
  m.def(
      "safe_step",
      [](bool edge_edge, const Pairs& x_t0, const Pairs& x_t1, double xi, double d_hat) {
        if (x_t0.shape(0) != x_t1.shape(0)) {
          throw nb::value_error("safe_step: `x_t0` and `x_t1` must have as many pairs");
        }
        Eigen::VectorXd out(x_t0.shape(0));
        for (std::size_t i = 0; i < x_t0.shape(0); ++i) {
          out[i] = contact::safe_step(kind_of(edge_edge), corners(x_t0.data() + 12 * i),
                                      corners(x_t1.data() + 12 * i), xi, d_hat);
        }
        return out;
      },
      "edge_edge"_a, "x_t0"_a.noconvert(), "x_t1"_a.noconvert(), "xi"_a,
      "d_hat"_a = std::numeric_limits<double>::infinity());

  m.def("harmless_distance", &contact::harmless_distance, "xi"_a, "d_hat"_a, "largest"_a);

  m.def("near_boxes", &near_boxes, "level"_a, "boxes"_a.noconvert(), "range"_a,
        "Which of the first four boxes, [8, 2, 3], are near which of the other four: bits.");

  nb::class_<Search>(m, "BroadPhase")
      .def(nb::init<const Faces&, const Surfaces&, Index, bool, const Positions&,
                    const std::vector<bool>&, const std::vector<std::array<Index, 2>>&,
                    std::vector<double>>(),
           "faces"_a.noconvert(), "vertex_surface"_a.noconvert(), "cloth_count"_a, "self_contact"_a,
           "x_reference"_a.noconvert(), "body_dynamic"_a = std::vector<bool>{},
           "ignored_pairs"_a = std::vector<std::array<Index, 2>>{},
           "radius"_a = std::vector<double>{})
      .def("find", &Search::find, "x_t0"_a.noconvert(), "x_t1"_a.noconvert(), "reach"_a)
      .def(
          "find",
          [](Search& s, const Positions& x_t0, const Positions& x_t1, double radius) {
            return s.find(x_t0, x_t1, std::vector<double>(s.mesh().surface_count(), 0.5 * radius));
          },
          "x_t0"_a.noconvert(), "x_t1"_a.noconvert(), "radius"_a)
      .def("find_at_rest", &Search::find_at_rest, "x"_a.noconvert(), "reach"_a)
      .def("find_kept", &Search::find_kept, "x_t0"_a.noconvert(), "x_t1"_a.noconvert(), "reach"_a)
      .def("find_at", &Search::find_at, "x"_a.noconvert(), "reach"_a, "widened"_a, "wanted"_a)
      .def_prop_ro("apart", &Search::apart)
      .def_prop_ro("builds", &Search::builds)
      .def("find_intersection", &Search::find_intersection, "x"_a.noconvert())
      .def("smallest_nonadjacent_distance", &Search::smallest_nonadjacent_distance,
           "x"_a.noconvert())
      .def_prop_ro("edges", [](const Search& s) { return index_rows(s.mesh().edges); })
      .def_prop_ro("edge_faces", [](const Search& s) { return index_rows(s.mesh().edge_faces); })
      .def_prop_ro("edge_surface",
                   [](const Search& s) { return index_vector(s.mesh().edge_surface); })
      .def_prop_ro("face_surface",
                   [](const Search& s) { return index_vector(s.mesh().face_surface); })
      .def_prop_ro("cloth_counts", [](const Search& s) {
        const contact::CollisionMesh& mesh = s.mesh();
        return std::tuple(mesh.cloth_vertex_count, mesh.cloth_edge_count, mesh.cloth_face_count);
      });
}

}  // namespace

contact::SurfacePairs touching_surfaces(const std::vector<Index>& vertex_surface,
                                        Index cloth_count,
                                        bool self_contact,
                                        const std::vector<bool>& body_dynamic,
                                        const std::vector<std::array<Index, 2>>& ignored_pairs) {
  const Index last = vertex_surface.empty() ? -1 : std::ranges::max(vertex_surface);
  const Index surface_count = std::max(cloth_count, last + 1);
  if (!body_dynamic.empty() &&
      static_cast<Index>(body_dynamic.size()) != surface_count - cloth_count) {
    throw nb::value_error("collision mesh: `body_dynamic` must have one flag a body");
  }
  for (const auto& [a, b] : ignored_pairs) {
    if (std::min(a, b) < 0 || std::max(a, b) >= surface_count) {
      throw nb::value_error("collision mesh: `ignored_pairs` must refer to surfaces of the mesh");
    }
  }
  const std::vector<char> dynamic(body_dynamic.begin(), body_dynamic.end());
  return contact::touching_surfaces({.surface_count = surface_count,
                                     .cloth_count = cloth_count,
                                     .self_contact = self_contact,
                                     .body_dynamic = dynamic,
                                     .ignored = ignored_pairs});
}

void contact_kernels(nb::module_& m) {
  distance_kernels(m);
  law_kernels(m);
  collision_kernels(m);
}

}  // namespace diffcloth::bind
