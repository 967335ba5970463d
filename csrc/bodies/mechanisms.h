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

/// Description of mechanisms. Trees are the bodies of a scene, then its robots.
struct MechanismsDescription {
  std::vector<char> tree_free;         ///< [T] nonzero for dynamic roots: six coordinates, c and w
  std::vector<Link> links;             ///< tree after tree, parents before their children
  std::vector<Index> coordinate_tree;  ///< [n] tree after tree, coordinates of a free root first
  std::vector<char> prescribed;        ///< [n] nonzero if the value at the end of the step is given
  std::vector<char> held;              ///< [n] nonzero if dynamic, but prescribed in this solve
  std::vector<double> lower;           ///< [n] limits of free joints; infinite: none
  std::vector<double> upper;
  std::vector<double> limit_stiffness;  ///< [n]
  /// Width of the zone beyond a limit, relative to the joint's range, and relative to a speed limit.
  double limit_zone = 0.0;
  std::vector<double> velocity_stiffness;  ///< [n] see JointConstants
  std::vector<double> velocity_force;      ///< [n]
  std::vector<Index> surface_link;         ///< [surfaces]
};

/// Trees of rigid links, and the vertices of their surfaces as functions of coordinates.
///
/// The root of a tree has a frame S, a rigid transform. A point of link l with coordinates v in the
/// link's axes is at
///
///   y = c + R(w) (S C_l(q) v)   if the root is free,     y = S C_l(q) v   if it is prescribed,
///
/// with C_l the transform from link l to the root, by the joints between them.
///
/// Coordinates and frames are stored in nodes of three numbers, so that they share one list of points
/// with vertices: first `node_count` nodes of coordinates, each of which holds only free or only
/// prescribed ones of one tree (padded with zeros), then four nodes a tree: the columns of S. A body
/// without coordinates is handled by BodySet.
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

  /// Index of a coordinate among the numbers of the nodes.
  Index slot(Index coordinate) const { return slot_[coordinate]; }
  bool is_prescribed(Index node) const { return node_prescribed_[node] != 0; }

  /// Nodes of each tree, whose coordinates depend on each other.
  std::vector<std::vector<Index>> cliques() const;

  /// A tree that is one rigid body in free flight: six coordinates, without joint, drive or limit.
  struct FreeBody {
    Index first_node, last_node;
    std::vector<Index> surfaces;  ///< indices among the surfaces of bodies
  };
  std::vector<FreeBody> free_bodies() const;

  /// True if a surface belongs to these trees; is_dynamic(): if it moves with free coordinates.
  bool has_surface(Index surface) const { return surface_[surface].tree >= 0; }
  bool is_dynamic(Index surface) const { return surface_[surface].dynamic; }
  /// True if it moves with free coordinates or with held ones, so that collisions with it matter.
  bool collides(Index surface) const { return surface_[surface].collides; }

  /// Compute the frames S of the trees from the poses of all roots, into their nodes.
  void set_frames(const double* poses, double* points) const;
  /// poses_bar += cotangents of the frames' nodes, pulled back.
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
  /// for a change of coordinates and frames: the transpose of pull_back_change().
  void push_forward_change(const double* points,
                           const double* change,
                           const double* g,
                           double* points_dot) const;

  /// visit(node_i, node_j, block) for all pairs node_i >= node_j of free nodes of a tree: the second
  /// derivative of  vertices . g.
  template <class Visit>
  void visit_curvature(const double* points, const double* g, Visit&& visit) const;

  /// Attachments of all surfaces' vertices, points from `first_point` on, to the free nodes, rows from
  /// `first_row` on. The Jacobians are zero until differentiate().
  linalg::Attachments attachments(Index first_point, Index first_row) const;

  /// Fill in the Jacobians at a configuration.
  void differentiate(const double* points, Index first_row, linalg::Attachments& out) const;

  /// Largest turn of any link with a change of the nodes, summed along its chain [rad].
  double turn(const double* change) const;

  /// Largest turn of any link between two configurations, roots included, summed along its chain.
  double turn_between(const double* from, const double* to) const;

  /// Lever of each coordinate: length that converts its change to a displacement of the links' points
  /// [m], 1 for shifts; one for each number of the nodes, zero for numbers without a coordinate.
  const std::vector<double>& lever() const { return lever_; }

 private:
  struct Tree {
    Index given;  // index among all trees
    bool free;
    Index first_link, last_link;
    Index first_coordinate, last_coordinate;
    Index first_node, last_node;
    Index frame;  // index of the first of its four nodes among all points
    std::vector<Index> surfaces;
  };
  struct Surface {
    Index tree = -1;  // index in trees_; -1: none of these
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

  /// Steps of the constructor, in this order. make_trees() returns the index in trees_ of each given
  /// tree, or -1.
  std::vector<Index> make_trees();
  void assign_slots(const Tree& tree);
  void make_paths();
  void make_surfaces(const BodySet& bodies, const std::vector<Index>& tree_of);
  void find_levers();

  MechanismsDescription given_;
  std::vector<double> vertices_;
  std::vector<Tree> trees_;
  std::vector<Surface> surface_;
  std::vector<std::vector<Index>> path_;  // [links] joints that move the link, root first
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
