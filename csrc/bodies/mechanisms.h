#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "bodies/exponential.h"
#include "bodies/link.h"
#include "bodies/pose.h"
#include "common/types.h"
#include "linalg/attachments.h"

namespace diffcloth::bodies {

/// What mechanisms are made from. Trees are the bodies of a scene, then its robots.
struct MechanismsDescription {
  std::vector<char> tree_free;  ///< [T] roots that move by dynamics: six coordinates, c and w
  std::vector<Link> links;      ///< tree after tree, parents before their children
  std::vector<Index> coordinate_tree;  ///< [n] those of a free root first, tree after tree
  std::vector<char> prescribed;        ///< [n] coordinates whose values at the end are given
  std::vector<char> held;              ///< [n] those that forces move, prescribed in this solve
  std::vector<double> lower;           ///< [n] limits of free joints; infinite where there are none
  std::vector<double> upper;
  std::vector<double> limit_stiffness;  ///< [n]
  /// Share of its range that a joint can go beyond a limit, and of a limit of its speed.
  double limit_zone = 0.0;
  std::vector<double> velocity_stiffness;  ///< [n] see JointConstants
  std::vector<double> velocity_force;      ///< [n]
  std::vector<Index> surface_link;         ///< [surfaces]
};

/// Trees of rigid links, and how the vertices of their surfaces follow from coordinates.
///
/// The root of a tree has a frame S, a rigid transform. A point of link l with coordinates v in the
/// link's axes is at
///
///   y = c + R(w) (S C_l(q) v)   where the root is free,     y = S C_l(q) v   where it is prescribed,
///
/// with C_l the transform from link l to the root, by the joints between them.
///
/// Coordinates and frames live in nodes of three numbers, so that they can stand among vertices in one
/// list of points: first `node_count` nodes of coordinates, of which each holds only free or only
/// prescribed ones of one tree (and zeros where a group of three is not full), then four nodes a tree:
/// the columns of S. A body that has no coordinate at all is left to BodySet.
class Mechanisms {
 public:
  Mechanisms() = default;

  /// @param bodies  vertices of all surfaces, in the frames of their links
  Mechanisms(MechanismsDescription given, const BodySet& bodies);

  bool empty() const { return trees_.empty(); }
  bool has_free() const { return has_free_; }
  Index tree_count() const { return static_cast<Index>(trees_.size()); }
  Index coordinate_count() const { return static_cast<Index>(slot_.size()); }
  Index node_count() const { return static_cast<Index>(node_prescribed_.size()); }
  Index point_count() const { return node_count() + 4 * tree_count(); }

  const MechanismsDescription& given() const { return given_; }

  /// Place of a coordinate among the numbers of the nodes.
  Index slot(Index coordinate) const { return slot_[coordinate]; }
  bool is_prescribed(Index node) const { return node_prescribed_[node] != 0; }

  /// Nodes of each tree, whose coordinates depend on each other.
  std::vector<std::vector<Index>> cliques() const;

  /// A tree that is one rigid body in free flight: six coordinates, which no joint, drive or limit knows.
  struct FreeBody {
    Index first_node, last_node;
    std::vector<Index> surfaces;  ///< among those of bodies
  };
  std::vector<FreeBody> free_bodies() const;

  /// Whether a surface belongs to these trees, and whether it moves with free coordinates.
  bool has_surface(Index surface) const { return surface_[surface].tree >= 0; }
  bool is_dynamic(Index surface) const { return surface_[surface].dynamic; }
  /// Whether it moves with free coordinates or with held ones: collisions with it count.
  bool collides(Index surface) const { return surface_[surface].collides; }

  /// Frames S of the trees from the poses of all roots, into their nodes.
  void set_frames(const double* poses, double* points) const;
  /// poses_bar += pulled back cotangents of the frames' nodes.
  void set_frames_vjp(const double* poses, const double* points_bar, double* poses_bar) const;

  /// Change of the frames' nodes with a change of the poses.
  void set_frames_jvp(const double* poses, const double* change, double* points) const;

  /// World positions of the vertices of these trees' surfaces, at a configuration.
  void place(const double* points, double* vertices) const;

  /// Set numbers at these vertices to zero.
  void clear(double* vertices) const;

  /// Change of these vertices with a change of the nodes.
  void push_forward(const double* points, const double* change, double* vertices) const;

  /// points_bar += the transpose of push_forward.
  void pull_back(const double* points, const double* vertices_bar, double* points_bar) const;

  /// points_bar += the derivative of  (push_forward of change) . g  with respect to the nodes, for a
  /// change of coordinates (not of frames).
  void pull_back_change(const double* points,
                        const double* change,
                        const double* g,
                        double* points_bar) const;

  /// points_dot += at the nodes of coordinates, the derivative by them of  (push_forward of change) . g,
  /// for a change of coordinates and frames: pull_back_change(), transposed.
  void push_forward_change(const double* points,
                           const double* change,
                           const double* g,
                           double* points_dot) const;

  /// visit(node_i, node_j, block) for all pairs node_i >= node_j of free nodes of a tree: the second
  /// derivative of  vertices . g.
  template <class Visit>
  void visit_curvature(const double* points, const double* g, Visit&& visit) const;

  /// Attachments of all surfaces' vertices, points from `first_point` on, to the free nodes, rows from
  /// `first_row` on. Their Jacobians are still to be filled in.
  linalg::Attachments attachments(Index first_point, Index first_row) const;

  /// Fill in the Jacobians at a configuration.
  void differentiate(const double* points, Index first_row, linalg::Attachments& out) const;

  /// Largest turn of any link with a change of the nodes, summed along its chain [rad].
  double turn(const double* change) const;

  /// Largest turn of any link between two configurations, roots included, summed along its chain.
  double turn_between(const double* from, const double* to) const;

  /// Length that turns a change of a coordinate into one of the links' points [m], 1 for shifts; one
  /// for each number of the nodes, zero where there is no coordinate.
  const std::vector<double>& lever() const { return lever_; }

 private:
  struct Tree {
    Index given;  // place among all trees
    bool free;
    Index first_link, last_link;
    Index first_coordinate, last_coordinate;
    Index first_node, last_node;
    Index frame;  // first of its four nodes among all points
    std::vector<Index> surfaces;
  };
  struct Surface {
    Index tree = -1;  // among trees_; -1: not of these
    Index link = -1;
    bool dynamic = false;
    bool collides = false;
    Index first = 0, last = 0;  // vertices
  };
  struct Eval;

  Eval evaluate(const Tree& tree, const double* points) const;
  static Mat3 turn_rate(const Tree& tree, const Eval& at, const double* change);
  Mat34 link_rate(const Tree& tree, const Eval& at, Index link, const double* change) const;
  std::vector<Mat34> moments(const Tree& tree, const double* vertices) const;
  static void add_to_frame(const Tree& tree, const Mat34& bar, double* points_bar);
  Eigen::MatrixXd curvature(const Tree& tree,
                            const Eval& at,
                            const std::vector<Mat34>& moment) const;
  Eigen::MatrixXd curvature(const Tree& tree, const double* points, const double* g) const;

  /// What the constructor fills, in this order; the first gives the tree here of each given one, or -1.
  std::vector<Index> make_trees();
  void assign_slots(const Tree& tree);
  void make_paths();
  void make_surfaces(const BodySet& bodies, const std::vector<Index>& tree_of);
  void find_levers();

  MechanismsDescription given_;
  std::vector<double> vertices_;
  std::vector<Tree> trees_;
  std::vector<Surface> surface_;
  std::vector<std::vector<Index>> path_;  // [links] joints that move it, root first
  std::vector<Index> slot_;
  std::vector<char> node_prescribed_;
  std::vector<double> lever_;
  bool has_free_ = false;
};

template <class Visit>
void Mechanisms::visit_curvature(const double* points, const double* g, Visit&& visit) const {
  for (const Tree& tree : trees_) {
    const Eigen::MatrixXd all = curvature(tree, points, g);
    const Index count = tree.last_node - tree.first_node;
    for (Index i = 0; i < count; ++i) {
      if (is_prescribed(tree.first_node + i)) continue;
      for (Index j = 0; j <= i; ++j) {
        if (is_prescribed(tree.first_node + j)) continue;
        visit(tree.first_node + i, tree.first_node + j, Mat3(all.block<3, 3>(3 * i, 3 * j)));
      }
    }
  }
}

}  // namespace diffcloth::bodies
