#include "bodies/mechanisms.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "bodies/mechanism_eval.h"

namespace diffcloth::bodies {
namespace {

/// Product A B of rigid (or linear) transforms, each a 3 x 4 matrix.
Mat34 compose(const Mat34& a, const Mat34& b) {
  Mat34 c;
  c.leftCols<3>() = a.leftCols<3>() * b.leftCols<3>();
  c.col(3) = a.leftCols<3>() * b.col(3) + a.col(3);
  return c;
}

double inner(const Mat34& a, const Mat34& b) { return a.cwiseProduct(b).sum(); }
double inner(const Mat3& a, const Mat3& b) { return a.cwiseProduct(b).sum(); }

}  // namespace

// With moments M_l = sum over its vertices of ybar [v; 1]^T, every linear function of the vertices of
// link l is an inner product with M_l.

Mechanisms::Eval Mechanisms::evaluate(const Tree& tree, const double* points) const {
  Eval e;
  for (int a = 0; a < 4; ++a) e.frame.col(a) = row(points, tree.frame + a);
  if (tree.free) {
    e.center = row(points, tree.first_node);
    e.turn = Exponential(row(points, tree.first_node + 1));
  }
  const auto count = static_cast<std::size_t>(tree.last_link - tree.first_link);
  e.to_root.resize(count);
  e.by_joint.resize(count);
  e.links.reserve(count);
  const Placed<double> root{.rotation = Mat3::Identity(), .origin = Vec3::Zero(), .joint = {}};
  for (Index l = tree.first_link; l < tree.last_link; ++l) {
    const Link& link = given_.links[l];
    const Index k = l - tree.first_link;
    const Placed<double>& parent = link.parent < 0 ? root : e.links[link.parent - tree.first_link];
    const double coordinate = link.moves() ? points[slot_[link.coordinate]] : 0.0;
    const Placed<double>& own = e.links.emplace_back(place_on<double>(parent, link, coordinate));
    e.to_root[k] << own.rotation, own.origin;
    for (const Index m : path_[l]) {
      const Twist<double>& joint = e.links[m - tree.first_link].joint;
      Mat34 d = cross_matrix(joint.angular) * e.to_root[k];
      d.col(3) += joint.linear;
      e.by_joint[k].push_back(d);
    }
  }
  return e;
}

void Mechanisms::set_frames(const double* poses, double* points) const {
  for (const Tree& tree : trees_) {
    const Pose pose = Eigen::Map<const Pose>(poses + 7 * tree.given);
    const Mat3 r = rotation(pose);
    for (int a = 0; a < 3; ++a) Eigen::Map<Vec3>(points + 3 * (tree.frame + a)) = r.col(a);
    Eigen::Map<Vec3>(points + 3 * (tree.frame + 3)) = pose.head<3>();
  }
}

void Mechanisms::set_frames_jvp(const double* poses, const double* change, double* points) const {
  const Mat3 basis = Mat3::Identity();
  for (const Tree& tree : trees_) {
    const Pose of_tree = Eigen::Map<const Pose>(change + 7 * tree.given);
    Pose turn = of_tree;
    turn.head<3>().setZero();  // columns of R do not depend on the position
    transform_jvp(Eigen::Map<const Pose>(poses + 7 * tree.given), turn, basis.data(), 3,
                  points + 3 * tree.frame);
    Eigen::Map<Vec3>(points + 3 * (tree.frame + 3)) = of_tree.head<3>();
  }
}

void Mechanisms::set_frames_vjp(const double* poses,
                                const double* points_bar,
                                double* poses_bar) const {
  const Mat3 basis = Mat3::Identity();
  for (const Tree& tree : trees_) {
    const Pose pose = Eigen::Map<const Pose>(poses + 7 * tree.given);
    // The columns of R are the images of the axes, but do not depend on the position.
    Pose bar = transform_vjp(pose, basis.data(), 3, points_bar + 3 * tree.frame);
    bar.head<3>() = row(points_bar, tree.frame + 3);
    Eigen::Map<Pose>(poses_bar + 7 * tree.given) += bar;
  }
}

void Mechanisms::place(const double* points, double* vertices) const {
  for (const Tree& tree : trees_) {
    const Eval e = evaluate(tree, points);
    for (const Index surface : tree.surfaces) {
      const Surface& s = surface_[surface];
      const Mat34 u = compose(e.frame, e.to_root[s.link - tree.first_link]);
      for (Index v = s.first; v < s.last; ++v) {
        const Vec3 p = apply(u, row(vertices_.data(), v));
        Eigen::Map<Vec3>(vertices + 3 * v) = tree.free ? Vec3(e.center + e.turn.value * p) : p;
      }
    }
  }
}

void Mechanisms::clear(double* vertices) const {
  for (const Surface& s : surface_) {
    if (s.tree >= 0) std::fill(vertices + 3 * s.first, vertices + 3 * s.last, 0.0);
  }
}

/// Change of a free root's rotation.
Mat3 Mechanisms::turn_rate(const Tree& tree, const Eval& at, const double* change) {
  Mat3 rate = Mat3::Zero();
  if (!tree.free) return rate;
  const Vec3 w = row(change, tree.first_node + 1);
  for (int i = 0; i < 3; ++i) rate += w[i] * at.turn.first[i];
  return rate;
}

/// Change of a link's transform to the root.
Mat34 Mechanisms::link_rate(const Tree& tree,
                            const Eval& at,
                            Index link,
                            const double* change) const {
  Mat34 rate = Mat34::Zero();
  for (std::size_t m = 0; m < path_[link].size(); ++m) {
    const Index c = given_.links[path_[link][m]].coordinate;
    rate += change[slot_[c]] * at.by_joint[link - tree.first_link][m];
  }
  return rate;
}

void Mechanisms::push_forward(const double* points, const double* change, double* vertices) const {
  for (const Tree& tree : trees_) {
    const Eval e = evaluate(tree, points);
    Mat34 d_frame;
    for (int a = 0; a < 4; ++a) d_frame.col(a) = row(change, tree.frame + a);
    Vec3 d_center = Vec3::Zero();
    if (tree.free) d_center = row(change, tree.first_node);
    const Mat3 d_turn = turn_rate(tree, e, change);
    for (const Index surface : tree.surfaces) {
      const Surface& s = surface_[surface];
      const Index k = s.link - tree.first_link;
      Mat34 d = compose(d_frame, e.to_root[k]);
      d.noalias() += e.frame.leftCols<3>() * link_rate(tree, e, s.link, change);
      const Mat34 total = d_turn * compose(e.frame, e.to_root[k]) + e.turn.value * d;
      for (Index v = s.first; v < s.last; ++v) {
        Eigen::Map<Vec3>(vertices + 3 * v) = d_center + apply(total, row(vertices_.data(), v));
      }
    }
  }
}

std::vector<Mat34> Mechanisms::moments(const Tree& tree, const double* g) const {
  std::vector<Mat34> result(static_cast<std::size_t>(tree.last_link - tree.first_link),
                            Mat34::Zero());
  for (const Index surface : tree.surfaces) {
    const Surface& s = surface_[surface];
    Mat34& m = result[s.link - tree.first_link];
    for (Index v = s.first; v < s.last; ++v) {
      const Vec3 g_v = row(g, v);
      m.leftCols<3>().noalias() += g_v * row(vertices_.data(), v).transpose();
      m.col(3) += g_v;
    }
  }
  return result;
}

/// Add the cotangent of a tree's frame.
void Mechanisms::add_to_frame(const Tree& tree, const Mat34& bar, double* points_bar) {
  for (int a = 0; a < 4; ++a) {
    Eigen::Map<Vec3>(points_bar + 3 * (tree.frame + a)) += bar.col(a);
  }
}

void Mechanisms::pull_back(const double* points,
                           const double* vertices_bar,
                           double* points_bar) const {
  for (const Tree& tree : trees_) {
    const Eval e = evaluate(tree, points);
    const std::vector<Mat34> moment = moments(tree, vertices_bar);
    for (Index l = tree.first_link; l < tree.last_link; ++l) {
      const Index k = l - tree.first_link;
      const Mat34& m = moment[k];
      if (m.isZero(0.0)) continue;
      if (tree.free) {
        const Mat34 u = compose(e.frame, e.to_root[k]);
        Eigen::Map<Vec3>(points_bar + 3 * tree.first_node) += m.col(3);
        for (int i = 0; i < 3; ++i) {
          points_bar[3 * (tree.first_node + 1) + i] += inner(Mat34(e.turn.first[i] * u), m);
        }
      }
      const Mat34 in_root = e.turn.value.transpose() * m;
      const Mat34 in_frame = e.frame.leftCols<3>().transpose() * in_root;
      for (std::size_t j = 0; j < path_[l].size(); ++j) {
        points_bar[slot_[given_.links[path_[l][j]].coordinate]] +=
            inner(e.by_joint[k][j], in_frame);
      }
      Mat34 frame_bar;
      frame_bar.leftCols<3>() = in_root * e.to_root[k].transpose();
      frame_bar.col(3) = in_root.col(3);
      add_to_frame(tree, frame_bar, points_bar);
    }
  }
}

/// Second derivatives by the numbers of a tree's nodes, including prescribed ones.
Eigen::MatrixXd Mechanisms::curvature(const Tree& tree,
                                      const Eval& e,
                                      const std::vector<Mat34>& moment) const {
  const Index size = 3 * (tree.last_node - tree.first_node);
  Eigen::MatrixXd k = Eigen::MatrixXd::Zero(size, size);
  const auto add = [&](Index i, Index j, double value) { k(i, j) += value; };
  for (Index l = tree.first_link; l < tree.last_link; ++l) {
    const Index at = l - tree.first_link;
    const Mat34& m = moment[at];
    if (m.isZero(0.0)) continue;
    const Mat34 u = compose(e.frame, e.to_root[at]);
    const Mat3 frame = e.frame.leftCols<3>();
    const std::vector<Index>& path = path_[l];
    const auto local = [&](std::size_t j) {
      return slot_[given_.links[path[j]].coordinate] - 3 * tree.first_node;
    };
    if (tree.free) {
      const Mat3 mu = m * u.transpose();
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) add(3 + i, 3 + j, inner(e.turn.second[i][j], mu));
        for (std::size_t j = 0; j < path.size(); ++j) {
          const double value = inner(Mat34(e.turn.first[i] * (frame * e.by_joint[at][j])), m);
          add(3 + i, local(j), value);
          add(local(j), 3 + i, value);
        }
      }
    }
    const Mat34 in_frame = frame.transpose() * (e.turn.value.transpose() * m);
    for (std::size_t i = 0; i < path.size(); ++i) {
      if (given_.links[path[i]].kind.turn == 0.0) continue;
      const Mat3 turn = cross_matrix(e.links[path[i] - tree.first_link].joint.angular);
      for (std::size_t j = i; j < path.size(); ++j) {
        const double value = inner(Mat34(turn * e.by_joint[at][j]), in_frame);
        add(local(i), local(j), value);
        if (i != j) add(local(j), local(i), value);
      }
    }
  }
  return k;
}

Eigen::MatrixXd Mechanisms::curvature(const Tree& tree,
                                      const double* points,
                                      const double* g) const {
  return curvature(tree, evaluate(tree, points), moments(tree, g));
}

void Mechanisms::pull_back_change(const double* points,
                                  const double* change,
                                  const double* g,
                                  double* points_bar) const {
  for (const Tree& tree : trees_) {
    const Eval e = evaluate(tree, points);
    const std::vector<Mat34> moment = moments(tree, g);
    const Eigen::MatrixXd k = curvature(tree, e, moment);
    Eigen::Map<Eigen::VectorXd>(points_bar + 3 * tree.first_node, k.rows()) +=
        k.lazyProduct(Eigen::Map<const Eigen::VectorXd>(change + 3 * tree.first_node, k.cols()));
    // Derivative by the frame, of Rdot S C m + R S Cdot m.
    const Mat3 d_turn = turn_rate(tree, e, change);
    for (Index l = tree.first_link; l < tree.last_link; ++l) {
      const Index at = l - tree.first_link;
      const Mat34& m = moment[at];
      if (m.isZero(0.0)) continue;
      const Mat34 turned = d_turn.transpose() * m;
      Mat34 frame_bar;
      frame_bar.leftCols<3>() =
          turned * e.to_root[at].transpose() +
          e.turn.value.transpose() * m * link_rate(tree, e, l, change).transpose();
      frame_bar.col(3) = turned.col(3);
      add_to_frame(tree, frame_bar, points_bar);
    }
  }
}

// The contribution of moving frames is computed one coordinate at a time.
void Mechanisms::push_forward_change(const double* points,
                                     const double* change,
                                     const double* g,
                                     double* points_dot) const {
  std::vector<double> unit(3 * static_cast<std::size_t>(point_count()), 0.0);
  std::vector<double> bar(unit.size());
  for (const Tree& tree : trees_) {
    const Eval e = evaluate(tree, points);
    const Eigen::MatrixXd k = curvature(tree, e, moments(tree, g));
    Eigen::Map<Eigen::VectorXd>(points_dot + 3 * tree.first_node, k.rows()) +=
        k.lazyProduct(Eigen::Map<const Eigen::VectorXd>(change + 3 * tree.first_node, k.cols()));
    const Eigen::Map<const Eigen::Matrix<double, 12, 1>> frame_dot(change + 3 * tree.frame);
    if (frame_dot.isZero(0.0)) continue;
    for (Index c = tree.first_coordinate; c < tree.last_coordinate; ++c) {
      std::ranges::fill(bar, 0.0);
      unit[slot_[c]] = 1.0;
      pull_back_change(points, unit.data(), g, bar.data());
      unit[slot_[c]] = 0.0;
      points_dot[slot_[c]] += frame_dot.dot(
          Eigen::Map<const Eigen::Matrix<double, 12, 1>>(bar.data() + 3 * tree.frame));
    }
  }
}

linalg::Attachments Mechanisms::attachments(Index first_point, Index first_row) const {
  linalg::Attachments out;
  out.first = first_point;
  for (const Surface& s : surface_) {
    std::vector<Index> nodes;
    if (s.tree >= 0 && s.dynamic) {
      const Tree& tree = trees_[s.tree];
      if (tree.free) nodes = {tree.first_node, tree.first_node + 1};
      for (const Index joint : path_[s.link]) {
        const Index node = slot_[given_.links[joint].coordinate] / 3;
        if (!is_prescribed(node)) nodes.push_back(node);
      }
      std::ranges::sort(nodes);
      nodes.erase(std::unique(nodes.begin(), nodes.end()), nodes.end());
    }
    for (Index v = s.first; v < s.last; ++v) {
      for (const Index node : nodes) {
        out.entries.push_back({.row = first_row + node, .jacobian = Mat3::Zero()});
      }
      out.start.push_back(static_cast<Index>(out.entries.size()));
    }
  }
  return out;
}

void Mechanisms::differentiate(const double* points,
                               Index first_row,
                               linalg::Attachments& out) const {
  for (const Tree& tree : trees_) {
    const Eval e = evaluate(tree, points);
    for (const Index surface : tree.surfaces) {
      const Surface& s = surface_[surface];
      if (!s.dynamic || s.first == s.last) continue;
      const Index at = s.link - tree.first_link;
      // Derivatives of the link's transform by each number of its nodes, in their order.
      const auto* const begin = out.begin(out.first + s.first);
      const auto count = static_cast<std::size_t>(out.end(out.first + s.first) - begin);
      std::vector<std::array<Mat34, 3>> d(count);
      for (auto& columns : d) columns.fill(Mat34::Zero());
      const auto place_of = [&](Index node) {
        for (std::size_t k = 0; k < count; ++k) {
          if (begin[k].row == first_row + node) return k;
        }
        return count;
      };
      const Mat34 u = compose(e.frame, e.to_root[at]);
      if (tree.free) {
        for (int i = 0; i < 3; ++i) {
          d[0][i].col(3) = Vec3::Unit(i);
          d[1][i] = e.turn.first[i] * u;
        }
      }
      const Mat3 to_world = e.turn.value * e.frame.leftCols<3>();
      for (std::size_t j = 0; j < path_[s.link].size(); ++j) {
        const Index slot = slot_[given_.links[path_[s.link][j]].coordinate];
        if (is_prescribed(slot / 3)) continue;
        d[place_of(slot / 3)][slot % 3] += to_world * e.by_joint[at][j];
      }
      for (Index v = s.first; v < s.last; ++v) {
        const Vec3 local = row(vertices_.data(), v);
        linalg::Attachments::Entry* entry = out.entries.data() + out.start[v];
        for (std::size_t k = 0; k < count; ++k) {
          for (int i = 0; i < 3; ++i) entry[k].jacobian.col(i) = apply(d[k][i], local);
        }
      }
    }
  }
}

double Mechanisms::turn(const double* change) const {
  double largest = 0.0;
  for (const Tree& tree : trees_) {
    const double root = tree.free ? row(change, tree.first_node + 1).norm() : 0.0;
    largest = std::max(largest, root);
    for (Index l = tree.first_link; l < tree.last_link; ++l) {
      double sum = root;
      for (const Index joint : path_[l]) {
        const Link& link = given_.links[joint];
        sum += std::abs(link.turn() * change[slot_[link.coordinate]]);
      }
      largest = std::max(largest, sum);
    }
  }
  return largest;
}

double Mechanisms::turn_between(const double* from, const double* to) const {
  double largest = 0.0;
  for (const Tree& tree : trees_) {
    double root = 0.0;
    if (!tree.free) {
      // Angle between the frames' rotations: |R_b - R_a|_F = 2 sqrt(2) sin(angle / 2).
      double sum = 0.0;
      for (int a = 0; a < 3; ++a) {
        sum += (row(to, tree.frame + a) - row(from, tree.frame + a)).squaredNorm();
      }
      root = 2.0 * std::asin(std::min(1.0, std::sqrt(sum / 8.0)));
    }
    for (Index l = tree.first_link; l < tree.last_link; ++l) {
      double sum = root;
      for (const Index joint : path_[l]) {
        const Link& link = given_.links[joint];
        if (given_.prescribed[link.coordinate] == 0) continue;
        const Index slot = slot_[link.coordinate];
        sum += std::abs(link.turn() * (to[slot] - from[slot]));
      }
      largest = std::max(largest, sum);
    }
  }
  return largest;
}

}  // namespace diffcloth::bodies
