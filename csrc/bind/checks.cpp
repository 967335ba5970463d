#include "bind/checks.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <utility>

namespace diffcloth::bind {
namespace {

using step::Input;

void require(bool holds, const std::string& what) {
  if (!holds) throw std::invalid_argument("core: " + what);
}

void check_indices(const char* name, const std::vector<Index>& indices, Index count) {
  for (std::size_t k = 0; k < indices.size(); ++k) {
    require(indices[k] >= 0 && indices[k] < count,
            std::string("`") + name + "` must be in 0 .. " + std::to_string(count - 1) + ", got " +
                std::to_string(indices[k]) + " at [" + std::to_string(k) + "]");
  }
}

void check_starts(const char* name,
                  const std::vector<Index>& starts,
                  std::size_t owners,
                  std::size_t items) {
  const bool good = starts.size() == owners + 1 && starts.front() == 0 &&
                    std::cmp_equal(starts.back(), items) && std::ranges::is_sorted(starts);
  require(good, std::string("`") + name + "` must rise from 0 to " + std::to_string(items) +
                    " over " + std::to_string(owners) + " surfaces");
}

void check_faces(const char* name,
                 const std::vector<std::array<Index, 3>>& faces,
                 std::size_t vertices) {
  for (const auto& face : faces) {
    check_indices(name, {face.begin(), face.end()}, static_cast<Index>(vertices));
  }
}

std::size_t squares_of_coordinates(const step::Scene& scene) {
  const std::vector<Index>& tree = scene.mechanisms.given().coordinate_tree;
  std::size_t result = 0;
  for (std::size_t first = 0; first < tree.size();) {
    std::size_t last = first;
    while (last < tree.size() && tree[last] == tree[first]) ++last;
    result += (last - first) * (last - first);
    first = last;
  }
  return result;
}

/// Whether a step of the scene reads an input, given which others there are.
bool is_needed(const step::Scene& scene, const step::Inputs& inputs, Input input) {
  switch (input) {
    case Input::kPoisson:
    case Input::kRestPositions:
    case Input::kBarrierStiffness:
    case Input::kCoordinateOrigins:
      return false;
    case Input::kFriction:
    case Input::kThickness:
    case Input::kBarrierDistance:
    case Input::kSlipVelocity:
      return inputs.data(Input::kBarrierStiffness) != nullptr;
    case Input::kStretch:
    case Input::kBending:
    case Input::kDensity:
    case Input::kDamping:
      return scene.cloth_count() > 0;
    case Input::kPinStiffness:
      return !scene.given.soft_pins.empty();
    case Input::kCoordinateTargets:
    case Input::kCoordinateMetric:
      return scene.mechanisms.has_free();
    default:
      return std::ranges::max(accepted_counts(scene, input)) > 0;
  }
}

}  // namespace

void check_description(const step::Description& d) {
  const std::size_t vertices = d.vertices.size() / 3;
  const std::size_t cloths = d.bending_models.size();
  require(d.vertices.size() % 3 == 0 && d.rest_vertices.size() == d.vertices.size(),
          "`vertices` and `rest_vertices` must have one shape, [N, 3]");
  check_faces("faces", d.faces, vertices);
  check_starts("cloth_vertex_start", d.cloth_vertex_start, cloths, vertices);
  check_starts("cloth_face_start", d.cloth_face_start, cloths, d.faces.size());
  check_indices("pins", d.pins, static_cast<Index>(vertices));
  check_indices("soft_pins", d.soft_pins, static_cast<Index>(vertices));
  require(d.bodies.vertices.size() % 3 == 0 && !d.bodies.vertex_start.empty(),
          "`body_vertices` must have the shape [V, 3], and `body_vertex_start` one entry or more");
  const std::size_t body_vertices = d.bodies.vertices.size() / 3;
  const std::size_t bodies = d.bodies.vertex_start.size() - 1;
  check_starts("body_vertex_start", d.bodies.vertex_start, bodies, body_vertices);
  check_faces("body_faces", d.body_faces, body_vertices);
  for (const auto& pair : d.ignored_pairs) {
    check_indices("ignored_pairs", {pair.begin(), pair.end()}, static_cast<Index>(cloths + bodies));
  }
  require(d.surface_names.empty() || d.surface_names.size() == cloths + bodies,
          "`surface_names` must be as many as there are surfaces");
  require(d.pin_names.empty() || d.pin_names.size() == d.pins.size(),
          "`pin_names` must be as many as there are pins");
  require(std::isfinite(d.dt) && d.dt > 0.0, "`dt` must be finite and > 0");
  require(d.friction_iterations >= 1 && d.options.max_iterations >= 1,
          "`friction_iterations` and `max_iterations` must be at least 1");
}

void check_mechanisms(const bodies::MechanismsDescription& m, Index surfaces) {
  const auto trees = static_cast<Index>(m.tree_free.size());
  require(std::cmp_equal(m.surface_link.size(), surfaces),
          "`surface_link` must have one link a body, " + std::to_string(surfaces));
  Index roots = 0;
  for (std::size_t l = 0; l < m.links.size(); ++l) {
    const bodies::Link& link = m.links[l];
    const bool root = link.parent == -1;
    roots += root ? 1 : 0;
    // Trees go one after the other, each with one root, which comes first.
    const bool good = link.parent >= -1 && std::cmp_less(link.parent, l) &&
                      link.tree == roots - 1 && (root || m.links[link.parent].tree == link.tree) &&
                      link.coordinate >= -1;
    require(good, "link " + std::to_string(l) + " must stand in its tree, behind its parent");
  }
  require(roots == trees, "every tree must have a root, and a root its tree");
}

std::vector<std::size_t> accepted_counts(const step::Scene& scene, Input input) {
  const auto n = static_cast<std::size_t>(scene.cloth_vertex_count());
  const std::size_t faces = scene.topology.faces.size();
  const auto cloths = static_cast<std::size_t>(scene.cloth_count());
  const auto surfaces = static_cast<std::size_t>(scene.surface_count());
  switch (input) {
    case Input::kPositions:
    case Input::kVelocities:
    case Input::kForces:
    case Input::kRestPositions:
      return {3 * n};
    case Input::kBodyPoses:
    case Input::kBodyTargets:
      return {7 * scene.mechanisms.given().tree_free.size()};
    case Input::kPinTargets:
      return {3 * scene.given.pins.size()};
    case Input::kSoftPinTargets:
      return {3 * scene.given.soft_pins.size()};
    case Input::kGravity:
      return {3};
    case Input::kStretch:
    case Input::kBending:
    case Input::kPoisson:
    case Input::kDensity:
    case Input::kDamping:
      return {1, cloths, faces};
    case Input::kFriction:
    case Input::kBarrierStiffness:
      return {1, surfaces * surfaces};
    case Input::kThickness:
      return {surfaces};
    case Input::kBarrierDistance:
    case Input::kSlipVelocity:
      return {1};
    case Input::kPinStiffness:
      return {1, cloths};
    case Input::kCoordinates:
    case Input::kCoordinateEnds:
    case Input::kCoordinateOrigins:
    case Input::kCoordinateTargets:
      return {static_cast<std::size_t>(scene.mechanisms.coordinate_count())};
    case Input::kCoordinateMetric:
      return {squares_of_coordinates(scene)};
  }
  return {};
}

void check_inputs(const step::Scene& scene, const step::Inputs& inputs) {
  for (std::size_t k = 0; k < step::kInputCount; ++k) {
    const auto input = static_cast<Input>(k);
    const step::View& view = inputs[input];
    const bool absent = view.data == nullptr && view.count == 0;
    if (absent && !is_needed(scene, inputs, input)) continue;
    const std::vector<std::size_t> accepted = accepted_counts(scene, input);
    if (!absent && std::ranges::find(accepted, view.count) != accepted.end()) continue;
    // Words only for what is wrong: each step comes by here.
    const std::string name = std::string("`") + step::kInputNames[k] + "`";
    require(!absent, name + " is missing");
    std::string counts;
    for (const std::size_t count : accepted) {
      counts += (counts.empty() ? "" : " or ") + std::to_string(count);
    }
    require(false, name + " must have " + counts + " numbers for each environment, got " +
                       std::to_string(view.count));
  }
}

}  // namespace diffcloth::bind
