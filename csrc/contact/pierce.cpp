#include "contact/pierce.h"

#include <array>
#include <cmath>

#include <Eigen/Geometry>

#include "contact/distance/separation.h"

namespace diffcloth::contact {
namespace {

/// Relative error of the determinant of rounded differences, [Shewchuk 1997], rounded up.
constexpr double kOrientationError = 1e-15;

/// Exact number: an unevaluated sum of doubles that do not overlap, smallest first.
class Expansion {
 public:
  void add(double b) {
    double q = b;
    int kept = 0;
    for (int i = 0; i < count_; ++i) {
      const double sum = q + terms_[i];
      const double rounded = sum - q;
      const double error = (q - (sum - rounded)) + (terms_[i] - rounded);
      q = sum;
      if (error != 0) terms_[kept++] = error;
    }
    if (q != 0) terms_[kept++] = q;
    count_ = kept;
  }

  /// Add sign * a * b * c: fused multiply-add splits every product into value and error.
  void add_product(double sign, double a, double b, double c) {
    const double ab = a * b;
    if (ab == 0 || c == 0) return;
    const double ab_error = std::fma(a, b, -ab);
    for (const double factor : {ab, ab_error}) {
      const double abc = factor * c;
      add(sign * abc);
      add(sign * std::fma(factor, c, -abc));
    }
  }

  int sign() const {
    if (count_ == 0) return 0;
    return terms_[count_ - 1] > 0 ? 1 : -1;
  }

 private:
  std::array<double, 200> terms_;  // 6 products of 3 differences of 2 terms, 4 terms each: 192
  int count_ = 0;
};

/// a - b = value + error, exactly.
struct Difference {
  std::array<double, 2> terms;

  Difference(double a, double b) {
    const double value = a - b;
    const double b_rounded = a - value;
    terms = {value, (a - (value + b_rounded)) + (b_rounded - b)};
  }
};

int exact_orientation(const Vec3& a, const Vec3& b, const Vec3& c, const Vec3& d) {
  const std::array<Vec3, 3> points{b, c, d};
  Expansion determinant;
  constexpr std::array<std::array<int, 3>, 6> kPermutations{
      {{0, 1, 2}, {1, 2, 0}, {2, 0, 1}, {0, 2, 1}, {2, 1, 0}, {1, 0, 2}}};
  for (int p = 0; p < 6; ++p) {
    const auto& [i, j, k] = kPermutations[p];
    const double sign = p < 3 ? 1 : -1;
    for (const double x : Difference(points[0][i], a[i]).terms) {
      for (const double y : Difference(points[1][j], a[j]).terms) {
        for (const double z : Difference(points[2][k], a[k]).terms) {
          determinant.add_product(sign, x, y, z);
        }
      }
    }
  }
  return determinant.sign();
}

/// Sign of the determinant if rounded arithmetic determines it, else 0.
int quick_orientation(const Vec3& a, const Vec3& b, const Vec3& c, const Vec3& d) {
  const Vec3 u = b - a;
  const Vec3 v = c - a;
  const Vec3 w = d - a;
  const double determinant = u.cross(v).dot(w);
  const Vec3 permanent = Vec3(std::abs(u[1] * v[2]) + std::abs(u[2] * v[1]),
                              std::abs(u[2] * v[0]) + std::abs(u[0] * v[2]),
                              std::abs(u[0] * v[1]) + std::abs(u[1] * v[0]));
  const double error = kOrientationError * permanent.dot(w.cwiseAbs());
  if (determinant > error) return 1;
  if (determinant < -error) return -1;
  return 0;
}

/// True if a plane with normal n certainly separates the edge and the triangle.
bool separates(const Vec3& n, const std::array<Vec3, 2>& e, const std::array<Vec3, 3>& t) {
  for (const Vec3& p : e) {
    for (const Vec3& q : t) {
      const Vec3 difference = p - q;
      const double error = kOrientationError * n.cwiseAbs().dot(difference.cwiseAbs());
      if (!(n.dot(difference) > error)) return false;
    }
  }
  return true;
}

/// True if a plane certainly separates the edge and the triangle. Two are tried: normal to the vector
/// between their centroids, which mostly suffices, then normal to the shortest vector between their
/// points and edges.
bool certainly_apart(const std::array<Vec3, 2>& e, const std::array<Vec3, 3>& t) {
  if (separates(3.0 * (e[0] + e[1]) - 2.0 * (t[0] + t[1] + t[2]), e, t)) return true;
  Vec3 n = separation(PairKind::kPointTriangle, {e[0], t[0], t[1], t[2]});
  const auto offer = [&n](const Vec3& candidate) {
    if (candidate.squaredNorm() < n.squaredNorm()) n = candidate;
  };
  offer(separation(PairKind::kPointTriangle, {e[1], t[0], t[1], t[2]}));
  for (int k = 0; k < 3; ++k) {
    offer(separation(PairKind::kEdgeEdge, {e[0], e[1], t[k], t[(k + 1) % 3]}));
  }
  return separates(n, e, t);
}

}  // namespace

int orientation(const Vec3& a, const Vec3& b, const Vec3& c, const Vec3& d) {
  const int sign = quick_orientation(a, b, c, d);
  return sign != 0 ? sign : exact_orientation(a, b, c, d);
}

bool pierces(const Vec3& e0, const Vec3& e1, const Vec3& t0, const Vec3& t1, const Vec3& t2) {
  const int above = quick_orientation(t0, t1, t2, e0);
  const int below = quick_orientation(t0, t1, t2, e1);
  if (above * below > 0) return false;
  // Nearly coplanar pairs are common (a flat sheet) and mostly far apart: exact signs are computed only
  // for pairs that no plane separates.
  if ((above == 0 || below == 0) && certainly_apart({e0, e1}, {t0, t1, t2})) return false;

  const int side_0 = orientation(t0, t1, t2, e0);
  const int side_1 = orientation(t0, t1, t2, e1);
  if (side_0 * side_1 > 0 || (side_0 == 0 && side_1 == 0)) return false;
  const int around_0 = orientation(e0, e1, t0, t1);
  const int around_1 = orientation(e0, e1, t1, t2);
  const int around_2 = orientation(e0, e1, t2, t0);
  const bool some_left = around_0 > 0 || around_1 > 0 || around_2 > 0;
  const bool some_right = around_0 < 0 || around_1 < 0 || around_2 < 0;
  return !(some_left && some_right);
}

}  // namespace diffcloth::contact
