#include "projective/nodal_contact.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <tuple>
#include <unordered_map>
#include <utility>

#include "contact/distance/closest.h"

namespace diffcloth::projective {

/// Hash grid of points.
class Cells {
 public:
  explicit Cells(double size) : size_(size) {}

  double size() const { return size_; }
  void add(const Vec3& x, Index point) { cells_[key(cell(x))].push_back(point); }

  /// Call visit(j) for every point in the cells around x: includes all within `size`, and others. A
  /// point may be visited more than once.
  template <class Visit>
  void around(const Vec3& x, Visit&& visit) const {
    const auto c = cell(x);
    for (std::int64_t a = -1; a <= 1; ++a) {
      for (std::int64_t b = -1; b <= 1; ++b) {
        for (std::int64_t d = -1; d <= 1; ++d) {
          const auto found = cells_.find(key({c[0] + a, c[1] + b, c[2] + d}));
          if (found == cells_.end()) continue;
          for (const Index j : found->second) visit(j);
        }
      }
    }
  }

 private:
  using Cell = std::array<std::int64_t, 3>;

  Cell cell(const Vec3& x) const {
    Cell c{};
    // Clamped, so that casts of distant points are defined; these merely share cells.
    constexpr double kFar = 1e15;
    for (int k = 0; k < 3; ++k) {
      c[k] = static_cast<std::int64_t>(std::floor(std::clamp(x[k] / size_, -kFar, kFar)));
    }
    return c;
  }
  static std::uint64_t key(const Cell& c) {
    std::uint64_t hash = 0;
    for (const std::int64_t k : c)
      hash = hash * 0x9E3779B97F4A7C15U + static_cast<std::uint64_t>(k);
    return hash;
  }

  double size_;
  std::unordered_map<std::uint64_t, std::vector<Index>> cells_;
};

namespace {

using bodies::Pose;

constexpr std::array<double, 3> kFractions{0.0, 0.5, 1.0};

/// Pose midway between two poses. The quaternion of slerp has the direction of the sum of the unit
/// quaternions, with signs aligned; its length is irrelevant.
struct Halfway {
  Vec4 a, b;  ///< unit quaternions
  double side;

  Halfway(const Pose& from, const Pose& to)
      : a(from.tail<4>().normalized()), b(to.tail<4>().normalized()), side(a.dot(b) < 0 ? -1 : 1) {}

  Pose pose(const Pose& from, const Pose& to) const {
    Pose result;
    result << 0.5 * (from.head<3>() + to.head<3>()), a + side * b;
    return result;
  }
};

Pose pose_at(const Obstacle& o, double fraction) {
  if (fraction == 0.0) return o.start;
  if (fraction == 1.0) return o.end;
  return Halfway(o.start, o.end).pose(o.start, o.end);
}

void pull_back_pose(const Obstacle& o, double fraction, const Pose& bar, FrameBar& out) {
  if (fraction == 0.0) {
    out.start += bar;
  } else if (fraction == 1.0) {
    out.end += bar;
  } else {
    const Halfway half(o.start, o.end);
    const Vec4 q = bar.tail<4>();
    out.start.head<3>() += 0.5 * bar.head<3>();
    out.end.head<3>() += 0.5 * bar.head<3>();
    out.start.tail<4>() += (q - half.a * half.a.dot(q)) / o.start.tail<4>().norm();
    out.end.tail<4>() += half.side * (q - half.b * half.b.dot(q)) / o.end.tail<4>().norm();
  }
}

/// Change of the pose at a fraction with the poses at both ends.
Pose push_forward_pose(const Obstacle& o, double fraction, const FrameBar& dot) {
  if (fraction == 0.0) return dot.start;
  if (fraction == 1.0) return dot.end;
  const Halfway half(o.start, o.end);
  const Vec4 a = dot.start.tail<4>() / o.start.tail<4>().norm();
  const Vec4 b = dot.end.tail<4>() / o.end.tail<4>().norm();
  Pose result;
  result << 0.5 * (dot.start.head<3>() + dot.end.head<3>()),
      a - half.a * half.a.dot(a) + half.side * (b - half.b * half.b.dot(b));
  return result;
}

/// Change of the rotation of a pose.
Mat3 turn_jvp(const Pose& pose, Pose change) {
  change.head<3>().setZero();
  const Mat3 axes = Mat3::Identity();
  Mat3 columns;
  bodies::transform_jvp(pose, change, axes.data(), 3, columns.data());
  return columns;
}

/// World position of a point in a body's frame.
Vec3 placed(const Pose& pose, const Vec3& y) { return pose.head<3>() + bodies::rotation(pose) * y; }

/// Cotangent of the pose for z . R y.
Pose turn_vjp(const Pose& pose, const Vec3& y, const Vec3& z) {
  Pose bar = bodies::transform_vjp(pose, y.data(), 1, z.data());
  bar.head<3>().setZero();
  return bar;
}

void add_obstacle_contacts(const Swept& cloths,
                           std::span<const Obstacle> obstacles,
                           std::vector<NodalContact>& contacts) {
  struct Placed {
    Vec3 p;
    Mat3 R;
  };
  std::vector<std::array<Placed, 3>> poses;
  for (const Obstacle& o : obstacles) {
    std::array<Placed, 3>& placed_at = poses.emplace_back();
    for (std::size_t k = 0; k < kFractions.size(); ++k) {
      const Pose pose = pose_at(o, kFractions[k]);
      placed_at[k] = {.p = pose.head<3>(), .R = bodies::rotation(pose)};
    }
  }
  for (Index i = 0; i < cloths.size(); ++i) {
    if (cloths.prescribed[i] != 0) continue;
    const Index cloth = cloths.cloth[i];
    bool found = false;
    for (std::size_t k = 0; k < kFractions.size() && !found; ++k) {
      const Vec3 x = cloths.at(i, kFractions[k]);
      double deepest = 0.0;
      NodalContact contact{};
      for (std::size_t o = 0; o < obstacles.size(); ++o) {
        const Placed& frame = poses[o][k];
        const Vec3 y = frame.R.transpose() * (x - frame.p);
        const Nearest near = nearest(obstacles[o].shape, y);
        const double depth = near.distance - obstacles[o].band[cloth];
        if (!(depth < deepest)) continue;
        deepest = depth;
        const Vec3 point = near.surface_point(y);
        found = true;
        contact = {
            .vertex = i,
            .partner = -1,
            .obstacle = static_cast<Index>(o),
            .fraction = kFractions[k],
            .friction = obstacles[o].friction[cloth],
            .normal = frame.R * near.normal,
            .velocity =
                (placed(obstacles[o].end, point) - placed(obstacles[o].start, point)) / cloths.h,
            .surface_point = point};
      }
      if (found) contacts.push_back(contact);
    }
  }
}

void add_pair_contacts(const Swept& cloths,
                       const Touching& touching,
                       std::vector<NodalContact>& contacts) {
  const auto& [radius, apart] = *touching.spheres;
  const auto n = static_cast<std::size_t>(cloths.size());
  const auto cloth_count =
      static_cast<Index>(std::lround(std::sqrt(static_cast<double>(touching.may_touch.size()))));
  std::vector<char> busy(cloths.prescribed.begin(),
                         cloths.prescribed.begin() + static_cast<std::ptrdiff_t>(n));
  for (const NodalContact& c : contacts) busy[c.vertex] = 1;
  const double size = 2.0 * *std::ranges::max_element(radius);
  std::vector<Vec3> x(n);
  for (const double fraction : kFractions) {
    for (Index i = 0; i < cloths.size(); ++i) x[i] = cloths.at(i, fraction);
    Cells cells(size);
    for (Index i = 0; i < cloths.size(); ++i) {
      if (busy[i] == 0) cells.add(x[i], i);
    }
    std::vector<std::tuple<double, Index, Index>> found;
    for (Index i = 0; i < cloths.size(); ++i) {
      if (busy[i] != 0) continue;
      cells.around(x[i], [&](Index j) {
        if (j <= i) return;
        const Index pair = cloths.cloth[i] * cloth_count + cloths.cloth[j];
        const double distance = (x[i] - x[j]).norm();
        const double depth = distance - radius[i] - radius[j];
        if (!(depth < 0.0) || !(distance > 0.0) || touching.may_touch[pair] == 0) return;
        if (std::ranges::binary_search(apart[i], j)) return;
        found.emplace_back(depth, i, j);
      });
    }
    std::ranges::sort(found);
    for (const auto& [depth, i, j] : found) {
      if (busy[i] != 0 || busy[j] != 0) continue;
      busy[i] = busy[j] = 1;
      contacts.push_back(
          {.vertex = i,
           .partner = j,
           .obstacle = -1,
           .fraction = fraction,
           .friction = touching.friction[cloths.cloth[i] * cloth_count + cloths.cloth[j]],
           .normal = (x[i] - x[j]).normalized(),
           .velocity = Vec3::Zero(),
           .surface_point = Vec3::Zero()});
    }
  }
}

}  // namespace

std::vector<NodalContact> find_contacts(const Swept& cloths,
                                        std::span<const Obstacle> obstacles,
                                        const Touching* touching) {
  std::vector<NodalContact> contacts;
  add_obstacle_contacts(cloths, obstacles, contacts);
  if (touching != nullptr) add_pair_contacts(cloths, *touching, contacts);
  return contacts;
}

// With the frame (p, R) of the obstacle at the fraction, y = R^T (x - p) and n = R n(y), and with the
// point b(y) of its surface, velocity = (p_1 + R_1 b - p_0 - R_0 b) / h.
FrameBar pull_back(const NodalContact& contact,
                   const Swept& cloths,
                   std::span<const Obstacle> obstacles,
                   const Vec3& normal_bar,
                   const Vec3& velocity_bar,
                   const Vec3& surface_point_bar) {
  FrameBar out;
  const Vec3 x = cloths.at(contact.vertex, contact.fraction);
  if (contact.partner >= 0) {
    const Vec3 d = x - cloths.at(contact.partner, contact.fraction);
    out.vertex = (normal_bar - contact.normal * contact.normal.dot(normal_bar)) / d.norm();
    out.partner = -out.vertex;
    return out;
  }
  const Obstacle& o = obstacles[contact.obstacle];
  const Vec3& b = contact.surface_point;
  const Vec3 material_bar = velocity_bar / cloths.h;
  const Vec3 minus_material_bar = -material_bar;
  out.start += bodies::transform_vjp(o.start, b.data(), 1, minus_material_bar.data());
  out.end += bodies::transform_vjp(o.end, b.data(), 1, material_bar.data());
  const Vec3 b_bar =
      surface_point_bar +
      (bodies::rotation(o.end) - bodies::rotation(o.start)).transpose() * material_bar;

  const Pose pose = pose_at(o, contact.fraction);
  const Mat3 R = bodies::rotation(pose);
  const Vec3 from_origin = x - pose.head<3>();
  const Vec3 y = R.transpose() * from_origin;
  const Nearest near = nearest(o.shape, y);
  const Vec3 y_bar = near.normal_derivative * (R.transpose() * normal_bar) +
                     near.surface_point_derivative() * b_bar;
  out.vertex = R * y_bar;
  // y_bar . R^T (x - p) equals (R y_bar) . (x - p).
  Pose pose_bar = turn_vjp(pose, near.normal, normal_bar) + turn_vjp(pose, y_bar, from_origin);
  pose_bar.head<3>() -= out.vertex;
  pull_back_pose(o, contact.fraction, pose_bar, out);
  return out;
}

FrameTangent push_forward(const NodalContact& contact,
                          const Swept& cloths,
                          std::span<const Obstacle> obstacles,
                          const FrameBar& dot) {
  FrameTangent out;
  const Vec3 x = cloths.at(contact.vertex, contact.fraction);
  if (contact.partner >= 0) {
    const Vec3 d = x - cloths.at(contact.partner, contact.fraction);
    const Vec3 d_dot = dot.vertex - dot.partner;
    out.normal = (d_dot - contact.normal * contact.normal.dot(d_dot)) / d.norm();
    return out;
  }
  const Obstacle& o = obstacles[contact.obstacle];
  const Pose pose = pose_at(o, contact.fraction);
  const Pose pose_dot = push_forward_pose(o, contact.fraction, dot);
  const Mat3 R = bodies::rotation(pose);
  const Mat3 R_dot = turn_jvp(pose, pose_dot);
  const Vec3 from_origin = x - pose.head<3>();
  const Vec3 y = R.transpose() * from_origin;
  const Vec3 y_dot =
      R.transpose() * (dot.vertex - pose_dot.head<3>()) + R_dot.transpose() * from_origin;
  const Nearest near = nearest(o.shape, y);
  out.normal = R * (near.normal_derivative * y_dot) + R_dot * near.normal;

  const Vec3& b = contact.surface_point;
  out.surface_point = near.surface_point_derivative() * y_dot;
  Vec3 start_dot;
  Vec3 end_dot;
  bodies::transform_jvp(o.start, dot.start, b.data(), 1, start_dot.data());
  bodies::transform_jvp(o.end, dot.end, b.data(), 1, end_dot.data());
  const Mat3 turn = bodies::rotation(o.end) - bodies::rotation(o.start);
  out.velocity = (end_dot - start_dot + turn * out.surface_point) / cloths.h;
  return out;
}

FaceSearch::FaceSearch(std::vector<std::array<Index, 3>> faces, const std::vector<double>& vertices)
    : faces_(std::move(faces)) {
  for (const auto& face : faces_) {
    std::array<Vec3, 3>& corners = corners_.emplace_back();
    for (int k = 0; k < 3; ++k) corners[k] = row(vertices.data(), face[k]);
    const Vec3 center = (corners[0] + corners[1] + corners[2]) / 3.0;
    for (const Vec3& corner : corners) radius_ = std::max(radius_, (corner - center).norm());
    center_.push_back(center);
  }
  auto cells = std::make_shared<Cells>(2.0 * radius_);
  for (std::size_t f = 0; f < center_.size(); ++f) {
    cells->add(center_[f], static_cast<Index>(f));
  }
  cells_ = std::move(cells);
}

FaceSearch::Share FaceSearch::share(const Vec3& y) const {
  struct Near {
    double center_sq;
    Index face;
  };
  std::vector<Near> near;
  Index best = -1;
  contact::Closest closest{};
  const auto find = [&] {
    // The distance to a face is between the distance to its center minus the radius and the distance to
    // its center.
    double reach = std::numeric_limits<double>::infinity();
    for (const Near& n : near) reach = std::min(reach, n.center_sq);
    reach = std::sqrt(reach) + radius_;
    best = -1;
    for (const auto& [center_sq, f] : near) {
      if (center_sq > reach * reach) continue;
      const auto& [a, b, c] = corners_[f];
      const contact::Closest found =
          contact::closest(contact::PairKind::kPointTriangle, {y, a, b, c});
      // Among equal distances the lowest index, independent of the order of the search.
      if (best < 0 || found.d_sq < closest.d_sq || (found.d_sq == closest.d_sq && f < best)) {
        closest = found;
        best = f;
      }
    }
  };
  const auto add = [&](Index f) {
    near.push_back({.center_sq = (y - center_[f]).squaredNorm(), .face = f});
  };
  cells_->around(y, add);
  find();
  if (best < 0 || !(std::sqrt(closest.d_sq) + radius_ <= cells_->size())) {
    near.clear();
    for (Index f = 0; f < static_cast<Index>(faces_.size()); ++f) add(f);
    find();
  }
  const Eigen::Matrix<double, 2, 12> beta = contact::beta_jacobian(closest);
  return {.corners = faces_[best],
          .weights = -closest.c.tail<3>(),
          .weights_by_point = -closest.c_beta.bottomRows<3>() * beta.leftCols<3>()};
}

}  // namespace diffcloth::projective
