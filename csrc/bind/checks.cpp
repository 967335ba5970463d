#include "bind/checks.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <utility>

namespace diffcloth::bind {
namespace {

using step::Extent;

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

void check_attachments(const step::AttachmentDescription& d, std::size_t points) {
  const std::size_t count = d.rest_length.size();
  check_starts("attachment_start", d.start, count, d.point.size());
  require(std::ranges::adjacent_find(d.start) == d.start.end(),
          "`attachment_start` must give every attachment a point");
  check_indices("attachment_points", d.point, static_cast<Index>(points));
  require(d.coefficient.size() == d.point.size() && d.target_row.size() == count,
          "`attachment_coefficients` must be as many as `attachment_points`, and "
          "`attachment_targets` as many as attachments");
  for (const Index target : d.target_row) {
    require(target >= -1 && target < d.target_count, "`attachment_targets` must name their rows");
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

/// Inputs of woven cloth are given in pairs, and only if the scene has material axes.
void check_woven(const step::Scene& scene, const step::Inputs& inputs) {
  using step::Input;
  const auto has = [&](Input input) { return inputs.data(input) != nullptr; };
  require(has(Input::kStretchWeft) == has(Input::kStretchShear),
          "`stretch_weft` and `stretch_shear` must be given together");
  require(has(Input::kBendingWeft) == has(Input::kBendingTwill),
          "`bending_weft` and `bending_twill` must be given together");
  require(!(has(Input::kStretchWeft) || has(Input::kBendingWeft)) || !scene.material_axes.empty(),
          "`stretch_weft` and `bending_weft` need a scene with `material_axes`");
}

/// Return whether a step of the scene needs an input, depending on the other inputs.
bool is_needed(const step::Scene& scene, const step::Inputs& inputs, const step::InputRow& row) {
  switch (row.need) {
    case step::Need::kExtent:
      if (row.extent == Extent::kPerFace || row.extent == Extent::kPerCloth) {
        return scene.cloth_count() > 0;
      }
      return std::ranges::max(accepted_counts(scene, row.extent)) > 0;
    case step::Need::kNowhere:
      return false;
    case step::Need::kCloths:
      return scene.cloth_count() > 0;
    case step::Need::kBarrier:
      return inputs.data(step::Input::kBarrierStiffness) != nullptr;
    case step::Need::kSoftPins:
      return !scene.given.soft_pins.empty();
    case step::Need::kFreeCoordinates:
      return scene.mechanisms.has_free();
  }
  __builtin_unreachable();
}

}  // namespace

void check_description(const step::Description& d) {
  const std::size_t vertices = d.vertices.size() / 3;
  const std::size_t cloths = d.bending_models.size();
  require(d.vertices.size() % 3 == 0 && d.rest_embedding.size() == d.vertices.size(),
          "`vertices` and `rest_embedding` must have one shape, [N, 3]");
  require(d.rest_positions.size() % 3 == 0, "`rest_positions` must have the shape [M, 3]");
  check_faces("faces", d.faces, vertices);
  check_starts("cloth_vertex_start", d.cloth_vertex_start, cloths, vertices);
  check_starts("cloth_face_start", d.cloth_face_start, cloths, d.faces.size());
  require(d.material_axes.empty() || d.material_axes.size() == 2 * d.faces.size(),
          "`material_axes` must have the shape [F, 2]");
  check_indices("pins", d.pins, static_cast<Index>(vertices));
  check_indices("soft_pins", d.soft_pins, static_cast<Index>(vertices));
  require(d.bodies.vertices.size() % 3 == 0 && !d.bodies.vertex_start.empty(),
          "`body_vertices` must have the shape [V, 3], and `body_vertex_start` one entry or more");
  const std::size_t body_vertices = d.bodies.vertices.size() / 3;
  const std::size_t bodies = d.bodies.vertex_start.size() - 1;
  check_starts("body_vertex_start", d.bodies.vertex_start, bodies, body_vertices);
  check_faces("body_faces", d.body_faces, body_vertices);
  require(d.body_radii.empty() || d.body_radii.size() == bodies,
          "`body_radii` must be as many as there are bodies and links");
  for (const auto& pair : d.ignored_pairs) {
    check_indices("ignored_pairs", {pair.begin(), pair.end()}, static_cast<Index>(cloths + bodies));
  }
  check_attachments(d.attachments, vertices + body_vertices);
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
    // Trees are stored one after another, each with one root, which comes first.
    const bool good = link.parent >= -1 && std::cmp_less(link.parent, l) &&
                      link.tree == roots - 1 && (root || m.links[link.parent].tree == link.tree) &&
                      link.coordinate >= -1;
    require(good, "link " + std::to_string(l) + " must stand in its tree, behind its parent");
  }
  require(roots == trees, "every tree must have a root, and a root its tree");
}

std::vector<std::size_t> accepted_counts(const step::Scene& scene, Extent extent) {
  const auto surfaces = static_cast<std::size_t>(scene.surface_count());
  switch (extent) {
    case Extent::kOne:
      return {1};
    case Extent::kVector:
      return {3};
    case Extent::kVertices:
      return {3 * static_cast<std::size_t>(scene.cloth_vertex_count())};
    case Extent::kRestVertices:
      return {3 * static_cast<std::size_t>(scene.rest_vertex_count())};
    case Extent::kAllVertices:
      return {3 * static_cast<std::size_t>(scene.vertex_count())};
    case Extent::kPins:
      return {3 * scene.given.pins.size()};
    case Extent::kSoftPins:
      return {3 * scene.given.soft_pins.size()};
    case Extent::kAttachments:
      return {scene.given.attachments.rest_length.size()};
    case Extent::kTargets:
      return {3 * static_cast<std::size_t>(scene.given.attachments.target_count)};
    case Extent::kPerFace:
      return {1, static_cast<std::size_t>(scene.cloth_count()), scene.topology.faces.size()};
    case Extent::kPerCloth:
      return {1, static_cast<std::size_t>(scene.cloth_count())};
    case Extent::kTrees:
      return {7 * scene.mechanisms.given().tree_free.size()};
    case Extent::kSurfaces:
      return {surfaces};
    case Extent::kPairs:
      return {1, surfaces * surfaces};
    case Extent::kCoordinates:
      return {static_cast<std::size_t>(scene.mechanisms.coordinate_count())};
    case Extent::kJointTerms:
      return {bodies::kJointColumns *
              static_cast<std::size_t>(scene.mechanisms.coordinate_count())};
    case Extent::kBlocks:
      return {squares_of_coordinates(scene)};
  }
  __builtin_unreachable();
}

void check_inputs(const step::Scene& scene, const step::Inputs& inputs) {
  check_woven(scene, inputs);
  for (const step::InputRow& row : step::kInputTable) {
    const step::View& view = inputs[row.input];
    const bool absent = view.data == nullptr && view.count == 0;
    if (absent && !is_needed(scene, inputs, row)) continue;
    const std::vector<std::size_t> accepted = accepted_counts(scene, row.extent);
    if (!absent && std::ranges::find(accepted, view.count) != accepted.end()) continue;
    // Build the message only on failure, because this runs in each step.
    const std::string name = std::string("`") + row.name + "`";
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
