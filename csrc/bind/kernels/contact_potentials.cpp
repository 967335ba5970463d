#include <array>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include <Eigen/Core>
#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include "bind/kernels/kernels.h"
#include "bind/kernels/potential.h"
#include "contact/contact_potential.h"
#include "contact/contact_set.h"
#include "contact/feature_areas.h"
#include "contact/friction_set.h"
#include "contact/sharpness.h"

namespace diffcloth::bind {
namespace {

using namespace nb::literals;
using Positions = PointRows;
using FaceRows = Eigen::Ref<const Eigen::Matrix<Index, Eigen::Dynamic, 3, Eigen::RowMajor>>;
using Values = Eigen::VectorXd;

std::vector<contact::CollisionMesh::Face> face_list(const FaceRows& faces) {
  std::vector<contact::CollisionMesh::Face> rows(faces.rows());
  for (std::size_t f = 0; f < rows.size(); ++f) rows[f] = {faces(f, 0), faces(f, 1), faces(f, 2)};
  return rows;
}

Values to_values(const std::vector<double>& v) {
  return Eigen::Map<const Values>(v.data(), static_cast<Eigen::Index>(v.size()));
}

/// Lagged friction of a mesh alone.
class Friction {
 public:
  Friction(const contact::ContactModel& model,
           const linalg::BlockPattern& pattern,
           std::vector<contact::Contact> lag,
           const Positions& x_start,
           const Positions& x_lag)
      : pattern_(pattern),
        lag_(std::move(lag)),
        x_start_(x_start),
        x_lag_(x_lag),
        potential_(model, lag_, x_start_.data(), x_lag_.data(), nullptr) {}
  Friction(const Friction&) = delete;
  Friction& operator=(const Friction&) = delete;

  const linalg::BlockPattern& pattern() const { return pattern_; }
  Potential& between(const double* /*x*/, const double* /*to*/) { return potential_; }

  /// After a step along p by alpha from x: true if there are duals, and the primal-dual Hessian.
  std::pair<bool, Eigen::MatrixXd> after(const Positions& x, const Positions& p, double alpha) {
    const Rows3 to = x + alpha * p;
    potential_.update_duals(x.data(), p.data(), alpha, to.data());
    return {potential_.has_duals(to.data()),
            dense_hessian(potential_, pattern_, to.data(), Curvature::kPrimalDual)};
  }

  /// e1, e2, m, s, w, law and the change of w with a motion p, of each entry: by the kernels of a level,
  /// or, if it is empty, one operation after the other with the change by differences.
  Eigen::MatrixXd slips(const Positions& x, const Positions& p, const std::string& level) const {
    const contact::FrictionSet& set = potential_.set();
    contact::FrictionSet::Slips at;
    std::vector<Vec3> change;
    if (level.empty()) {
      for (const contact::FrictionSet::Entry& k : set.entries()) {
        at.push_back(set.slip(k, x.data()));
        constexpr double kSmall = 1e-6;
        const Rows3 after = x + kSmall * p;
        const Rows3 before = x - kSmall * p;
        change.emplace_back((set.slip(k, after.data()).w - set.slip(k, before.data()).w) /
                            (2.0 * kSmall));
      }
    } else {
      const contact::FrictionKernels& by = contact::friction_kernels(level_named(level));
      at = set.slips(x.data(), by);
      change = set.changes(at, p.data(), by);
    }
    Eigen::MatrixXd result(at.size(), 23);
    for (std::size_t e = 0; e < at.size(); ++e) {
      const FrictionLaw& law = at[e].law;
      const contact::FrictionSet::Frame& frame = at[e].frames[0];
      result.row(static_cast<Eigen::Index>(e)) << frame.e1.transpose(), frame.e2.transpose(),
          frame.m.transpose(), at[e].s.transpose(), at[e].w.transpose(), law.f0, law.f1_over_y,
          law.f2, law.f1_over_y_e, law.f0_e, change[e].transpose();
    }
    return result;
  }

  /// At x, with an expected motion to another point: true if there are duals, and the primal-dual and
  /// the positive Hessian.
  std::tuple<bool, Eigen::MatrixXd, Eigen::MatrixXd> expecting(const Positions& x,
                                                               const Positions& to) {
    potential_.expect(x.data(), to.data());
    return {potential_.has_duals(x.data()),
            dense_hessian(potential_, pattern_, x.data(), Curvature::kPrimalDual),
            dense_hessian(potential_, pattern_, x.data(), Curvature::kPositive)};
  }

 private:
  const linalg::BlockPattern& pattern_;
  std::vector<contact::Contact> lag_;
  Rows3 x_start_;
  Rows3 x_lag_;
  contact::FrictionPotential potential_;
};

/// Barrier and lagged friction of a mesh.
class ContactPotential {
 public:
  ContactPotential(const FaceRows& faces,
                   std::vector<Index> vertex_surface,
                   Index cloth_count,
                   contact::SurfacePairs touching,
                   const Positions& X,
                   const std::vector<bool>& prescribed,
                   contact::Parameters parameters,
                   std::vector<double> radius)
      : mesh_(face_list(faces),
              std::move(vertex_surface),
              cloth_count,
              std::move(touching),
              std::move(radius)),
        prescribed_(prescribed.begin(), prescribed.end()),
        weights_(mesh_, X.data(), prescribed_),
        rest_(contact::measure(mesh_, X.data())),
        model_(mesh_, weights_, rest_, std::move(parameters), prescribed_),
        broad_phase_(mesh_, X.data()),
        detection_(broad_phase_),
        pattern_(mesh_.vertex_count, {}),
        X_(X) {}
  ContactPotential(const ContactPotential&) = delete;
  ContactPotential& operator=(const ContactPotential&) = delete;

  Index candidate_count(const Positions& x) { return static_cast<Index>(candidates(x, x).size()); }

  /// Energies of corresponding pairs at x and at another position.
  std::pair<Values, Values> energies(const Positions& x, const Positions& other) {
    const std::vector<contact::Candidate> pairs = candidates(x, other);
    contact::Near at_x;
    contact::Near at_other;
    model_.measure(pairs, x.data(), at_x);
    model_.measure(pairs, other.data(), at_other);
    std::vector<double> a;
    std::vector<double> b;
    contact::for_each_energy(at_x, at_other, [&](double e_x, double e_other) {
      a.push_back(e_x);
      b.push_back(e_other);
    });
    return {to_values(a), to_values(b)};
  }

  /// Corners, weight and distance of every contact.
  nb::tuple contacts(const Positions& x) {
    const std::vector<contact::Contact> found = find(x);
    const auto count = static_cast<Eigen::Index>(found.size());
    Eigen::Matrix<Index, Eigen::Dynamic, 4, Eigen::RowMajor> corners(count, 4);
    Eigen::Matrix<double, Eigen::Dynamic, 4, Eigen::RowMajor> c(count, 4);
    Values weight(count);
    Values distance(count);
    for (Eigen::Index k = 0; k < count; ++k) {
      for (int i = 0; i < 4; ++i) corners(k, i) = found[k].pair.vertices[i];
      c.row(k) = found[k].closest.c;
      weight[k] = found[k].weight;
      distance[k] = std::sqrt(found[k].closest.d_sq);
    }
    return nb::make_tuple(corners, c, weight, distance);
  }

  nb::dict mixed(const Positions& x, const Positions& z, double scale) {
    contact::ContactModel::Bar bar(mesh_);
    model_.add_mixed(find(x), x.data(), z.data(), scale, bar);
    return to_dict(bar);
  }

  nb::dict friction_mixed(const Positions& x_lag,
                          const Positions& x_start,
                          const Positions& x,
                          const Positions& z,
                          double scale) {
    const std::vector<contact::Contact> lag = find(x_lag);
    const contact::FrictionSet set(model_, lag, x_start.data(), x_lag.data());
    contact::ContactModel::Bar bar(mesh_);
    Values start_bar = Values::Zero(x.size());
    Values lag_bar = Values::Zero(x.size());
    set.add_mixed(x.data(), z.data(), scale, contact::FrictionSet::DiffWrt::kPointsAndParameters,
                  {.start = start_bar.data(), .lag = lag_bar.data(), .parameters = &bar});
    nb::dict result = to_dict(bar);
    result["x_start"] = start_bar;
    result["x_lag"] = lag_bar;
    return result;
  }

  /// Change of the gradients of barrier and friction with tangents of their inputs: the transposes of
  /// the two above.
  Rows3 tangent(const Positions& x, const nb::dict& dot) {
    Rows3 y = Rows3::Zero(x.rows(), 3);
    const contact::ContactModel::Bar parameters = from_dict(dot);
    const std::array directions{&parameters};
    const std::array out{y.data()};
    model_.add_tangents(find(x), x.data(), directions, out);
    return y;
  }

  Rows3 friction_tangent(const Positions& x_lag,
                         const Positions& x_start,
                         const Positions& x,
                         const nb::dict& dot) {
    const std::vector<contact::Contact> lag = find(x_lag);
    const contact::FrictionSet set(model_, lag, x_start.data(), x_lag.data());
    const contact::ContactModel::Bar parameters = from_dict(dot);
    const auto start = nb::cast<Values>(dot["x_start"]);
    const auto lag_dot = nb::cast<Values>(dot["x_lag"]);
    Rows3 y = Rows3::Zero(x.rows(), 3);
    const std::array<contact::FrictionSet::Tangents, 1> directions{
        {{.parameters = &parameters, .start = start.data(), .lag = lag_dot.data()}}};
    const std::array out{y.data()};
    set.add_tangents(x.data(), directions, out);
    return y;
  }

  const linalg::BlockPattern& pattern() const { return pattern_; }

  Potential& between(const double* x, const double* to) {
    contact::ContactPotential& barrier = barrier_.emplace(model_, detection_, nullptr);
    barrier.watch(x, to);
    barrier.stand_at(x);
    return barrier;
  }

  /// Collision-free fraction of a motion, from the pairs that are kept between calls.
  double safe_fraction(const Positions& x, const Positions& to) {
    if (!barrier_) barrier_.emplace(model_, detection_, nullptr);
    barrier_->watch(x.data(), to.data());
    return barrier_->safe_fraction(x.data(), to.data());
  }

  /// Friction with the contacts of x_lag, for the displacement since x_start.
  std::unique_ptr<Friction> friction(const Positions& x_lag, const Positions& x_start) {
    return std::make_unique<Friction>(model_, pattern_, find(x_lag), x_start, x_lag);
  }

  /// Reference to a rest measure by its name, for finite differences.
  std::vector<double>& measure(const std::string& name) {
    if (name == "vertex_area") return rest_.vertex_area;
    if (name == "edge_area") return rest_.edge_area;
    if (name == "edge_length_sq") return rest_.edge_length_sq;
    if (name == "face_area") return rest_.face_area;
    if (name == "mean_face_area") return rest_.mean_face_area;
    throw nb::value_error(("contact potential: no measure `" + name + "`").c_str());
  }

  /// s_e and s_v of the bodies' edges and vertices against a cloth.
  std::pair<Values, Values> sharpness(Index cloth) const {
    Values edge(mesh_.edges.size() - mesh_.cloth_edge_count);
    Values vertex(mesh_.vertex_count - mesh_.cloth_vertex_count);
    for (Index k = 0; k < edge.size(); ++k) {
      edge[k] = weights_.edge_sharpness(cloth, mesh_.cloth_edge_count + k);
    }
    for (Index k = 0; k < vertex.size(); ++k) {
      vertex[k] = weights_.vertex_sharpness(cloth, mesh_.cloth_vertex_count + k);
    }
    return {edge, vertex};
  }

  /// Continuation of a body's edges at both of their ends.
  Eigen::MatrixXd continuation() const {
    Eigen::MatrixXd result(mesh_.edges.size() - mesh_.cloth_edge_count, 2);
    for (Index k = 0; k < result.rows(); ++k) {
      for (int end = 0; end < 2; ++end) {
        result(k, end) = weights_.continuation(mesh_.cloth_edge_count + k, end);
      }
    }
    return result;
  }

  /// For the bodies: A_v of vertices, theta and A_e of edges, and the areas of surfaces.
  std::tuple<Values, Values, Values, Values> body_areas() const {
    const contact::Bulge bulge = contact::bulge(mesh_, X_.data());
    const contact::FeatureAreas areas = contact::feature_areas(mesh_, X_.data(), bulge);
    return {to_values(areas.vertex), to_values(bulge.edge), to_values(areas.edge),
            to_values(areas.surface)};
  }

  /// Weights of a sum over features (edges, vertices, faces) for a prescribed or a free point.
  std::tuple<std::vector<Index>, std::vector<Index>, std::vector<bool>> feature_weights(
      bool prescribed_point) const {
    const contact::FeatureWeights::Features& w = weights_.features(prescribed_point);
    return {w.edge, w.vertex, {w.counts.begin(), w.counts.end()}};
  }

  Eigen::Matrix<Index, Eigen::Dynamic, 2, Eigen::RowMajor> edges() const {
    Eigen::Matrix<Index, Eigen::Dynamic, 2, Eigen::RowMajor> result(mesh_.edges.size(), 2);
    for (std::size_t e = 0; e < mesh_.edges.size(); ++e) {
      result.row(e) << mesh_.edges[e][0], mesh_.edges[e][1];
    }
    return result;
  }

 private:
  std::vector<contact::Candidate> candidates(const Positions& x, const Positions& to) {
    if (x.rows() != mesh_.vertex_count || to.rows() != mesh_.vertex_count) {
      throw nb::value_error("contact potential: positions must have one row a vertex");
    }
    std::vector<contact::Candidate> pairs;
    broad_phase_.find(x.data(), to.data(), model_.reach(), scratch_, pairs);
    return pairs;
  }

  std::vector<contact::Contact> find(const Positions& x) {
    contact::Near near;
    std::vector<contact::Contact> found;
    model_.measure(candidates(x, x), x.data(), near);
    model_.find(near, x.data(), found);
    return found;
  }

  static nb::dict to_dict(const contact::ContactModel::Bar& bar) {
    nb::dict result;
    result["d_hat"] = bar.d_hat;
    result["slip"] = bar.slip;
    result["thickness"] = to_values(bar.thickness);
    result["kappa"] = to_values(bar.kappa);
    result["friction"] = to_values(bar.friction);
    result["vertex_area"] = to_values(bar.rest.vertex_area);
    result["edge_area"] = to_values(bar.rest.edge_area);
    result["edge_length_sq"] = to_values(bar.rest.edge_length_sq);
    result["face_area"] = to_values(bar.rest.face_area);
    result["mean_face_area"] = to_values(bar.rest.mean_face_area);
    return result;
  }

  contact::ContactModel::Bar from_dict(const nb::dict& dot) const {
    const auto list = [&](const char* name) { return nb::cast<std::vector<double>>(dot[name]); };
    contact::ContactModel::Bar result(mesh_);
    result.d_hat = nb::cast<double>(dot["d_hat"]);
    result.slip = nb::cast<double>(dot["slip"]);
    result.thickness = list("thickness");
    result.kappa = list("kappa");
    result.friction = list("friction");
    result.rest.vertex_area = list("vertex_area");
    result.rest.edge_area = list("edge_area");
    result.rest.edge_length_sq = list("edge_length_sq");
    result.rest.face_area = list("face_area");
    result.rest.mean_face_area = list("mean_face_area");
    return result;
  }

  contact::CollisionMesh mesh_;
  std::vector<char> prescribed_;
  contact::FeatureWeights weights_;
  contact::RestMeasures rest_;
  contact::ContactModel model_;
  contact::BroadPhase broad_phase_;
  contact::BroadPhase::Scratch scratch_;
  contact::Detection detection_;
  std::optional<contact::ContactPotential> barrier_;  // of the last call
  linalg::BlockPattern pattern_;                      // of diagonal blocks
  Rows3 X_;
};

}  // namespace

void contact_potentials(nb::module_& m) {
  nb::class_<Friction> friction(m, "Friction");
  bind_potential(friction);
  friction.def("after", &Friction::after, "x"_a, "p"_a, "alpha"_a = 1.0)
      .def("expecting", &Friction::expecting, "x"_a, "to"_a)
      .def("slips", &Friction::slips, "x"_a, "p"_a, "level"_a);

  nb::class_<ContactPotential> barrier(m, "ContactPotential");
  bind_potential(barrier);
  barrier
      .def(
          "__init__",
          [](ContactPotential* self, const FaceRows& faces, std::vector<Index> vertex_surface,
             Index cloth_count, bool self_contact, const Positions& X,
             const std::vector<bool>& prescribed, double d_hat, double slip,
             std::vector<double> thickness, std::vector<double> kappa, std::vector<double> friction,
             const std::vector<bool>& body_dynamic,
             const std::vector<std::array<Index, 2>>& ignored_pairs, std::vector<double> radius) {
            contact::SurfacePairs touching = touching_surfaces(
                vertex_surface, cloth_count, self_contact, body_dynamic, ignored_pairs);
            new (self) ContactPotential(faces, std::move(vertex_surface), cloth_count,
                                        std::move(touching), X, prescribed,
                                        {.d_hat = d_hat,
                                         .slip = slip,
                                         .thickness = std::move(thickness),
                                         .kappa = std::move(kappa),
                                         .friction = std::move(friction)},
                                        std::move(radius));
          },
          "faces"_a, "vertex_surface"_a, "cloth_count"_a, "self_contact"_a, "X"_a, "prescribed"_a,
          "d_hat"_a, "slip"_a, "thickness"_a, "kappa"_a, "friction"_a,
          "body_dynamic"_a = std::vector<bool>{},
          "ignored_pairs"_a = std::vector<std::array<Index, 2>>{},
          "radius"_a = std::vector<double>{})
      .def("candidate_count", &ContactPotential::candidate_count, "x"_a)
      .def("safe_fraction", &ContactPotential::safe_fraction, "x"_a, "to"_a)
      .def("energies", &ContactPotential::energies, "x"_a, "other"_a)
      .def("contacts", &ContactPotential::contacts, "x"_a)
      .def("mixed", &ContactPotential::mixed, "x"_a, "z"_a, "scale"_a = 1.0)
      .def("friction", &ContactPotential::friction, "x_lag"_a, "x_start"_a, nb::keep_alive<0, 1>())
      .def("friction_mixed", &ContactPotential::friction_mixed, "x_lag"_a, "x_start"_a, "x"_a,
           "z"_a, "scale"_a = 1.0)
      .def("tangent", &ContactPotential::tangent, "x"_a, "dot"_a)
      .def("friction_tangent", &ContactPotential::friction_tangent, "x_lag"_a, "x_start"_a, "x"_a,
           "dot"_a)
      .def("measure",
           [](ContactPotential& self, const std::string& name) { return self.measure(name); })
      .def("set_measure",
           [](ContactPotential& self, const std::string& name, const std::vector<double>& values) {
             std::vector<double>& measure = self.measure(name);
             if (measure.size() != values.size()) {
               throw nb::value_error("contact potential: a measure keeps its size");
             }
             measure = values;
           })
      .def("sharpness", &ContactPotential::sharpness, "cloth"_a = 0)
      .def("body_areas", &ContactPotential::body_areas)
      .def("continuation", &ContactPotential::continuation)
      .def("feature_weights", &ContactPotential::feature_weights, "prescribed_point"_a)
      .def("edges", &ContactPotential::edges);
}

}  // namespace diffcloth::bind
