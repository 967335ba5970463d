#include "elastic/chord_strain.h"

#include "elastic/elements.h"
#include "elastic/face_batches.h"
#include "elastic/symmetric2.h"

namespace diffcloth::elastic {
namespace {

/// Derivatives of phi.
struct Law {
  explicit Law(double q)
      : first(0.5 * q * (q + 2.0 * kFreeStrainSq) / ((q + kFreeStrainSq) * (q + kFreeStrainSq))),
        second(kFreeStrainSq * kFreeStrainSq /
               ((q + kFreeStrainSq) * (q + kFreeStrainSq) * (q + kFreeStrainSq))) {}

  double first, second;
};

/// Visit the stiffnesses of a model, or their cotangents, with their shares in the mean stiffness.
template <class Stiffnesses, class Visit>
void for_each_share(const Model& model, Stiffnesses& of, Visit&& visit) {
  if (!is_woven(model)) return visit(of.stretch, 1.0);
  visit(of.stretch, 0.25);
  visit(of.stretch_weft, 0.25);
  visit(of.stretch_shear, 0.5);
}

/// The mean stiffness of a face, or its tangent.
template <class Stiffnesses>
double mean_stiffness(const Model& model, const Stiffnesses& of, Index f) {
  double mean = 0.0;
  for_each_share(model, of,
                 [&](const std::vector<double>& k, double share) { mean += share * k[f]; });
  return mean;
}

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

const std::vector<ChordBatch>& ChordStrain::batches() const {
  if (batches_.empty()) {
    std::vector<double> weight(model_.rest->area);
    for (Index f = 0; f < face_count(model_); ++f) weight[f] *= mean_stiffness(model_, model_, f);
    batches_ = chord_batches(model_, elastic_.slots(), shift_, center_, weight);
  }
  return batches_;
}

ChordStrain::Face ChordStrain::face(Index f, const double* x) const {
  const Mat32 D = face_gradient(model_, f, shift_);
  const Mat32 G = face_gradient(model_, f, x) - face_gradient(model_, f, center_);
  const Mat2 e = symmetric_part(G.transpose() * D);
  return {.D = D,
          .G = G,
          .e = e,
          .law = Law(dot(e, e)),
          .weight = mean_stiffness(model_, model_, f) * model_.rest->area[f]};
}

double ChordStrain::energy(const double* x) const {
  return stretch_kernels().chord_energy(batches().data(), batches().size(), x);
}

double ChordStrain::energy_change(const double* x, const double* to) const {
  return stretch_kernels().chord_energy_change(batches().data(), batches().size(), x, to);
}

void ChordStrain::add_gradient(const double* x, double* g) const {
  stretch_kernels().add_chord_gradient(batches().data(), batches().size(), x, g);
}

void ChordStrain::add_hessian(const double* x,
                              Curvature /*curvature*/,
                              linalg::BlockMatrix& A) const {
  stretch_kernels().add_chord_hessian(batches().data(), batches().size(), x,
                                      A.slot_of_base().data(), A.blocks());
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
    for_each_share(model_, bar,
                   [&](std::vector<double>& k, double share) { k[f] += share * k_bar; });
    if (wanted != Wanted::kMaterialsAndRest) continue;
    bar.rest.area[f] += weight_bar * mean_stiffness(model_, model_, f);
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
      weight_dot += mean_stiffness(model_, dot_of, f) * model_.rest->area[f];
    }
    if (changing.rest) {
      weight_dot += mean_stiffness(model_, model_, f) * dot_of.rest.area[f];
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
