#pragma once

#include <vector>

#include "common/types.h"

namespace diffcloth::solver {

/// The unknowns z of a solve, and how the positions x of all vertices depend on them.
///
/// Today z are the positions of the cloths' vertices; those of pinned ones, and of the bodies'
/// vertices, are prescribed: they are part of x, and no unknowns. A solve sees x through this class
/// alone, so that what moves by coordinates of its own (a free body, a joint) appends them to z.
class Coordinates {
 public:
  /// @param prescribed  [vertices] outlives the coordinates
  Coordinates(Index cloth_vertex_count, const std::vector<char>& prescribed)
      : cloth_vertex_count_(cloth_vertex_count), prescribed_(&prescribed) {}

  Index cloth_vertex_count() const { return cloth_vertex_count_; }
  Index vertex_count() const { return static_cast<Index>(prescribed_->size()); }

  /// Length of z; entries of pinned vertices are there and stay zero in every change.
  std::size_t size() const { return 3 * static_cast<std::size_t>(cloth_vertex_count_); }

  bool is_free(Index vertex) const { return (*prescribed_)[vertex] == 0; }
  const std::vector<char>& prescribed() const { return *prescribed_; }

  /// dx = (dx/dz) dz, over all vertices: zero at prescribed ones.
  void push_forward(const std::vector<double>& dz, std::vector<double>& dx) const {
    dx.assign(3 * prescribed_->size(), 0.0);
    for (Index i = 0; i < cloth_vertex_count_; ++i) {
      if (!is_free(i)) continue;
      for (Index a = 3 * i; a < 3 * i + 3; ++a) dx[a] = dz[a];
    }
  }

  /// g_z = (dx/dz)^T g: zero at pinned vertices.
  void pull_back(const std::vector<double>& g, std::vector<double>& g_z) const {
    g_z.assign(size(), 0.0);
    for (Index i = 0; i < cloth_vertex_count_; ++i) {
      if (!is_free(i)) continue;
      for (Index a = 3 * i; a < 3 * i + 3; ++a) g_z[a] = g[a];
    }
  }

  /// Positions at the fraction alpha of a change dx of all vertices, in one straight line.
  static void retract(const std::vector<double>& x,
                      const std::vector<double>& dx,
                      double alpha,
                      std::vector<double>& out) {
    out.resize(x.size());
    for (std::size_t a = 0; a < x.size(); ++a) out[a] = x[a] + alpha * dx[a];
  }

 private:
  Index cloth_vertex_count_;
  const std::vector<char>* prescribed_;
};

}  // namespace diffcloth::solver
