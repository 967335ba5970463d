#include "contact/sharpness.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>
#include <optional>
#include <utility>

#include <Eigen/Geometry>

#include "common/disjoint_sets.h"

namespace diffcloth::contact {
namespace {

constexpr double kFlat = 1e-4;  // [rad]

double angle_between(const Vec3& a, const Vec3& b) {
  return std::atan2(a.cross(b).norm(), a.dot(b));
}

/// True if a face traverses an edge from its lower to its higher vertex.
bool runs_up(const CollisionMesh& mesh, Index f, Index e) {
  const auto& sides = mesh.face_edges[f];
  const auto side = std::find(sides.begin(), sides.end(), e) - sides.begin();
  return mesh.faces[f][side] == mesh.edges[e][0];
}

/// Quantities from which the angles of a body's features are computed.
struct Faces {
  std::vector<Vec3> normal;       ///< [faces] unit, or zero for a face without area
  std::vector<Index> edge_count;  ///< [edges] number of faces at the edge
  std::vector<char> solid;        ///< [faces] true if the face belongs to a solid part
};

std::vector<char> find_solid(const CollisionMesh& mesh,
                             const double* X,
                             const std::vector<Index>& edge_count) {
  DisjointSets parts(mesh.faces.size());
  for (std::size_t e = mesh.cloth_edge_count; e < mesh.edges.size(); ++e) {
    if (edge_count[e] > 1) parts.unite(mesh.edge_faces[e][0], mesh.edge_faces[e][1]);
  }
  std::vector<char> broken(mesh.faces.size(), 0);
  for (auto e = static_cast<std::size_t>(mesh.cloth_edge_count); e < mesh.edges.size(); ++e) {
    const auto& [f, g] = mesh.edge_faces[e];
    const auto edge = static_cast<Index>(e);
    if (mesh.is_round_edge(edge)) continue;
    if (edge_count[e] != 2 || runs_up(mesh, f, edge) == runs_up(mesh, g, edge)) {
      broken[parts.find(f)] = 1;
    }
  }
  std::vector<double> volume(mesh.faces.size(), 0.0);
  for (auto f = static_cast<std::size_t>(mesh.cloth_face_count); f < mesh.faces.size(); ++f) {
    const Index part = parts.find(static_cast<Index>(f));
    const Vec3 origin = row(X, mesh.faces[part][0]);
    const auto& [i, j, k] = mesh.faces[f];
    volume[part] += (row(X, i) - origin).dot((row(X, j) - origin).cross(row(X, k) - origin));
  }
  std::vector<char> solid(mesh.faces.size(), 0);
  for (auto f = static_cast<std::size_t>(mesh.cloth_face_count); f < mesh.faces.size(); ++f) {
    const Index part = parts.find(static_cast<Index>(f));
    solid[f] = broken[part] == 0 && volume[part] > 0.0;
  }
  return solid;
}

Faces describe(const CollisionMesh& mesh, const double* X) {
  Faces faces;
  faces.normal.assign(mesh.faces.size(), Vec3::Zero());
  faces.edge_count.assign(mesh.edges.size(), 0);
  for (auto f = static_cast<std::size_t>(mesh.cloth_face_count); f < mesh.faces.size(); ++f) {
    if (mesh.is_round_face(static_cast<Index>(f))) continue;
    const auto& [i, j, k] = mesh.faces[f];
    const Vec3 e0 = row(X, j) - row(X, i);
    const Vec3 e1 = row(X, k) - row(X, i);
    faces.normal[f] = e0.cross(e1).normalized();
    for (const Index e : mesh.face_edges[f]) ++faces.edge_count[e];
  }
  faces.solid = find_solid(mesh, X, faces.edge_count);
  return faces;
}

/// Exterior dihedral angle, with its sign if the part is solid.
double dihedral(const CollisionMesh& mesh, const double* X, const Faces& faces, Index e) {
  if (faces.edge_count[e] != 2) return std::numbers::pi;
  const auto& [f, g] = mesh.edge_faces[e];
  const bool opposed = runs_up(mesh, f, e) != runs_up(mesh, g, e);
  const Vec3& n = faces.normal[f];
  const double angle = angle_between(n, opposed ? faces.normal[g] : Vec3(-faces.normal[g]));
  if (angle < kFlat) return 0.0;
  if (faces.solid[f] == 0) return angle;
  const Vec3 along = row(X, mesh.edges[e][1]) - row(X, mesh.edges[e][0]);
  const Vec3 turn = n.cross(faces.normal[g]);
  return (turn.dot(along) > 0.0) == runs_up(mesh, f, e) ? angle : -angle;
}

/// Perimeter of the smallest convex cone around unit vectors within 90 degrees of a pole: the sum of the
/// angles between its neighboring extreme rays.
double cone_perimeter(const std::vector<Vec3>& directions, const Vec3& pole) {
  const Vec3 a = pole.unitOrthogonal();
  const Vec3 b = pole.cross(a);
  struct Ray {
    Vec2 at;
    Vec3 direction;
  };
  std::vector<Ray> rays;
  rays.reserve(directions.size());
  for (const Vec3& d : directions) {
    rays.push_back({.at = Vec2(d.dot(a), d.dot(b)) / d.dot(pole), .direction = d});
  }
  std::ranges::sort(rays, [](const Ray& p, const Ray& q) {
    return std::pair(p.at.x(), p.at.y()) < std::pair(q.at.x(), q.at.y());
  });
  // Monotone chains: lower, then upper.
  std::vector<Ray> hull;
  const auto extend = [&hull](const Ray& r, std::size_t base) {
    while (hull.size() >= base + 2) {
      const Vec2 u = hull.back().at - hull[hull.size() - 2].at;
      const Vec2 v = r.at - hull[hull.size() - 2].at;
      if (u.x() * v.y() - u.y() * v.x() > 0.0) break;
      hull.pop_back();
    }
    hull.push_back(r);
  };
  for (const Ray& r : rays) extend(r, 0);
  const std::size_t lower = hull.size() - 1;
  for (std::size_t k = rays.size() - 1; k-- > 0;) extend(rays[k], lower);
  double perimeter = 0.0;
  for (std::size_t k = 0; k + 1 < hull.size(); ++k) {
    perimeter += angle_between(hull[k].direction, hull[k + 1].direction);
  }
  return perimeter;
}

/// Unit vector within 90 degrees of all directions; none if the search does not find one.
std::optional<Vec3> find_pole(const std::vector<Vec3>& directions, const Vec3& guess) {
  constexpr int kCorrections = 100;
  Vec3 pole = guess;
  for (int k = 0; k < kCorrections; ++k) {
    const Vec3* worst = nullptr;
    double least = kFlat * pole.norm();
    for (const Vec3& d : directions) {
      if (d.dot(pole) > least) continue;
      least = d.dot(pole);
      worst = &d;
    }
    if (worst == nullptr) return pole.normalized();
    pole += *worst;
  }
  return std::nullopt;
}

/// Edges and faces around a vertex.
struct Star {
  std::vector<Vec3> directions;      ///< unit vectors along its edges
  Vec3 normal = Vec3::Zero();        ///< sum of its faces' unit normals, weighted by angle
  double angle = 0.0;                ///< sum of the angles of its faces
  double lowest = std::numbers::pi;  ///< smallest dihedral angle of its edges
  bool solid = true;
};

/// Solid angle of the directions that point away from all edges at a vertex.
double normal_cone(const Star& star) {
  constexpr double kFullTurn = 2.0 * std::numbers::pi;
  if (star.directions.empty()) return 0.0;
  double omega = 0.0;
  if (star.solid && star.lowest >= 0.0) {
    omega = kFullTurn - star.angle;  // convex: the angle deficit
  } else {
    Vec3 sum = Vec3::Zero();
    for (const Vec3& d : star.directions) sum += d;
    const std::optional<Vec3> pole = find_pole(star.directions, sum);
    if (!pole || (star.solid && pole->dot(star.normal) >= 0.0)) return 0.0;  // saddle, or pit
    omega = kFullTurn - cone_perimeter(star.directions, *pole);
  }
  return omega < kFlat * kFlat ? 0.0 : omega;
}

}  // namespace

Bulge bulge(const CollisionMesh& mesh, const double* X) {
  const Faces faces = describe(mesh, X);
  Bulge result{.edge = std::vector<double>(mesh.edges.size(), 0.0),
               .vertex = std::vector<double>(mesh.vertex_count, 0.0),
               .flat = std::vector<char>(mesh.edges.size(), 0)};
  std::vector<Star> stars(mesh.vertex_count);
  for (auto e = static_cast<std::size_t>(mesh.cloth_edge_count); e < mesh.edges.size(); ++e) {
    if (mesh.is_round_edge(static_cast<Index>(e))) continue;
    const double theta = dihedral(mesh, X, faces, static_cast<Index>(e));
    result.edge[e] = std::max(theta, 0.0);
    result.flat[e] = theta == 0.0;
    const auto& [i, j] = mesh.edges[e];
    const Vec3 along = (row(X, j) - row(X, i)).normalized();
    stars[i].directions.push_back(along);
    stars[j].directions.emplace_back(-along);
    for (const Index v : {i, j}) stars[v].lowest = std::min(stars[v].lowest, theta);
  }
  for (auto f = static_cast<std::size_t>(mesh.cloth_face_count); f < mesh.faces.size(); ++f) {
    if (mesh.is_round_face(static_cast<Index>(f))) continue;
    for (int k = 0; k < 3; ++k) {
      const Index v = mesh.faces[f][k];
      const Vec3 e0 = row(X, mesh.faces[f][(k + 1) % 3]) - row(X, v);
      const Vec3 e1 = row(X, mesh.faces[f][(k + 2) % 3]) - row(X, v);
      const double angle = angle_between(e0, e1);
      stars[v].angle += angle;
      stars[v].normal += angle * faces.normal[f];
      stars[v].solid = stars[v].solid && faces.solid[f] != 0;
    }
  }
  for (Index v = mesh.cloth_vertex_count; v < mesh.vertex_count; ++v) {
    result.vertex[v] = normal_cone(stars[v]);
  }
  return result;
}

}  // namespace diffcloth::contact
