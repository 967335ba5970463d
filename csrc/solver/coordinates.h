#pragma once

#include <span>
#include <vector>

#include "bodies/mechanisms.h"
#include "common/types.h"
#include "linalg/attachments.h"
#include "linalg/block_matrix.h"

namespace diffcloth::solver {

/// The unknowns z of a solve, and how the points x of a scene depend on them.
///
/// A configuration x is a list of points, 3 numbers each:
///
///   cloth vertices | vertices of bodies and links | nodes of coordinates | nodes of frames
///
/// (see bodies::Mechanisms for the latter two). z are the cloth vertices and the nodes of coordinates:
/// the rows of the linear system. Pins and what else is prescribed are part of x, and rows at most,
/// but no unknowns. Vertices that follow free coordinates have no rows: `attachments` says how they
/// move with those.
class Coordinates {
 public:
  /// @param prescribed  [points]; it and the mechanisms outlive the coordinates
  Coordinates(Index cloth_vertex_count,
              Index vertex_count,
              const bodies::Mechanisms& mechanisms,
              const std::vector<char>& prescribed);

  Index cloth_vertex_count() const { return cloth_vertex_count_; }
  Index vertex_count() const { return vertex_count_; }
  Index point_count() const { return static_cast<Index>(prescribed_->size()); }
  Index row_count() const { return cloth_vertex_count_ + mechanisms_->node_count(); }

  /// Length of z; entries of pinned vertices are there and stay zero in every change.
  std::size_t size() const { return 3 * static_cast<std::size_t>(row_count()); }

  const bodies::Mechanisms& mechanisms() const { return *mechanisms_; }
  const std::vector<char>& prescribed() const { return *prescribed_; }

  /// Whether points do not all move on straight lines.
  bool is_curved() const { return mechanisms_->has_free(); }
  /// The same of one change of all points.
  bool is_curved(const std::vector<double>& dx) const;

  /// The point of a row, and whether it is an unknown.
  Index point(Index row) const {
    return row < cloth_vertex_count_ ? row : row - cloth_vertex_count_ + vertex_count_;
  }
  bool is_free(Index row) const { return (*prescribed_)[point(row)] == 0; }

  /// The coordinates' nodes, and behind them those of the frames.
  const double* nodes(const std::vector<double>& x) const { return x.data() + node_offset(); }
  double* nodes(std::vector<double>& x) const { return x.data() + node_offset(); }

  /// Rows of a list of points, as z, and their addition to one.
  void take_rows(const std::vector<double>& x, std::vector<double>& z) const;
  void add_rows(const std::vector<double>& z, std::vector<double>& x) const;
  void put_rows(const double* z, std::vector<double>& x) const;
  void clear_rows(std::vector<double>& x) const;

  /// Put the vertices of links where the nodes of x say.
  void place(std::vector<double>& x) const;

  /// Find the attachments at x.
  void stand_at(const double* x);
  const linalg::Attachments& attachments() const { return attachments_; }

  /// dx = (dx/dz) dz over all points, where the coordinates stand: zero at prescribed ones.
  void push_forward(const std::vector<double>& dz, std::vector<double>& dx) const;

  /// Add to a change of points, given at the nodes, that of the vertices of links.
  void follow(const std::vector<double>& x, std::vector<double>& dx) const;

  /// g_z = (dx/dz)^T g, where the coordinates stand: zero at prescribed rows.
  void pull_back(const std::vector<double>& g, std::vector<double>& g_z) const;

  /// Move the cotangents of the vertices of links to all nodes that they depend on.
  void gather(const std::vector<double>& x, std::vector<double>& bar) const;

  /// Let the vertices of links follow a change of all nodes: gather() transposed.
  void carry(const std::vector<double>& x, std::vector<double>& dx) const;

  /// bar -= the derivative of  g . (change of the vertices of links with the coordinates in dx)  by all
  /// nodes.
  void subtract_change(const std::vector<double>& x,
                       const std::vector<double>& dx,
                       const std::vector<double>& g,
                       std::vector<double>& bar) const;

  /// g_dot += the change of  (dx/dz)^T g  with dx, a change of prescribed nodes: subtract_change()
  /// transposed, with the other sign.
  void add_change(const std::vector<double>& x,
                  const std::vector<double>& dx,
                  const std::vector<double>& g,
                  std::vector<double>& g_dot) const;

  /// A += the second derivative of  g . x(z)  at x.
  void add_curvature(const double* x, const std::vector<double>& g, linalg::BlockMatrix& A) const;

  /// Couplings of points in terms of rows; those that have none are left out. Not sorted.
  linalg::Couplings couplings_of_rows(linalg::Couplings points) const;

  /// The points at the fraction alpha of a change dx: in one straight line but for what follows free
  /// coordinates.
  void retract(const std::vector<double>& x,
               const std::vector<double>& dx,
               double alpha,
               std::vector<double>& out) const;

  /// Largest fraction of a change from x that turns no link too far for one step, and takes no joint
  /// to the end of its limits.
  double largest_fraction(const std::vector<double>& x, const std::vector<double>& dx) const;

  /// Largest displacement in a change of all points [m]; NaN counts as infinite.
  double displacement(const std::vector<double>& dx) const;

  /// Largest coordinate of a vertex [m].
  double extent(const std::vector<double>& x) const;

 private:
  std::ptrdiff_t node_offset() const { return 3 * static_cast<std::ptrdiff_t>(vertex_count_); }
  std::ptrdiff_t body_offset() const {
    return 3 * static_cast<std::ptrdiff_t>(cloth_vertex_count_);
  }

  Index cloth_vertex_count_;
  Index vertex_count_;
  const bodies::Mechanisms* mechanisms_;
  const std::vector<char>* prescribed_;
  linalg::Attachments attachments_;
};

}  // namespace diffcloth::solver
