// Constant data of mechanisms: trees, nodes of coordinates, paths of joints, surfaces and levers.

#include <algorithm>
#include <cmath>
#include <ranges>
#include <utility>

#include "bodies/mechanism_eval.h"
#include "bodies/mechanisms.h"

namespace diffcloth::bodies {

Mechanisms::Mechanisms(MechanismsDescription description, const BodySet& bodies)
    : given_(std::move(description)), vertices_(bodies.vertices) {
  const std::vector<Index> tree_of = make_trees();
  make_paths();
  make_surfaces(bodies, tree_of);
  find_levers();
}

std::vector<Index> Mechanisms::make_trees() {
  const auto n = static_cast<Index>(given_.coordinate_tree.size());
  slot_.assign(static_cast<std::size_t>(n), -1);
  std::vector<Index> tree_of(given_.tree_free.size(), -1);
  Index coordinate = 0;
  Index link = 0;
  for (Index t = 0; t < static_cast<Index>(given_.tree_free.size()); ++t) {
    Tree tree{.given = t,
              .free = given_.tree_free[t] != 0,
              .first_link = link,
              .last_link = link,
              .first_coordinate = coordinate,
              .last_coordinate = coordinate,
              .first_node = node_count(),
              .last_node = node_count(),
              .frame = 0,
              .surfaces = {}};
    while (link < static_cast<Index>(given_.links.size()) && given_.links[link].tree == t) ++link;
    while (coordinate < n && given_.coordinate_tree[coordinate] == t) ++coordinate;
    tree.last_link = link;
    tree.last_coordinate = coordinate;
    const bool is_obstacle =
        tree.last_coordinate == tree.first_coordinate && tree.last_link == tree.first_link + 1;
    if (is_obstacle) continue;
    assign_slots(tree);
    tree.last_node = node_count();
    tree_of[t] = tree_count();
    trees_.push_back(tree);
  }
  for (std::size_t t = 0; t < trees_.size(); ++t) {
    trees_[t].frame = node_count() + 4 * static_cast<Index>(t);
  }
  return tree_of;
}

void Mechanisms::assign_slots(const Tree& tree) {
  for (const char prescribed : {char{0}, char{1}}) {
    Index in_node = 3;
    for (Index c = tree.first_coordinate; c < tree.last_coordinate; ++c) {
      if (given_.prescribed[c] != prescribed) continue;
      if (in_node == 3) {
        node_prescribed_.push_back(prescribed);
        in_node = 0;
      }
      slot_[c] = 3 * (node_count() - 1) + in_node++;
      has_free_ = has_free_ || prescribed == 0;
    }
  }
}

void Mechanisms::make_paths() {
  path_.resize(given_.links.size());
  for (std::size_t l = 0; l < given_.links.size(); ++l) {
    const Link& own = given_.links[l];
    if (own.parent >= 0) path_[l] = path_[own.parent];
    if (own.moves()) path_[l].push_back(static_cast<Index>(l));
  }
}

void Mechanisms::make_surfaces(const BodySet& bodies, const std::vector<Index>& tree_of) {
  for (std::size_t s = 0; s < given_.surface_link.size(); ++s) {
    const Index l = given_.surface_link[s];
    Surface surface{.tree = tree_of[given_.links[l].tree],
                    .link = l,
                    .dynamic = false,
                    .collides = false,
                    .first = bodies.vertex_start[s],
                    .last = bodies.vertex_start[s + 1]};
    if (surface.tree >= 0) trees_[surface.tree].surfaces.push_back(static_cast<Index>(s));
    // The six coordinates of a free root are either all free or all prescribed.
    const auto moves_with_any = [&](auto&& counts) {
      return (surface.tree >= 0 && trees_[surface.tree].free &&
              counts(trees_[surface.tree].first_coordinate)) ||
             std::ranges::any_of(
                 path_[l], [&](Index joint) { return counts(given_.links[joint].coordinate); });
    };
    surface.dynamic = moves_with_any([&](Index c) { return given_.prescribed[c] == 0; });
    surface.collides =
        moves_with_any([&](Index c) { return given_.prescribed[c] == 0 || given_.held[c] != 0; });
    surface_.push_back(surface);
  }
}

std::vector<std::vector<Index>> Mechanisms::cliques() const {
  std::vector<std::vector<Index>> result;
  for (const Tree& tree : trees_) {
    std::vector<Index> nodes;
    for (Index k = tree.first_node; k < tree.last_node; ++k) nodes.push_back(k);
    result.push_back(std::move(nodes));
  }
  return result;
}

std::vector<Mechanisms::FreeBody> Mechanisms::free_bodies() const {
  std::vector<FreeBody> result;
  for (const Tree& tree : trees_) {
    constexpr Index kRigid = 6;
    if (!tree.free || tree.last_coordinate - tree.first_coordinate != kRigid) continue;
    const auto nodes = std::views::iota(tree.first_node, tree.last_node);
    if (std::ranges::any_of(nodes, [&](Index node) { return is_prescribed(node); })) continue;
    result.push_back(
        {.first_node = tree.first_node, .last_node = tree.last_node, .surfaces = tree.surfaces});
  }
  return result;
}

void Mechanisms::find_levers() {
  lever_.assign(3 * static_cast<std::size_t>(node_count()), 0.0);
  // Configuration with all joints at zero.
  std::vector<double> zero(3 * static_cast<std::size_t>(point_count()), 0.0);
  for (const Tree& tree : trees_) {
    for (int a = 0; a < 3; ++a) zero[3 * (tree.frame + a) + a] = 1.0;
    const Eval e = evaluate(tree, zero.data());
    std::vector<Vec3> all;
    double largest = 0.0;
    for (Index l = tree.first_link; l < tree.last_link; ++l) {
      const Index at = l - tree.first_link;
      std::vector<Vec3> points{e.to_root[at].col(3)};
      for (const Index surface : tree.surfaces) {
        const Surface& s = surface_[surface];
        if (s.link != l) continue;
        if (s.first < s.last) points.clear();
        for (Index v = s.first; v < s.last; ++v) {
          points.push_back(apply(e.to_root[at], row(vertices_.data(), v)));
        }
      }
      all.insert(all.end(), points.begin(), points.end());
      for (const Index joint : path_[l]) {
        const Link& link = given_.links[joint];
        double& lever = lever_[slot_[link.coordinate]];
        lever = std::max(lever, std::abs(link.slide()));
        if (link.kind.turn == 0.0) continue;
        const Vec3 origin = e.links[joint - tree.first_link].origin;
        for (const Vec3& p : points) {
          const double way = std::abs(link.turn()) * (p - origin).norm();
          lever = std::max(lever, way + std::abs(link.slide()));
        }
        largest = std::max(largest, lever);
      }
    }
    Vec3 mean = Vec3::Zero();
    for (const Vec3& p : all) mean += p / static_cast<double>(all.size());
    double reach = 0.0;
    for (const Vec3& p : all) reach = std::max(reach, (p - mean).norm());
    for (Index c = tree.first_coordinate; c < tree.last_coordinate; ++c) {
      const Index k = c - tree.first_coordinate;
      double& lever = lever_[slot_[c]];
      if (tree.free && k < 6) lever = k < 3 ? 1.0 : reach;
      // Joints that rotate only points on their axis, or none, get the largest lever of the others.
      if (lever == 0.0) lever = largest > 0.0 ? largest : std::max(reach, 1.0);
    }
  }
}

}  // namespace diffcloth::bodies
