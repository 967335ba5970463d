#include "elastic/chord_strain.h"

#include <array>

#include "elastic/elements.h"
#include "elastic/symmetric2.h"

namespace diffcloth::elastic {
namespace {

/// q_0, a squared strain: larger than in smooth motion at common time steps, smaller than a visible strain.
constexpr double kFree = 1e-4;

/// phi and its derivatives.
struct Law {
  explicit Law(double q)
      : value(0.5 * q * q / (q + kFree)),
        first(0.5 * q * (q + 2.0 * kFree) / ((q + kFree) * (q + kFree))),
        second(kFree * kFree / ((q + kFree) * (q + kFree) * (q + kFree))) {}

  double value, first, second;
};

double dot(const Mat2& a, const Mat2& b) { return a.cwiseProduct(b).sum(); }

}  // namespace

/// A face at x.
struct ChordStrain::Face {
  Mat32 D;  ///< F(d)
  Mat32 G;  ///< F(x - c)
  Mat2 e;
  Law law;
  double weight;  ///< k A

  /// The change of e along a change Z of G.
  Mat2 change(const Mat32& Z) const { return symmetric_part(Z.transpose() * D); }

  /// dE/dG.
  Mat32 stress() const { return (2.0 * weight * law.first) * D * e; }

  /// Change of dE/dG along changes of G and D, at equal weight.
  Mat32 stress_change(const Mat32& G_dot, const Mat32& D_dot) const {
    const Mat2 e_dot = symmetric_part(G_dot.transpose() * D + G.transpose() * D_dot);
    const double q_dot = 2.0 * dot(e, e_dot);
    return 2.0 * weight * ((law.second * q_dot) * D * e + law.first * (D_dot * e + D * e_dot));
  }
};

ChordStrain::ChordStrain(ElasticPotential& elastic, const double* shift, const double* center)
    : shift_bar(3 * static_cast<std::size_t>(elastic.model().topology->vertex_count), 0.0),
      center_bar(shift_bar),
      elastic_(elastic),
      model_(elastic.model()),
      shift_(shift),
      center_(center) {}

double ChordStrain::stiffness(Index f) const {
  if (!is_woven(model_)) return model_.stretch[f];
  return 0.25 * (model_.stretch[f] + model_.stretch_weft[f]) + 0.5 * model_.stretch_shear[f];
}

const ChordStrain::Constants& ChordStrain::constants(Index f) const {
  if (constants_.empty()) {
    for (Index k = 0; k < face_count(model_); ++k) {
      constants_.push_back({.D = face_gradient(model_, k, shift_),
                            .center = face_gradient(model_, k, center_),
                            .weight = stiffness(k) * model_.rest->area[k]});
    }
  }
  return constants_[f];
}

ChordStrain::Face ChordStrain::face(Index f, const double* x) const {
  const Constants& of = constants(f);
  const Mat32 G = face_gradient(model_, f, x) - of.center;
  const Mat2 e = symmetric_part(G.transpose() * of.D);
  return {.D = of.D, .G = G, .e = e, .law = Law(dot(e, e)), .weight = of.weight};
}

double ChordStrain::energy(const double* x) const {
  double total = 0.0;
  for (Index f = 0; f < face_count(model_); ++f) {
    const Face at = face(f, x);
    total += at.weight * at.law.value;
  }
  return total;
}

double ChordStrain::energy_change(const double* x, const double* to) const {
  double total = 0.0;
  for (Index f = 0; f < face_count(model_); ++f) {
    const Face from = face(f, x);
    const Face end = face(f, to);
    // phi(q') - phi(q) = 1/2 (q' - q) (q q' + q_0 (q + q')) / ((q + q_0) (q' + q_0)).
    const double q = dot(from.e, from.e);
    const double q_end = dot(end.e, end.e);
    const double step = dot(end.e - from.e, end.e + from.e);
    total += 0.5 * from.weight * step * (q * q_end + kFree * (q + q_end)) /
             ((q + kFree) * (q_end + kFree));
  }
  return total;
}

void ChordStrain::add_gradient(const double* x, double* g) const {
  for (Index f = 0; f < face_count(model_); ++f) scatter(model_, f, face(f, x).stress(), g);
}

void ChordStrain::add_hessian(const double* x,
                              Curvature /*curvature*/,
                              linalg::BlockMatrix& A) const {
  for (Index f = 0; f < face_count(model_); ++f) {
    const Face at = face(f, x);
    if (at.law.first == 0.0) continue;
    const mesh::ShapeGradient& g = model_.rest->shape_gradient[f];
    const Mat3 DD = at.D * at.D.transpose();
    const Mat32 De = at.D * at.e;
    std::array<Vec3, 3> turned;
    std::array<Vec3, 3> along;
    for (int p = 0; p < 3; ++p) {
      turned[p] = at.D * g.row(p).transpose();
      along[p] = De * g.row(p).transpose();
    }
    const double first = at.weight * at.law.first;
    const double second = 4.0 * at.weight * at.law.second;
    A.add_rows(model_.topology->faces[f], [&](int p, int q) -> Mat3 {
      return first * (g.row(p).dot(g.row(q)) * DD + turned[q] * turned[p].transpose()) +
             second * along[p] * along[q].transpose();
    });
  }
}

void ChordStrain::add_hessian_product(const double* x, const double* z, double* y) const {
  for (Index f = 0; f < face_count(model_); ++f) {
    const Mat32 Z = face_gradient(model_, f, z);
    scatter(model_, f, face(f, x).stress_change(Z, Mat32::Zero()), y);
  }
}

// phi = z . grad E = <stress, Z>: differentiate it by G and D, which transposes the derivative of the stress.
void ChordStrain::accumulate(const double* x, const double* z) {
  const Wanted wanted = elastic_.wanted();
  Bar& bar = elastic_.bar();
  for (Index f = 0; f < face_count(model_); ++f) {
    const Face at = face(f, x);
    const Mat32 Z = -face_gradient(model_, f, z);
    const Mat2 e_z = at.change(Z);
    const double along = dot(at.e, e_z);
    // <stress, Z> = 2 w phi'(q) <e, e_z>: by e and by e_z.
    const Mat2 e_bar = 2.0 * at.weight * (2.0 * at.law.second * along * at.e + at.law.first * e_z);
    const Mat2 e_z_bar = (2.0 * at.weight * at.law.first) * at.e;
    const Mat32 G_bar = at.D * e_bar;
    const Mat32 D_bar = at.G * e_bar + Z * e_z_bar;
    scatter(model_, f, D_bar, shift_bar.data());
    scatter(model_, f, -G_bar, center_bar.data());
    if (wanted == Wanted::kNone) continue;
    const double weight_bar = 2.0 * at.law.first * along;
    const double k_bar = weight_bar * model_.rest->area[f];
    if (is_woven(model_)) {
      bar.stretch[f] += 0.25 * k_bar;
      bar.stretch_weft[f] += 0.25 * k_bar;
      bar.stretch_shear[f] += 0.5 * k_bar;
    } else {
      bar.stretch[f] += k_bar;
    }
    if (wanted != Wanted::kMaterialsAndRest) continue;
    bar.rest.area[f] += weight_bar * stiffness(f);
    mesh::ShapeGradient& g_bar = bar.rest.shape_gradient[f];
    scatter_gradient_bar(model_, f, D_bar, shift_, g_bar);
    scatter_gradient_bar(model_, f, G_bar, x, g_bar);
    scatter_gradient_bar(model_, f, -G_bar, center_, g_bar);
    scatter_gradient_bar(model_, f, -at.stress(), z, g_bar);
  }
}

void ChordStrain::add_tangent(const double* x, double* y) const {
  const Bar& dot_of = elastic_.tangent();
  const Changing& changing = elastic_.changing();
  for (Index f = 0; f < face_count(model_); ++f) {
    const Face at = face(f, x);
    Mat32 D_dot = face_gradient(model_, f, shift_dot.data());
    Mat32 G_dot = -face_gradient(model_, f, center_dot.data());
    double weight_dot = 0.0;
    if (changing.materials) {
      const double k_dot = is_woven(model_) ? 0.25 * (dot_of.stretch[f] + dot_of.stretch_weft[f]) +
                                                  0.5 * dot_of.stretch_shear[f]
                                            : dot_of.stretch[f];
      weight_dot += k_dot * model_.rest->area[f];
    }
    if (changing.rest) {
      weight_dot += stiffness(f) * dot_of.rest.area[f];
      const mesh::ShapeGradient& g_dot = dot_of.rest.shape_gradient[f];
      D_dot += face_gradient(model_, f, g_dot, shift_);
      G_dot += face_gradient(model_, f, g_dot, x) - face_gradient(model_, f, g_dot, center_);
      scatter(model_, f, at.stress(), g_dot, y);
    }
    const Mat32 change =
        at.stress_change(G_dot, D_dot) + (2.0 * weight_dot * at.law.first) * at.D * at.e;
    scatter(model_, f, change, y);
  }
}

}  // namespace diffcloth::elastic
