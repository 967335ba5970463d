#pragma once

#include <array>
#include <memory>
#include <span>
#include <vector>

#include "bodies/pose.h"
#include "common/types.h"
#include "projective/primitives.h"

namespace diffcloth::projective {

/// A body that the cloths' vertices may touch, with its motion during a step.
struct Obstacle {
  Index body;       ///< index among the bodies
  Primitive shape;  ///< in the body's frame
  bodies::Pose start;
  bodies::Pose end;
  std::vector<double> band;      ///< [cloths] distance within which vertices touch it [m]; negative
                                 ///< infinity for cloths that never do
  std::vector<double> friction;  ///< [cloths]
};

/// Spheres around the vertices of cloths.
struct VertexSpheres {
  std::vector<double> radius;  ///< [N] [m]
  /// [N] other vertices that each vertex never touches
  std::vector<std::vector<Index>> apart;
};

/// Parameters of contacts between vertices.
struct Touching {
  const VertexSpheres* spheres;
  std::vector<double> friction;  ///< [cloths^2]
  std::vector<char> may_touch;   ///< [cloths^2]
};

/// Cloths on the straight motion from the start of a step to the prediction by inertia and external
/// forces.
struct Swept {
  const double* x;                   ///< x_n [N, 3] [m]
  const double* predicted;           ///< xhat = x_n + h v_n + h^2 M^-1 f_ext [N, 3] [m]
  double h;                          ///< [s]
  std::span<const Index> cloth;      ///< [N]
  std::span<const char> prescribed;  ///< [N or more] nonzero for vertices that are left out

  Index size() const { return static_cast<Index>(cloth.size()); }
  Vec3 at(Index i, double fraction) const {
    return row(x, i) + fraction * (row(predicted, i) - row(x, i));
  }
};

/// Contact of a vertex with an obstacle or another vertex: a frame that holds for the whole step.
struct NodalContact {
  Index vertex;
  Index partner;       ///< the other vertex, or -1
  Index obstacle;      ///< index of the obstacle, or -1
  double fraction;     ///< fraction of the step at which the frame was computed: 0, 1/2 or 1
  double friction;     ///< mu
  Vec3 normal;         ///< toward the vertex, in the world
  Vec3 velocity;       ///< velocity of the obstacle's material at the contact over the step [m/s]
  Vec3 surface_point;  ///< nearest point of the obstacle, in its frame [m]
};

/// Contacts of a step: at most one a vertex.
///
/// Obstacles first: vertices on their swept motion, obstacles along the geodesics of their poses. Each
/// vertex is tested at the fractions 0, 1/2, 1 of the step: at the first one where it is within the band
/// of an obstacle, the contact is with the obstacle it is deepest in. Then pairs of vertices without a
/// contact are tested likewise; the deepest pair first if a vertex touches several.
///
/// @param touching  null if vertices do not touch each other
std::vector<NodalContact> find_contacts(const Swept& cloths,
                                        std::span<const Obstacle> obstacles,
                                        const Touching* touching);

/// Cotangents, or tangents, of the inputs of a contact's frame.
struct FrameBar {
  Vec3 vertex = Vec3::Zero();   ///< of the vertex's position at the fraction
  Vec3 partner = Vec3::Zero();  ///< of the partner's, likewise
  bodies::Pose start = bodies::Pose::Zero();
  bodies::Pose end = bodies::Pose::Zero();
};

/// Pull cotangents of normal, velocity and surface_point back.
FrameBar pull_back(const NodalContact& contact,
                   const Swept& cloths,
                   std::span<const Obstacle> obstacles,
                   const Vec3& normal_bar,
                   const Vec3& velocity_bar,
                   const Vec3& surface_point_bar);

/// Tangents of the frame of a contact.
struct FrameTangent {
  Vec3 normal = Vec3::Zero();
  Vec3 velocity = Vec3::Zero();
  Vec3 surface_point = Vec3::Zero();
};

/// Push tangents of the inputs forward: the transpose of pull_back().
FrameTangent push_forward(const NodalContact& contact,
                          const Swept& cloths,
                          std::span<const Obstacle> obstacles,
                          const FrameBar& dot);

class Cells;

/// Faces of a body, for nearest-face queries in the body's frame.
class FaceSearch {
 public:
  FaceSearch() = default;
  FaceSearch(std::vector<std::array<Index, 3>> faces, const std::vector<double>& vertices);

  /// Distribution of a force at a point over the corners of the nearest face.
  struct Share {
    std::array<Index, 3> corners;
    Vec3 weights;           ///< barycentric coordinates of the nearest point of the face
    Mat3 weights_by_point;  ///< derivatives of the weights by the point [1/m]
  };
  Share share(const Vec3& y) const;

 private:
  std::vector<std::array<Index, 3>> faces_;
  std::vector<std::array<Vec3, 3>> corners_;
  std::vector<Vec3> center_;
  double radius_ = 0.0;  ///< bound of the radii of all faces around their centers
  std::shared_ptr<const Cells> cells_;
};

}  // namespace diffcloth::projective
