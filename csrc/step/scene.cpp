#include "step/scene.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <sstream>
#include <utility>

namespace diffcloth::step {
namespace {

contact::CollisionMesh make_collision_mesh(const Description& d,
                                           const bodies::Mechanisms& mechanisms) {
  const auto cloth_vertices = static_cast<Index>(d.vertices.size() / 3);
  const auto cloths = static_cast<Index>(d.bending_models.size());
  std::vector<std::array<Index, 3>> faces = d.faces;
  for (const auto& face : d.body_faces) {
    faces.push_back({face[0] + cloth_vertices, face[1] + cloth_vertices, face[2] + cloth_vertices});
  }
  std::vector<Index> surface(static_cast<std::size_t>(cloth_vertices + d.bodies.vertex_count()));
  for (Index c = 0; c < cloths; ++c) {
    std::fill(surface.begin() + d.cloth_vertex_start[c],
              surface.begin() + d.cloth_vertex_start[c + 1], c);
  }
  std::vector<std::array<Index, 2>> ignored = d.ignored_pairs;
  for (std::size_t k = 0; k < d.primitives.size(); ++k) {
    if (d.primitives[k].kind == projective::PrimitiveKind::kNone) continue;
    for (Index c = 0; c < cloths; ++c) ignored.push_back({c, cloths + static_cast<Index>(k)});
  }
  std::vector<char> dynamic;
  for (Index k = 0; k < d.bodies.count(); ++k) {
    dynamic.push_back(mechanisms.collides(k) ? 1 : 0);
    std::fill(surface.begin() + cloth_vertices + d.bodies.vertex_start[k],
              surface.begin() + cloth_vertices + d.bodies.vertex_start[k + 1], cloths + k);
  }
  std::vector<double> radius;
  if (!d.body_radii.empty()) {
    radius.assign(static_cast<std::size_t>(cloths), 0.0);
    radius.insert(radius.end(), d.body_radii.begin(), d.body_radii.end());
  }
  return {std::move(faces), std::move(surface), cloths,
          contact::touching_surfaces({.surface_count = cloths + d.bodies.count(),
                                      .cloth_count = cloths,
                                      .self_contact = d.self_contact,
                                      .body_dynamic = dynamic,
                                      .ignored = ignored}),
          std::move(radius)};
}

/// All surfaces as given: the reference for the collision trees.
std::vector<double> reference_positions(const Description& d) {
  std::vector<double> x = d.vertices;
  x.insert(x.end(), d.bodies.vertices.begin(), d.bodies.vertices.end());
  return x;
}

/// All surfaces at rest in space, bodies in their own frames.
std::vector<double> all_at_rest(const Description& d) {
  std::vector<double> x = d.rest_embedding;
  x.insert(x.end(), d.bodies.vertices.begin(), d.bodies.vertices.end());
  return x;
}

std::vector<Vec2> vectors(const std::vector<double>& rows) {
  std::vector<Vec2> result;
  for (std::size_t k = 0; k + 1 < rows.size(); k += 2) result.emplace_back(rows[k], rows[k + 1]);
  return result;
}

std::vector<Index> owners(const std::vector<Index>& start) {
  std::vector<Index> owner(static_cast<std::size_t>(start.back()));
  for (std::size_t c = 0; c + 1 < start.size(); ++c) {
    std::fill(owner.begin() + start[c], owner.begin() + start[c + 1], static_cast<Index>(c));
  }
  return owner;
}

std::vector<mesh::BendingModel> face_models(const Description& d) {
  std::vector<mesh::BendingModel> model;
  for (std::size_t c = 0; c < d.bending_models.size(); ++c) {
    model.insert(model.end(),
                 static_cast<std::size_t>(d.cloth_face_start[c + 1] - d.cloth_face_start[c]),
                 d.bending_models[c]);
  }
  return model;
}

double mean_length(const mesh::RestShape& rest,
                   const contact::CollisionMesh& mesh,
                   const bodies::BodySet& bodies) {
  double sum = 0.0;
  if (!rest.edge_length_sq.empty()) {
    for (const double length_sq : rest.edge_length_sq) sum += std::sqrt(length_sq);
    return sum / static_cast<double>(rest.edge_length_sq.size());
  }
  for (const auto& [i, j] : mesh.edges) {
    sum += (row(bodies.vertices.data(), j) - row(bodies.vertices.data(), i)).norm();
  }
  // Round bodies include their radius.
  std::size_t count = mesh.edges.size();
  for (const double radius : mesh.radius) {
    sum += radius;
    count += radius > 0.0 ? 1 : 0;
  }
  return sum / static_cast<double>(count);
}

/// The mechanisms as given; by default, each body is a tree of one link without coordinates.
bodies::MechanismsDescription complete(const Description& d) {
  bodies::MechanismsDescription m = d.mechanisms;
  if (!m.tree_free.empty()) return m;
  for (Index k = 0; k < d.bodies.count(); ++k) {
    m.tree_free.push_back(0);
    m.surface_link.push_back(k);
    bodies::Link link{.tree = k,
                      .parent = -1,
                      .kind = bodies::kFixedJoint,
                      .offset = bodies::Mat34::Identity(),
                      .axis = Vec3::Zero(),
                      .coordinate = -1,
                      .multiplier = 0.0,
                      .constant = 0.0};
    m.links.push_back(link);
  }
  return m;
}

/// Index of the pose that places a surface: of its tree, unless the tree has coordinates.
std::vector<Index> surface_poses(const bodies::Mechanisms& mechanisms) {
  std::vector<Index> pose;
  const bodies::MechanismsDescription& given = mechanisms.given();
  for (std::size_t s = 0; s < given.surface_link.size(); ++s) {
    const bool own = !mechanisms.has_surface(static_cast<Index>(s));
    pose.push_back(own ? given.links[given.surface_link[s]].tree : -1);
  }
  return pose;
}

std::vector<char> make_prescribed(const Description& d, const bodies::Mechanisms& mechanisms) {
  std::vector<char> prescribed(d.vertices.size() / 3, 0);
  for (const Index i : d.pins) prescribed[i] = 1;
  for (Index k = 0; k < d.bodies.count(); ++k) {
    const Index count = d.bodies.vertex_start[k + 1] - d.bodies.vertex_start[k];
    prescribed.insert(prescribed.end(), static_cast<std::size_t>(count),
                      mechanisms.is_dynamic(k) ? 0 : 1);
  }
  for (Index k = 0; k < mechanisms.node_count(); ++k) {
    prescribed.push_back(mechanisms.is_prescribed(k) ? 1 : 0);
  }
  prescribed.insert(prescribed.end(), 4 * static_cast<std::size_t>(mechanisms.tree_count()), 1);
  return prescribed;
}

/// Face searches of the bodies in contact with nodes.
std::vector<projective::FaceSearch> face_searches(const Description& d) {
  std::vector<projective::FaceSearch> searches(d.primitives.size());
  for (std::size_t k = 0; k < d.primitives.size(); ++k) {
    if (d.primitives[k].kind == projective::PrimitiveKind::kNone) continue;
    std::vector<std::array<Index, 3>> faces;
    for (const auto& face : d.body_faces) {
      const bool own =
          face[0] >= d.bodies.vertex_start[k] && face[0] < d.bodies.vertex_start[k + 1];
      if (own) faces.push_back(face);
    }
    searches[k] = projective::FaceSearch(std::move(faces), d.bodies.vertices);
  }
  return searches;
}

/// Spheres half as large as the shortest edge at their vertex at rest; the two spheres of an edge never touch.
projective::VertexSpheres make_vertex_spheres(const Description& d,
                                              const contact::CollisionMesh& mesh) {
  const double* const X = d.rest_embedding.data();
  const std::size_t n = d.rest_embedding.size() / 3;
  projective::VertexSpheres spheres;
  spheres.radius.assign(n, std::numeric_limits<double>::infinity());
  spheres.apart.resize(n);
  for (Index e = 0; e < mesh.cloth_edge_count; ++e) {
    const auto& [i, j] = mesh.edges[e];
    const double length = (row(X, i) - row(X, j)).norm();
    for (const auto& [a, b] : {std::pair{i, j}, std::pair{j, i}}) {
      spheres.radius[a] = std::min(spheres.radius[a], 0.5 * length);
      spheres.apart[a].push_back(b);
    }
  }
  for (auto& others : spheres.apart) std::ranges::sort(others);
  return spheres;
}

/// Flags of prescribed rows: the cloth's vertices and the nodes of coordinates.
std::vector<char> fixed_rows(const std::vector<char>& prescribed,
                             Index cloth_vertex_count,
                             const bodies::Mechanisms& mechanisms) {
  std::vector<char> fixed(prescribed.begin(), prescribed.begin() + cloth_vertex_count);
  const auto frames = prescribed.end() - 4 * mechanisms.tree_count();
  fixed.insert(fixed.end(), frames - mechanisms.node_count(), frames);
  return fixed;
}

/// Cliques of elements, and of the cloths' vertices that share a spring.
std::vector<std::vector<Index>> cloth_cliques(const Description& d,
                                              const mesh::Topology& topology,
                                              const mesh::BendingStencils& stencils) {
  std::vector<std::vector<Index>> cliques = elastic::cliques(topology, stencils);
  const AttachmentDescription& attached = d.attachments;
  for (std::size_t a = 0; a + 1 < attached.start.size(); ++a) {
    std::vector<Index> clique;
    for (Index k = attached.start[a]; k < attached.start[a + 1]; ++k) {
      if (attached.point[k] < topology.vertex_count) clique.push_back(attached.point[k]);
    }
    if (clique.size() > 1) cliques.push_back(std::move(clique));
  }
  return cliques;
}

/// A pattern of the cloths, followed by the nodes of coordinates.
linalg::BlockPattern with_nodes(Index cloth_vertex_count,
                                std::vector<std::vector<Index>> cliques,
                                const bodies::Mechanisms& mechanisms) {
  for (std::vector<Index> clique : mechanisms.cliques()) {
    for (Index& node : clique) node += cloth_vertex_count;
    cliques.push_back(std::move(clique));
  }
  return {cloth_vertex_count + mechanisms.node_count(), cliques};
}

/// Free bodies without springs: without contact, only inertia and the given forces move them.
std::vector<bodies::Mechanisms::FreeBody> find_free_bodies(const Description& d,
                                                           const bodies::Mechanisms& mechanisms,
                                                           const contact::CollisionMesh& mesh) {
  std::vector<char> attached(mesh.surface_count(), 0);
  for (const Index i : d.attachments.point) attached[mesh.vertex_surface[i]] = 1;
  std::vector<bodies::Mechanisms::FreeBody> result = mechanisms.free_bodies();
  const auto cloths = static_cast<Index>(d.bending_models.size());
  for (auto& body : result) {
    for (Index& surface : body.surfaces) surface += cloths;
  }
  std::erase_if(result, [&](const bodies::Mechanisms::FreeBody& body) {
    return std::ranges::any_of(body.surfaces, [&](Index s) { return attached[s] != 0; });
  });
  return result;
}

}  // namespace

Scene::Scene(Description description)
    : given(std::move(description)),
      topology(static_cast<Index>(given.vertices.size() / 3),
               given.faces,
               static_cast<Index>(given.rest_positions.size() / 3),
               given.rest_faces),
      face_cloth(owners(given.cloth_face_start)),
      material_axes(vectors(given.material_axes)),
      vertex_cloth(owners(given.cloth_vertex_start)),
      stencils(mesh::choose_stencils(topology, given.rest_positions.data(), face_models(given))),
      rest(mesh::rest_shape(topology, stencils, given.rest_positions.data())),
      mechanisms(complete(given), given.bodies),
      collision_mesh(make_collision_mesh(given, mechanisms)),
      free_bodies(find_free_bodies(given, mechanisms, collision_mesh)),
      mean_edge(mean_length(rest, collision_mesh, given.bodies)),
      prescribed(make_prescribed(given, mechanisms)),
      measures(contact::measure(collision_mesh, all_at_rest(given).data())),
      feature_weights(collision_mesh, all_at_rest(given).data(), prescribed),
      broad_phase(collision_mesh, reference_positions(given).data()),
      face_search(face_searches(given)),
      vertex_spheres(scheme().has_barrier ? projective::VertexSpheres()
                                          : make_vertex_spheres(given, collision_mesh)),
      elastic_patterns(
          with_nodes(topology.vertex_count, cloth_cliques(given, topology, stencils), mechanisms),
          fixed_rows(prescribed, topology.vertex_count, mechanisms)),
      diagonal_patterns(with_nodes(topology.vertex_count, {}, mechanisms),
                        fixed_rows(prescribed, topology.vertex_count, mechanisms)),
      constant_matrices(elastic_patterns.base(),
                        {prescribed.begin(), prescribed.begin() + topology.vertex_count}) {
  given.bodies.pose = surface_poses(mechanisms);
  slots = elastic::slots(topology, stencils, elastic_patterns.base());
  held_elements = elastic::elements_at(topology, stencils, prescribed);
}

bool Scene::has_attached_bodies() const {
  return std::ranges::any_of(given.attachments.point,
                             [&](Index i) { return i >= cloth_vertex_count(); });
}

contact::RestMeasures rest_measures(const Scene& scene, const mesh::RestShape& rest) {
  contact::RestMeasures m = scene.measures;
  std::ranges::copy(rest.area, m.face_area.begin());
  std::ranges::copy(rest.vertex_area, m.vertex_area.begin());
  std::ranges::copy(rest.edge_area, m.edge_area.begin());
  std::ranges::copy(rest.edge_length_sq, m.edge_length_sq.begin());
  const std::vector<Index>& start = scene.given.cloth_face_start;
  for (Index c = 0; c < scene.cloth_count(); ++c) {
    const double sum =
        std::accumulate(rest.area.begin() + start[c], rest.area.begin() + start[c + 1], 0.0);
    m.mean_face_area[c] = sum / (start[c + 1] - start[c]);
  }
  return m;
}

namespace {

std::string quoted(const std::string& name) { return "'" + name + "'"; }

/// "cloth 'shirt'", "body 'table'", "link 'hand/palm'": a surface in messages.
std::string describe_surface(const Scene& scene, Index surface) {
  const std::vector<std::string>& names = scene.given.surface_names;
  const bool is_cloth = surface < scene.cloth_count();
  if (names.empty()) {
    return is_cloth ? "cloth " + std::to_string(surface)
                    : "body " + std::to_string(surface - scene.cloth_count());
  }
  // No other names have a slash.
  const bool is_link = names[surface].find('/') != std::string::npos;
  const char* const kind = is_cloth ? "cloth " : is_link ? "link " : "body ";
  return kind + quoted(names[surface]);
}

/// "cloth 'shirt' edge (3, 8)": a primitive by its surface and that surface's own vertex numbers.
std::string describe(const Scene& scene, const char* kind, std::initializer_list<Index> vertices) {
  const Index surface = scene.collision_mesh.vertex_surface[*vertices.begin()];
  const bool is_cloth = surface < scene.cloth_count();
  if (scene.collision_mesh.is_round(surface)) return describe_surface(scene, surface);
  const Index first = is_cloth ? scene.given.cloth_vertex_start[surface]
                               : scene.cloth_vertex_count() +
                                     scene.given.bodies.vertex_start[surface - scene.cloth_count()];
  std::string text = describe_surface(scene, surface) + " " + kind + " (";
  const char* separator = "";
  for (const Index v : vertices) {
    text += separator + std::to_string(v - first);
    separator = ", ";
  }
  return text + ")";
}

}  // namespace

std::optional<ClosePair> find_closest(const Scene& scene,
                                      const double* x,
                                      const std::vector<double>& thickness,
                                      double reach,
                                      const std::vector<contact::Candidate>& candidates) {
  const std::vector<Index>& surface = scene.collision_mesh.vertex_surface;
  const std::vector<double>& radius = scene.collision_mesh.radius;
  std::optional<ClosePair> closest;
  for (const contact::Candidate& pair : candidates) {
    const auto& v = pair.vertices;
    const Index s = surface[v[0]];
    const Index r = surface[v[3]];
    const double xi = 0.5 * (thickness[s] + thickness[r]) + (radius[s] + radius[r]);
    const double d = std::sqrt(contact::distance_sq(pair.kind, contact::corners(v, x)));
    if (d - xi > reach || (closest && d - xi >= closest->distance - closest->thickness)) continue;
    closest = {.distance = d, .thickness = xi, .pair = pair};
  }
  return closest;
}

std::vector<contact::Candidate> find_near(const Scene& scene,
                                          const double* x,
                                          const std::vector<double>& thickness,
                                          double reach,
                                          contact::BroadPhase::Scratch& scratch) {
  std::vector<double> half(thickness);
  for (std::size_t s = 0; s < half.size(); ++s) {
    half[s] = 0.5 * (half[s] + reach) + scene.collision_mesh.radius[s];
  }
  std::vector<contact::Candidate> candidates;
  scene.broad_phase.find(x, x, half, scratch, candidates);
  return candidates;
}

std::string describe_pair(const Scene& scene, const contact::Candidate& pair) {
  const auto& v = pair.vertices;
  if (pair.kind == contact::PairKind::kPointTriangle) {
    return describe(scene, "vertex", {v[0]}) + " and " +
           describe(scene, "face", {v[1], v[2], v[3]});
  }
  return describe(scene, "edge", {v[0], v[1]}) + " and " + describe(scene, "edge", {v[2], v[3]});
}

std::string describe_near(const Scene& scene,
                          const double* x,
                          const std::vector<double>& thickness,
                          double reach) {
  const std::vector<Index>& surface = scene.collision_mesh.vertex_surface;
  std::vector<char> involved(static_cast<std::size_t>(scene.vertex_count()), 0);
  std::vector<char> near(static_cast<std::size_t>(scene.surface_count()), 0);
  contact::BroadPhase::Scratch scratch;
  for (const contact::Candidate& pair : find_near(scene, x, thickness, reach, scratch)) {
    if (!find_closest(scene, x, thickness, reach, {pair})) continue;
    for (const Index v : pair.vertices) {
      involved[v] = 1;
      near[surface[v]] = 1;
    }
  }
  std::vector<std::string> pins(near.size());
  const std::string* last = nullptr;
  for (std::size_t p = 0; p < scene.given.pin_names.size(); ++p) {
    const Index v = scene.given.pins[p];
    const std::string& name = scene.given.pin_names[p];
    if (!involved[v] || (last != nullptr && *last == name)) continue;
    last = &name;
    std::string& text = pins[surface[v]];
    text += (text.empty() ? " (pins " : ", ") + quoted(name.substr(name.find('/') + 1));
  }
  std::string text;
  for (Index s = 0; s < scene.surface_count(); ++s) {
    if (!near[s]) continue;
    text += (text.empty() ? "" : ", ") + describe_surface(scene, s);
    if (!pins[s].empty()) text += pins[s] + ")";
  }
  return text;
}

std::string find_overlap(const Scene& scene,
                         const double* x,
                         const std::vector<double>& thickness,
                         const std::vector<contact::Candidate>& candidates,
                         contact::BroadPhase::Scratch& scratch) {
  const contact::CollisionMesh& mesh = scene.collision_mesh;
  if (const auto pair = scene.broad_phase.find_intersection(x, scratch)) {
    const auto& e = mesh.edges[pair->first];
    const auto& f = mesh.faces[pair->second];
    return describe(scene, "edge", {e[0], e[1]}) + " intersects " +
           describe(scene, "face", {f[0], f[1], f[2]});
  }
  const std::optional<ClosePair> closest = find_closest(scene, x, thickness, 0.0, candidates);
  if (!closest) return {};
  const std::string elements = describe_pair(scene, closest->pair);
  if (closest->distance == 0.0) return elements + " touch";
  const auto& v = closest->pair.vertices;
  const double radii =
      mesh.radius[mesh.vertex_surface[v[0]]] + mesh.radius[mesh.vertex_surface[v[3]]];
  std::ostringstream text;
  if (closest->distance < radii) {
    text << elements << " overlap by " << radii - closest->distance << " m";
    return text.str();
  }
  text << elements << " are " << closest->distance - radii
       << " m apart, closer than their thickness " << closest->thickness - radii << " m";
  return text.str();
}

}  // namespace diffcloth::step
