#pragma once

#include <array>
#include <memory>
#include <span>
#include <vector>

#include "bodies/pose.h"
#include "common/types.h"
#include "projective/primitives.h"

namespace diffcloth::projective {

/// A body that the cloths' vertices touch, on its way through a step.
struct Obstacle {
  Index body;       ///< its place among the bodies
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
  /// [N] vertices beyond the own one that each never touches
  std::vector<std::vector<Index>> apart;
};

/// Which of them touch each other, and how.
struct Touching {
  const VertexSpheres* spheres;
  std::vector<double> friction;  ///< [cloths^2]
  std::vector<char> may_touch;   ///< [cloths^2]
};

/// Cloths on the straight way from the start of a step to where inertia and external forces alone
/// would take them.
struct Swept {
  const double* x;                   ///< x_n [N, 3] [m]
  const double* predicted;           ///< xhat = x_n + h v_n + h^2 M^-1 f_ext [N, 3] [m]
  double h;                          ///< [s]
  std::span<const Index> cloth;      ///< [N]
  std::span<const char> prescribed;  ///< [N or more] vertices that are left out

  Index size() const { return static_cast<Index>(cloth.size()); }
  Vec3 at(Index i, double fraction) const {
    return row(x, i) + fraction * (row(predicted, i) - row(x, i));
  }
};

/// Contact of a vertex with an obstacle or another vertex: a frame that holds for the whole step.
struct NodalContact {
  Index vertex;
  Index partner;       ///< the other vertex, or -1
  Index obstacle;      ///< place of the obstacle, or -1
  double fraction;     ///< of the step at which the frame was taken: 0, 1/2 or 1
  double friction;     ///< mu
  Vec3 normal;         ///< toward the vertex, in the world
  Vec3 velocity;       ///< of the obstacle's material at the contact over the step [m/s]
  Vec3 surface_point;  ///< of the obstacle that is nearest, in its frame [m]
};

/// Contacts of a step: at most one a vertex.
///
/// Obstacles first: vertices on their swept way, obstacles along the geodesics of their poses. The first of the fractions 0, 1/2, 1 of the step counts at which a vertex is within the band
/// of an obstacle, and there the one that it is deepest in. Then pairs of vertices that touch nothing
/// yet, likewise; the deepest first where a vertex touches several.
///
/// @param touching  null where vertices do not touch each other
std::vector<NodalContact> find_contacts(const Swept& cloths,
                                        std::span<const Obstacle> obstacles,
                                        const Touching* touching);

/// Cotangents, or tangents, of what the frame of a contact depends on.
struct FrameBar {
  Vec3 vertex = Vec3::Zero();   ///< of its place at the fraction
  Vec3 partner = Vec3::Zero();  ///< likewise
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

/// Push tangents of what it depends on forward: pull_back() transposed.
FrameTangent push_forward(const NodalContact& contact,
                          const Swept& cloths,
                          std::span<const Obstacle> obstacles,
                          const FrameBar& dot);

class Cells;

/// Faces of a body, to find the one that is nearest to a point of its frame.
class FaceSearch {
 public:
  FaceSearch() = default;
  FaceSearch(std::vector<std::array<Index, 3>> faces, const std::vector<double>& vertices);

  /// How a force at a point is shared by the corners of the nearest face.
  struct Share {
    std::array<Index, 3> corners;
    Vec3 weights;           ///< barycentric coordinates of the nearest point of the face
    Mat3 weights_by_point;  ///< their derivatives [1/m]
  };
  Share share(const Vec3& y) const;

 private:
  std::vector<std::array<Index, 3>> faces_;
  std::vector<std::array<Vec3, 3>> corners_;
  std::vector<Vec3> center_;
  double radius_ = 0.0;  ///< of all faces around their centers
  std::shared_ptr<const Cells> cells_;
};

}  // namespace diffcloth::projective
