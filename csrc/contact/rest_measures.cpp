#include "contact/rest_measures.h"

#include <Eigen/Geometry>

#include "contact/feature_areas.h"

namespace diffcloth::contact {

RestMeasures RestMeasures::zero(const CollisionMesh& mesh) {
  return {.vertex_area = std::vector<double>(mesh.vertex_count, 0.0),
          .edge_area = std::vector<double>(mesh.edges.size(), 0.0),
          .edge_length_sq = std::vector<double>(mesh.edges.size(), 0.0),
          .face_area = std::vector<double>(mesh.cloth_face_count, 0.0),
          .mean_face_area = std::vector<double>(mesh.cloth_count, 0.0)};
}

RestMeasures measure(const CollisionMesh& mesh, const double* X) {
  RestMeasures m = RestMeasures::zero(mesh);
  std::vector<Index> face_count(mesh.cloth_count, 0);
  for (std::size_t f = 0; f < mesh.faces.size(); ++f) {
    const auto& [i, j, k] = mesh.faces[f];
    if (mesh.is_round_face(static_cast<Index>(f))) {
      for (const Index end : {i, j}) m.vertex_area[end] += 0.5 * round_area(mesh, X, f);
      continue;
    }
    const Vec3 e0 = row(X, j) - row(X, i);
    const Vec3 e1 = row(X, k) - row(X, i);
    const double area = 0.5 * e0.cross(e1).norm();
    for (const Index v : mesh.faces[f]) m.vertex_area[v] += area / 3.0;
    for (const Index e : mesh.face_edges[f]) m.edge_area[e] += area / 3.0;
    const Index surface = mesh.face_surface[f];
    if (surface >= mesh.cloth_count) continue;
    m.face_area[f] = area;
    m.mean_face_area[surface] += area;
    ++face_count[surface];
  }
  for (Index s = 0; s < mesh.cloth_count; ++s) {
    if (face_count[s] > 0) m.mean_face_area[s] /= face_count[s];
  }
  for (std::size_t e = 0; e < mesh.edges.size(); ++e) {
    m.edge_length_sq[e] = (row(X, mesh.edges[e][0]) - row(X, mesh.edges[e][1])).squaredNorm();
  }
  return m;
}

}  // namespace diffcloth::contact
