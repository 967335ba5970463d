#pragma once

#include <span>
#include <vector>

#include "bodies/mechanisms.h"
#include "common/types.h"
#include "linalg/attachments.h"
#include "linalg/block_matrix.h"

namespace diffcloth::solver {

/// The unknowns z of a solve, and the points x of a scene as a function of z.
///
/// A configuration x is a list of points, 3 numbers each:
///
///   cloth vertices | vertices of bodies and links | nodes of coordinates | nodes of frames
///
/// (see bodies::Mechanisms for both kinds of nodes). z consists of the cloth vertices and the nodes of
/// coordinates, which are the rows of the linear system. Pins and other prescribed points are part of x;
/// they may have rows, but are no unknowns. Vertices that follow free coordinates have no rows:
/// `attachments` holds the derivative of their positions by the coordinates.
class Coordinates {
 public:
  /// @param prescribed  [points]; this array and the mechanisms must outlive the coordinates
  Coordinates(Index cloth_vertex_count,
              Index vertex_count,
              const bodies::Mechanisms& mechanisms,
              const std::vector<char>& prescribed);

  Index cloth_vertex_count() const { return cloth_vertex_count_; }
  Index vertex_count() const { return vertex_count_; }
  Index point_count() const { return static_cast<Index>(prescribed_->size()); }
  Index row_count() const { return cloth_vertex_count_ + mechanisms_->node_count(); }

  /// Length of z. Pinned vertices have entries, which stay zero in every change.
  std::size_t size() const { return 3 * static_cast<std::size_t>(row_count()); }

  const bodies::Mechanisms& mechanisms() const { return *mechanisms_; }
  const std::vector<char>& prescribed() const { return *prescribed_; }

  /// True if some points may move on curves: there are free coordinates.
  bool is_curved() const { return mechanisms_->has_free(); }
  /// True if some points move on curves in this change of all points.
  bool is_curved(const std::vector<double>& dx) const;

  /// Point of a row; is_free(): true if that point is an unknown.
  Index point(Index row) const {
    return row < cloth_vertex_count_ ? row : row - cloth_vertex_count_ + vertex_count_;
  }
  bool is_free(Index row) const { return (*prescribed_)[point(row)] == 0; }

  /// Nodes of the coordinates, followed by the nodes of the frames.
  const double* nodes(const std::vector<double>& x) const { return x.data() + node_offset(); }
  double* nodes(std::vector<double>& x) const { return x.data() + node_offset(); }

  /// Conversions between a list of points and its rows z: extract, add, overwrite and clear rows.
  void take_rows(const std::vector<double>& x, std::vector<double>& z) const;
  void add_rows(const std::vector<double>& z, std::vector<double>& x) const;
  void put_rows(const double* z, std::vector<double>& x) const;
  void clear_rows(std::vector<double>& x) const;

  /// Compute the vertices of links from the nodes of x.
  void place(std::vector<double>& x) const;

  /// Compute the attachments at x.
  void stand_at(const double* x);
  const linalg::Attachments& attachments() const { return attachments_; }

  /// dx = (dx/dz) dz over all points, at the point of the last stand_at(): zero at prescribed points.
  void push_forward(const std::vector<double>& dz, std::vector<double>& dx) const;

  /// Add to dx, a change that is given at the nodes, the resulting change of the vertices of links.
  void follow(const std::vector<double>& x, std::vector<double>& dx) const;

  /// g_z = (dx/dz)^T g, at the point of the last stand_at(): zero at prescribed rows.
  void pull_back(const std::vector<double>& g, std::vector<double>& g_z) const;

  /// Move the cotangents of the vertices of links to all nodes on which they depend.
  void gather(const std::vector<double>& x, std::vector<double>& bar) const;

  /// Compute the change of the vertices of links from a change of all nodes: gather() transposed.
  void carry(const std::vector<double>& x, std::vector<double>& dx) const;

  /// Subtract from bar the derivative by all nodes of  g . (change of the vertices of links with the
  /// coordinates in dx).
  void subtract_change(const std::vector<double>& x,
                       const std::vector<double>& dx,
                       const std::vector<double>& g,
                       std::vector<double>& bar) const;

  /// Add to g_dot the change of  (dx/dz)^T g  with dx, a change of prescribed nodes: subtract_change()
  /// transposed, with the opposite sign.
  void add_change(const std::vector<double>& x,
                  const std::vector<double>& dx,
                  const std::vector<double>& g,
                  std::vector<double>& g_dot) const;

  /// A += the second derivative of  g . x(z)  at x.
  void add_curvature(const double* x, const std::vector<double>& g, linalg::BlockMatrix& A) const;

  /// Couplings of points, expressed in rows; points without rows are left out. Not sorted.
  linalg::Couplings couplings_of_rows(linalg::Couplings points) const;

  /// The points at the fraction alpha of a change dx: on straight lines, except for points that follow
  /// free coordinates.
  void retract(const std::vector<double>& x,
               const std::vector<double>& dx,
               double alpha,
               std::vector<double>& out) const;

  /// Largest fraction of a change from x that turns no link beyond the bound for one step and moves no
  /// joint to the end of its limits.
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
