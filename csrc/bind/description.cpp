#include "bind/description.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <span>
#include <string>
#include <vector>

#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "bind/checks.h"
#include "bind/links.h"

namespace diffcloth::bind {
namespace {

using Names = std::vector<std::string>;

constexpr std::array kBendingModels{
    step::Named<mesh::BendingModel>{"patch", mesh::BendingModel::kPatch},
    step::Named<mesh::BendingModel>{"hinge", mesh::BendingModel::kHinge},
};

/// Value with this name in a table.
template <class Value, class Table>
Value choose(const char* field, const Table& choices, const std::string& name) {
  std::string names;
  for (const auto& choice : choices) {
    if (name == choice.name) return choice.value;
    names += std::string(names.empty() ? "'" : ", '") + choice.name + "'";
  }
  throw nb::value_error(
      (std::string(field) + " must be one of " + names + ", got '" + name + "'").c_str());
}

std::vector<std::array<Index, 3>> to_faces(const std::vector<Index>& corners) {
  if (corners.size() % 3 != 0) throw nb::value_error("core: faces must have three vertices each");
  std::vector<std::array<Index, 3>> faces(corners.size() / 3);
  for (std::size_t k = 0; k < corners.size(); ++k) faces[k / 3][k % 3] = corners[k];
  return faces;
}

std::vector<projective::Primitive> take_primitives(NamedFields& fields) {
  const Names kinds = fields.take<Names>("primitive_kinds");
  const std::vector<double> sizes = fields.doubles("primitive_sizes");
  if (sizes.size() != 3 * kinds.size()) {
    throw nb::value_error("core: `primitive_sizes` must have three numbers a primitive");
  }
  std::vector<projective::Primitive> primitives;
  for (const std::string& kind : kinds) {
    const auto i = static_cast<Index>(primitives.size());
    primitives.push_back({.kind = projective::primitive_kind(kind), .size = row(sizes.data(), i)});
  }
  return primitives;
}

std::vector<std::array<Index, 2>> take_pairs(NamedFields& fields) {
  const std::vector<Index> ends = fields.indices("ignored_pairs");
  std::vector<std::array<Index, 2>> pairs;
  for (std::size_t p = 0; p + 1 < ends.size(); p += 2) pairs.push_back({ends[p], ends[p + 1]});
  return pairs;
}

std::vector<char> take_flags(NamedFields& fields, const char* name) {
  std::vector<char> flags;
  for (const Index flag : fields.indices(name)) flags.push_back(flag != 0 ? 1 : 0);
  return flags;
}

/// Assign coordinates without a joint to free roots, six each, tree after tree.
void assign_roots(bodies::MechanismsDescription& m) {
  const std::size_t n = m.coordinate_tree.size();
  std::size_t c = 0;
  for (std::size_t t = 0; t < m.tree_free.size(); ++t) {
    for (int i = 0; m.tree_free[t] != 0 && i < 6; ++i, ++c) {
      if (c >= n || m.coordinate_tree[c] != -1) {
        throw nb::value_error("trees: a free root must have six coordinates");
      }
      m.coordinate_tree[c] = static_cast<Index>(t);
    }
    while (c < n && m.coordinate_tree[c] == static_cast<Index>(t)) ++c;
  }
  if (c != n) throw nb::value_error("trees: coordinates must go tree after tree");
}

/// Read trees of links from their arrays.
bodies::MechanismsDescription take_mechanisms(NamedFields& fields, Index surfaces) {
  bodies::MechanismsDescription m;
  m.tree_free = take_flags(fields, "tree_free");
  m.prescribed = take_flags(fields, "coordinate_prescribed");
  m.held = take_flags(fields, "coordinate_held");
  m.lower = fields.doubles("coordinate_lower");
  m.upper = fields.doubles("coordinate_upper");
  m.limit_stiffness = fields.doubles("limit_stiffness");
  m.limit_zone = fields.take<double>("limit_zone");
  m.velocity_stiffness = fields.doubles("velocity_stiffness");
  m.velocity_force = fields.doubles("velocity_force");
  m.surface_link = fields.indices("surface_link");
  m.links = to_links({.tree = fields.indices("link_tree"),
                      .parent = fields.indices("link_parent"),
                      .kind = fields.indices("link_kind"),
                      .offset = fields.doubles("link_offset"),
                      .axis = fields.doubles("link_axis"),
                      .coordinate = fields.indices("link_coordinate"),
                      .multiplier = fields.doubles("link_multiplier"),
                      .constant = fields.doubles("link_constant")},
                     static_cast<Index>(m.prescribed.size()));
  const std::size_t n = m.prescribed.size();
  for (const std::size_t size : {m.lower.size(), m.upper.size(), m.limit_stiffness.size(),
                                 m.velocity_stiffness.size(), m.velocity_force.size()}) {
    if (size != n || m.held.size() != n)
      throw nb::value_error("trees: arrays of coordinates must have equal lengths");
  }
  m.coordinate_tree.assign(n, -1);
  for (const bodies::Link& link : m.links) {
    if (link.coordinate >= 0) m.coordinate_tree[link.coordinate] = link.tree;
  }
  for (const Index l : m.surface_link) {
    if (l < 0 || l >= static_cast<Index>(m.links.size())) {
      throw nb::value_error("trees: `surface_link` must name links");
    }
  }
  assign_roots(m);
  check_mechanisms(m, surfaces);
  return m;
}

step::AttachmentDescription take_attachments(NamedFields& fields) {
  step::AttachmentDescription d{.start = fields.indices("attachment_start"),
                                .point = fields.indices("attachment_points"),
                                .coefficient = fields.doubles("attachment_coefficients"),
                                .rest_length = fields.doubles("attachment_rest_lengths"),
                                .target_row = fields.indices("attachment_targets")};
  d.target_count = static_cast<Index>(
      std::ranges::count_if(d.target_row, [](Index target) { return target >= 0; }));
  return d;
}

/// Read the surfaces, their pins and their attachments.
void take_surfaces(NamedFields& fields, step::Description& d) {
  d.vertices = fields.doubles("vertices");
  d.rest_positions = fields.doubles("rest_positions");
  d.faces = to_faces(fields.indices("faces"));
  const bool has_seams = fields.has("rest_faces");
  d.rest_faces = has_seams ? to_faces(fields.indices("rest_faces")) : d.faces;
  d.rest_embedding = has_seams ? fields.doubles("rest_embedding") : d.rest_positions;
  d.cloth_vertex_start = fields.indices("cloth_vertex_start");
  d.cloth_face_start = fields.indices("cloth_face_start");
  for (const std::string& model : fields.take<Names>("bending_models")) {
    d.bending_models.push_back(choose<mesh::BendingModel>("bending_models", kBendingModels, model));
  }
  if (fields.has("material_axes")) d.material_axes = fields.doubles("material_axes");
  d.pins = fields.indices("pins");
  d.soft_pins = fields.indices("soft_pins");
  d.bodies = {.vertices = fields.doubles("body_vertices"),
              .vertex_start = fields.indices("body_vertex_start"),
              .pose = {}};
  d.body_faces = to_faces(fields.indices("body_faces"));
  if (fields.has("body_radii")) d.body_radii = fields.doubles("body_radii");
  if (fields.has("attachment_start")) d.attachments = take_attachments(fields);
  if (fields.has("primitive_kinds")) d.primitives = take_primitives(fields);
  if (fields.has("surface_names")) d.surface_names = fields.take<Names>("surface_names");
  if (fields.has("pin_names")) d.pin_names = fields.take<Names>("pin_names");
  if (fields.has("ignored_pairs")) d.ignored_pairs = take_pairs(fields);
}

/// Read the options of a step.
void take_options(NamedFields& fields, step::Description& d) {
  d.self_contact = fields.take<bool>("self_contact");
  d.dt = fields.take<double>("dt");
  d.scheme = choose<step::SchemeKind>("scheme", step::kSchemes, fields.take<std::string>("scheme"));
  if (fields.has("integrator")) {
    d.integrator = choose<step::Integrator>("integrator", step::kIntegrators,
                                            fields.take<std::string>("integrator"));
  }
  d.metric = choose<step::Metric>("metric", step::kMetrics, fields.take<std::string>("metric"));
  d.elastic = choose<step::ElasticSolver>("elastic", step::kElasticSolvers,
                                          fields.take<std::string>("elastic"));
  d.friction_iterations = fields.take<int>("friction_iterations");
  if (fields.has("begins_at_state")) d.begins_at_state = fields.take<bool>("begins_at_state");
  d.options.tolerance = fields.take<double>("tolerance");
  d.options.max_iterations = fields.take<int>("max_iterations");
  if (fields.has("max_seconds")) d.options.max_seconds = fields.take<double>("max_seconds");
  if (fields.has("certify")) d.options.certify = fields.take<bool>("certify");
  if (fields.has("large_factor")) {  // set by tests only
    d.options.large_factor = fields.take<std::size_t>("large_factor");
  }
  if (fields.has("dear_factor")) d.options.dear_factor = fields.take<double>("dear_factor");
}

}  // namespace

step::Description describe(NamedFields fields) {
  step::Description d;
  take_surfaces(fields, d);
  take_options(fields, d);
  check_description(d);
  if (fields.has("tree_free")) d.mechanisms = take_mechanisms(fields, d.bodies.count());
  fields.refuse_others();
  return d;
}

}  // namespace diffcloth::bind
