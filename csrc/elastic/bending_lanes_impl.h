// The arithmetic of BendingKernels, written once: see stretch_lanes_impl.h.

#pragma once

#include <cstddef>

#include "elastic/bending_lanes.h"
#include "elastic/block_lanes_impl.h"
#include "elastic/polar_lanes_impl.h"

// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::elastic {
namespace {

constexpr int kLanes = kBendingLanes;

/// N numbers of each lane.
template <int N>
struct Lanes {
  alignas(64) double at[N][kLanes];
};

/// A vector of one lane.
struct Vector {
  double at[3];
};

DIFFCLOTH_INLINE Vector cross(const Vector& a, const Vector& b) {
  return {{a.at[1] * b.at[2] - a.at[2] * b.at[1], a.at[2] * b.at[0] - a.at[0] * b.at[2],
           a.at[0] * b.at[1] - a.at[1] * b.at[0]}};
}

template <int N>
DIFFCLOTH_INLINE Vector vector_at(const double (&values)[N][kLanes], int column, int l) {
  return {{values[3 * column][l], values[3 * column + 1][l], values[3 * column + 2][l]}};
}

template <int N>
DIFFCLOTH_INLINE void put(const Vector& v, int column, int l, double (&values)[N][kLanes]) {
  for (int k = 0; k < 3; ++k) values[3 * column + k][l] = v.at[k];
}

/// weight Q of one lane.
struct Form {
  double at[3][3];
};

DIFFCLOTH_INLINE Form form_of(const BendingBatch& batch, int l) {
  const double (&Q)[6][kLanes] = batch.Q;
  return {{{Q[0][l], Q[1][l], Q[3][l]}, {Q[1][l], Q[2][l], Q[4][l]}, {Q[3][l], Q[4][l], Q[5][l]}}};
}

/// Columns of a 3x3 matrix of one lane.
struct Matrix {
  Vector column[3];
};

template <int N>
DIFFCLOTH_INLINE Matrix matrix_at(const double (&values)[N][kLanes], int l) {
  return {{vector_at(values, 0, l), vector_at(values, 1, l), vector_at(values, 2, l)}};
}

/// scale M Q
DIFFCLOTH_INLINE Matrix times_form(double scale, const Matrix& M, const Form& Q) {
  Matrix result;
  for (int a = 0; a < 3; ++a) {
    for (int k = 0; k < 3; ++k) {
      result.column[a].at[k] =
          scale * (M.column[0].at[k] * Q.at[0][a] + M.column[1].at[k] * Q.at[1][a] +
                   M.column[2].at[k] * Q.at[2][a]);
    }
  }
  return result;
}

DIFFCLOTH_INLINE Matrix difference(const Matrix& a, const Matrix& b) {
  Matrix result;
  for (int c = 0; c < 3; ++c) {
    for (int k = 0; k < 3; ++k) result.column[c].at[k] = a.column[c].at[k] - b.column[c].at[k];
  }
  return result;
}

DIFFCLOTH_INLINE Matrix sum(const Matrix& a, const Matrix& b) {
  Matrix result;
  for (int c = 0; c < 3; ++c) {
    for (int k = 0; k < 3; ++k) result.column[c].at[k] = a.column[c].at[k] + b.column[c].at[k];
  }
  return result;
}

/// R M with the columns r1, r2, n of R.
DIFFCLOTH_INLINE Matrix turned(const Matrix& R, const Matrix& M) {
  Matrix result;
  for (int a = 0; a < 3; ++a) {
    const Vector& m = M.column[a];
    for (int k = 0; k < 3; ++k) {
      result.column[a].at[k] =
          R.column[0].at[k] * m.at[0] + R.column[1].at[k] * m.at[1] + R.column[2].at[k] * m.at[2];
    }
  }
  return result;
}

/// R^T M
DIFFCLOTH_INLINE Matrix turned_back(const Matrix& R, const Matrix& M) {
  Matrix result;
  for (int a = 0; a < 3; ++a) {
    for (int k = 0; k < 3; ++k) result.column[a].at[k] = dot(R.column[k].at, M.column[a].at);
  }
  return result;
}

DIFFCLOTH_INLINE double inner(const Matrix& a, const Matrix& b) {
  double result = 0.0;
  for (int c = 0; c < 3; ++c) result += dot(a.column[c].at, b.column[c].at);
  return result;
}

/// Call f<kCurved>(): without curvature at rest, the terms of b are left out, which are zero.
template <class Call>
DIFFCLOTH_INLINE void with_curved(const BendingBatch& batch, Call call) {
  if (batch.curved != 0) {
    call.template operator()<true>();
  } else {
    call.template operator()<false>();
  }
}

/// Y, and the sides of the base triangle.
struct Shape {
  Lanes<9> Y;
  Lanes<6> sides;
};

/// Y += side c^T of a point.
DIFFCLOTH_INLINE void add_to_shape(const BendingPoint& point, const Lanes<3>& side, Lanes<9>& Y) {
  for (int a = 0; a < 3; ++a) {
    for (int k = 0; k < 3; ++k) {
      for (int l = 0; l < kLanes; ++l) Y.at[3 * a + k][l] += side.at[k][l] * point.c[a][l];
    }
  }
}

DIFFCLOTH_INLINE void put_side(int i, const Lanes<3>& side, Lanes<6>& sides) {
  for (int k = 0; k < 3; ++k) {
    for (int l = 0; l < kLanes; ++l) sides.at[3 * (i - 1) + k][l] = side.at[k][l];
  }
}

/// Call visit(i, side) for the sides x_i - x_0 of the elements.
template <class Visit>
DIFFCLOTH_INLINE void for_sides(const BendingBatch& batch,
                                const BendingPoint* points,
                                const double* x,
                                Visit visit) {
  const BendingPoint* const first = points + batch.first;
  for (int i = 1; i < batch.points; ++i) {
    Lanes<3> side;
    for (int l = 0; l < kLanes; ++l) {
      const double* const at = x + 3 * static_cast<std::ptrdiff_t>(first[i].vertex[l]);
      const double* const at_0 = x + 3 * static_cast<std::ptrdiff_t>(first->vertex[l]);
      for (int k = 0; k < 3; ++k) side.at[k][l] = at[k] - at_0[k];
    }
    visit(i, side);
  }
}

DIFFCLOTH_INLINE void gather_at(const BendingBatch& batch,
                                const BendingPoint* points,
                                const double* x,
                                Shape& shape) {
  shape.Y = {};
  for_sides(batch, points, x, [&](int i, const Lanes<3>& side) {
    add_to_shape(points[batch.first + i], side, shape.Y);
    if (i <= 2) put_side(i, side, shape.sides);
  });
}

DIFFCLOTH_INLINE Polar polar_at(const BendingBatch& batch, const Lanes<6>& sides, int l) {
  Gradient F;
  for (int k = 0; k < 3; ++k) {
    F.a[k] = sides.at[k][l] * batch.g[0][l] + sides.at[3 + k][l] * batch.g[2][l];
    F.b[k] = sides.at[k][l] * batch.g[1][l] + sides.at[3 + k][l] * batch.g[3][l];
  }
  return polar_of(F);
}

DIFFCLOTH_INLINE void find_state(const BendingBatch& batch,
                                 const Shape& shape,
                                 BendingState& state) {
  for (int l = 0; l < kLanes; ++l) {
    const Polar polar = polar_at(batch, shape.sides, l);
    for (int k = 0; k < 3; ++k) {
      state.R[k][l] = polar.r1[k];
      state.R[3 + k][l] = polar.r2[k];
      state.R[6 + k][l] = polar.n[k];
    }
    state.S_inv[0][l] = polar.s11;
    state.S_inv[1][l] = polar.s12;
    state.S_inv[2][l] = polar.s22;
    state.t[l] = polar.t;
    for (int k = 0; k < 9; ++k) state.Y[k][l] = shape.Y.at[k][l];
  }
}

void evaluate(const BendingBatch* batches,
              std::size_t count,
              const BendingPoint* points,
              const double* x,
              BendingState* at) {
  for (const BendingBatch* batch = batches; batch != batches + count; ++batch, ++at) {
    Shape shape;
    gather_at(*batch, points, x, shape);
    BendingState state;  // known not to overlap the batch
    find_state(*batch, shape, state);
    *at = state;
  }
}

/// Half the change of s : s Q, in world axes, for s with a start and a change.
DIFFCLOTH_INLINE double half_change(const Matrix& s0, const Matrix& ds, const Form& Q) {
  return 0.5 * inner(times_form(1.0, sum(sum(s0, s0), ds), Q), ds);
}

/// weight / 2 (|s1 Q|^2 - |s0 Q|^2) in world axes, of s = Y - R b.
DIFFCLOTH_INLINE double change_of_term(const Matrix& Y0,
                                       const Matrix& dY,
                                       const Matrix& R0,
                                       const Matrix& dR,
                                       const Matrix& b,
                                       const Form& Q) {
  return half_change(difference(Y0, turned(R0, b)), difference(dY, turned(dR, b)), Q);
}

/// Work conjugates of the curvature in the body frame, of both terms, and the torque on the frame.
struct Stress {
  Matrix q, q_n;
  Vector tau;
};

template <bool kCurved>
DIFFCLOTH_INLINE Stress
stress_of(const BendingBatch& batch, const Matrix& R, const Matrix& Y, const Form& Q, int l) {
  const Matrix b_n = matrix_at(batch.b_n, l);
  const Matrix curvature = turned_back(R, Y);
  Stress result;
  result.q_n = times_form(batch.damping[l], difference(curvature, b_n), Q);
  result.tau = {{0.0, 0.0, 0.0}};
  if constexpr (kCurved) {
    const Matrix b = matrix_at(batch.b, l);
    result.q = times_form(1.0, difference(curvature, b), Q);
    for (int a = 0; a < 3; ++a) {
      const Vector of_rest = cross(b.column[a], result.q.column[a]);
      const Vector of_start = cross(b_n.column[a], result.q_n.column[a]);
      for (int k = 0; k < 3; ++k) result.tau.at[k] += of_rest.at[k] + of_start.at[k];
    }
  } else {
    result.q = times_form(1.0, curvature, Q);
    for (int a = 0; a < 3; ++a) {
      const Vector of_start = cross(b_n.column[a], result.q_n.column[a]);
      for (int k = 0; k < 3; ++k) result.tau.at[k] += of_start.at[k];
    }
  }
  return result;
}

/// Cotangents of Y and of the shape gradients F of eight elements.
struct Stresses {
  Lanes<9> Y;
  Lanes<6> F;
};

template <bool kCurved>
DIFFCLOTH_INLINE void put_stresses(const BendingBatch& batch,
                                   const BendingState& state,
                                   int l,
                                   Stresses& stresses) {
  const Matrix R = matrix_at(state.R, l);
  const Stress stress = stress_of<kCurved>(batch, R, matrix_at(state.Y, l), form_of(batch, l), l);
  const Matrix q = turned(R, sum(stress.q, stress.q_n));
  for (int a = 0; a < 3; ++a) put(q.column[a], a, l, stresses.Y.at);
  const double (&S_inv)[3][kLanes] = state.S_inv;
  const double in_plane = stress.tau.at[2] / state.t[l];
  const double out_1 = S_inv[0][l] * stress.tau.at[1] - S_inv[1][l] * stress.tau.at[0];
  const double out_2 = S_inv[1][l] * stress.tau.at[1] - S_inv[2][l] * stress.tau.at[0];
  for (int k = 0; k < 3; ++k) {
    stresses.F.at[k][l] = out_1 * R.column[2].at[k] - in_plane * R.column[1].at[k];
    stresses.F.at[3 + k][l] = out_2 * R.column[2].at[k] + in_plane * R.column[0].at[k];
  }
}

/// g += the forces of eight elements.
DIFFCLOTH_INLINE void add_forces(const BendingBatch& batch,
                                 const BendingPoint* points,
                                 const Stresses& stresses,
                                 double* g) {
  for (int i = 0; i < batch.points; ++i) {
    const BendingPoint& point = points[batch.first + i];
    Lanes<3> force;
    for (int k = 0; k < 3; ++k) {
      for (int l = 0; l < kLanes; ++l) {
        force.at[k][l] = stresses.Y.at[k][l] * point.c[0][l] +
                         stresses.Y.at[3 + k][l] * point.c[1][l] +
                         stresses.Y.at[6 + k][l] * point.c[2][l];
      }
    }
    if (i < 3) {
      for (int k = 0; k < 3; ++k) {
        for (int l = 0; l < kLanes; ++l) {
          const double g_u = i == 0 ? -(batch.g[0][l] + batch.g[2][l]) : batch.g[2 * i - 2][l];
          const double g_v = i == 0 ? -(batch.g[1][l] + batch.g[3][l]) : batch.g[2 * i - 1][l];
          force.at[k][l] += stresses.F.at[k][l] * g_u + stresses.F.at[3 + k][l] * g_v;
        }
      }
    }
    for (int l = 0; l < batch.size; ++l) {
      double* const to = g + 3 * static_cast<std::ptrdiff_t>(point.vertex[l]);
      for (int k = 0; k < 3; ++k) to[k] += force.at[k][l];
    }
  }
}

template <bool kCurved>
DIFFCLOTH_INLINE void find_stresses(const BendingBatch& batch,
                                    const BendingState& state,
                                    Stresses& stresses) {
  for (int l = 0; l < kLanes; ++l) put_stresses<kCurved>(batch, state, l, stresses);
}

void add_gradient(const BendingBatch* batches,
                  std::size_t count,
                  const BendingPoint* points,
                  const BendingState* at,
                  double* g) {
  for (const BendingBatch* batch = batches; batch != batches + count; ++batch, ++at) {
    Stresses stresses;
    with_curved(*batch, [&]<bool kCurved> { find_stresses<kCurved>(*batch, *at, stresses); });
    add_forces(*batch, points, stresses, g);
  }
}

/// Changes of energy of eight elements.
///
/// @param change  of Y, summed from displacements
template <bool kCurved>
DIFFCLOTH_INLINE void find_changes(const BendingBatch& batch,
                                   const BendingState& start,
                                   const BendingState& end,
                                   const Lanes<9>& change,
                                   double (&energy)[kLanes]) {
  for (int l = 0; l < kLanes; ++l) {
    const Matrix R0 = matrix_at(start.R, l);
    const Matrix dR = difference(matrix_at(end.R, l), R0);
    const Matrix Y0 = matrix_at(start.Y, l);
    const Matrix dY = matrix_at(change.at, l);
    const Form Q = form_of(batch, l);
    const double rest =
        kCurved ? change_of_term(Y0, dY, R0, dR, matrix_at(batch.b, l), Q) : half_change(Y0, dY, Q);
    const double damped = change_of_term(Y0, dY, R0, dR, matrix_at(batch.b_n, l), Q);
    energy[l] = rest + batch.damping[l] * damped;
  }
}

double energy_change(const BendingBatch* batches,
                     std::size_t count,
                     const BendingPoint* points,
                     const double* x1,
                     const double* dx,
                     const BendingState* start,
                     BendingState* end,
                     double* g1) {
  double total = 0.0;
  for (const BendingBatch* batch = batches; batch != batches + count; ++batch, ++start, ++end) {
    Shape shape;
    gather_at(*batch, points, x1, shape);
    Lanes<9> change = {};
    for_sides(*batch, points, dx, [&](int i, const Lanes<3>& side) {
      add_to_shape(points[batch->first + i], side, change);
    });
    BendingState state;
    find_state(*batch, shape, state);
    *end = state;
    alignas(64) double energy[kLanes];
    Stresses stresses;
    with_curved(*batch, [&]<bool kCurved> {
      find_changes<kCurved>(*batch, *start, state, change, energy);
      if (g1 != nullptr) find_stresses<kCurved>(*batch, state, stresses);
    });
    if (g1 != nullptr) add_forces(*batch, points, stresses, g1);
    for (int l = 0; l < batch->size; ++l) total += energy[l];
  }
  return total;
}

/// Intermediate results for the Hessians of eight elements; vectors are in the body frame unless noted.
struct Parts {
  Lanes<9> R;
  Lanes<9> bQ;  ///< (b + damping b_n) Q
  Lanes<9> bQ_world;
  Lanes<9> C;      ///< tr(M) I - M of bending_lanes.h
  Lanes<6> g;      ///< shape gradients of the corners p, two each
  Lanes<6> h;      ///< S^-1 g_p
  Lanes<3> gamma;  ///< g_p . rho with rho = S^-1 (-tau_2, tau_1)
  Lanes<3> eta;    ///< h_p . (tau_1, tau_2)
  Lanes<1> inv_t;
  Lanes<1> in_plane;  ///< tau_3 / t
  Lanes<9> alpha;     ///< world: A_p = alpha_p n^T + n epsilon_p^T
  Lanes<9> epsilon;
};

template <bool kCurved>
DIFFCLOTH_INLINE void find_parts(const BendingBatch& batch,
                                 const BendingState& state,
                                 bool positive,
                                 Parts& parts) {
  const double exact = positive ? 0.0 : 1.0;
  for (int l = 0; l < kLanes; ++l) {
    const Matrix R = matrix_at(state.R, l);
    const double s11 = state.S_inv[0][l];
    const double s12 = state.S_inv[1][l];
    const double s22 = state.S_inv[2][l];
    const Form Q = form_of(batch, l);
    const Stress stress = stress_of<kCurved>(batch, R, matrix_at(state.Y, l), Q, l);
    const Matrix b_n = matrix_at(batch.b_n, l);
    const Matrix of_start = times_form(batch.damping[l], b_n, Q);
    Matrix b;
    Matrix of_rest;
    Matrix bQ = of_start;
    if constexpr (kCurved) {
      b = matrix_at(batch.b, l);
      of_rest = times_form(1.0, b, Q);
      bQ = sum(of_rest, of_start);
    }
    const Matrix world = turned(R, bQ);
    double M[3][3];
    double trace = 0.0;
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) {
        double gauss_newton = 0.0;
        double geometric = 0.0;
        for (int a = 0; a < 3; ++a) {
          if constexpr (kCurved) {
            gauss_newton += of_rest.column[a].at[i] * b.column[a].at[j] +
                            of_start.column[a].at[i] * b_n.column[a].at[j];
            geometric += stress.q.column[a].at[i] * b.column[a].at[j] +
                         stress.q_n.column[a].at[i] * b_n.column[a].at[j];
          } else {
            gauss_newton += of_start.column[a].at[i] * b_n.column[a].at[j];
            geometric += stress.q_n.column[a].at[i] * b_n.column[a].at[j];
          }
        }
        M[i][j] = gauss_newton + exact * geometric;
      }
      trace += M[i][i];
    }
    for (int j = 0; j < 3; ++j) {
      put(R.column[j], j, l, parts.R.at);
      put(bQ.column[j], j, l, parts.bQ.at);
      put(world.column[j], j, l, parts.bQ_world.at);
      for (int i = 0; i < 3; ++i) parts.C.at[3 * j + i][l] = (i == j ? trace : 0.0) - M[i][j];
    }
    const Vector& tau = stress.tau;
    const double inv_t = 1.0 / state.t[l];
    parts.inv_t.at[0][l] = inv_t;
    parts.in_plane.at[0][l] = tau.at[2] * inv_t;
    const double g[3][2] = {{-(batch.g[0][l] + batch.g[2][l]), -(batch.g[1][l] + batch.g[3][l])},
                            {batch.g[0][l], batch.g[1][l]},
                            {batch.g[2][l], batch.g[3][l]}};
    for (int p = 0; p < 3; ++p) {
      const double h_u = s11 * g[p][0] + s12 * g[p][1];
      const double h_v = s12 * g[p][0] + s22 * g[p][1];
      parts.g.at[2 * p][l] = g[p][0];
      parts.g.at[2 * p + 1][l] = g[p][1];
      parts.h.at[2 * p][l] = h_u;
      parts.h.at[2 * p + 1][l] = h_v;
      parts.gamma.at[p][l] = h_v * tau.at[0] - h_u * tau.at[1];
      parts.eta.at[p][l] = h_u * tau.at[0] + h_v * tau.at[1];
      for (int k = 0; k < 3; ++k) {
        const double r1 = R.column[0].at[k];
        const double r2 = R.column[1].at[k];
        parts.alpha.at[3 * p + k][l] = h_v * r1 - h_u * r2;
        parts.epsilon.at[3 * p + k][l] = (g[p][0] * r2 - g[p][1] * r1) * inv_t;
      }
    }
  }
}

/// (b + damping b_n) Q c of one vertex.
DIFFCLOTH_INLINE Vector moment(const Lanes<9>& bQ, const BendingPoint& point, int l) {
  Vector m;
  for (int k = 0; k < 3; ++k) {
    m.at[k] = bQ.at[k][l] * point.c[0][l] + bQ.at[3 + k][l] * point.c[1][l] +
              bQ.at[6 + k][l] * point.c[2][l];
  }
  return m;
}

/// A block of the Hessian column by column.
using Block = double[9][kLanes];

/// Block of corners i and j of the base triangle.
DIFFCLOTH_INLINE void base_block(
    const Parts& parts, const BendingPoint* corners, int i, int j, bool positive, Block& block) {
  const double exact = positive ? 0.0 : 1.0;
  for (int l = 0; l < kLanes; ++l) {
    const Vector m_i = moment(parts.bQ, corners[i], l);
    const Vector m_j = moment(parts.bQ, corners[j], l);
    const double inv_t = parts.inv_t.at[0][l];
    const double gi[2] = {parts.g.at[2 * i][l], parts.g.at[2 * i + 1][l]};
    const double gj[2] = {parts.g.at[2 * j][l], parts.g.at[2 * j + 1][l]};
    const double hi[2] = {parts.h.at[2 * i][l], parts.h.at[2 * i + 1][l]};
    const double hj[2] = {parts.h.at[2 * j][l], parts.h.at[2 * j + 1][l]};
    const double wi[2] = {-gi[1] * inv_t, gi[0] * inv_t};  // the last row of d omega / d x_i
    const double wj[2] = {-gj[1] * inv_t, gj[0] * inv_t};
    double M[3][3];
    // [m_i]x A_j - A_i^T [m_j]x
    const double corner_i = -(m_i.at[0] * hj[0] + m_i.at[1] * hj[1]);
    const double corner_j = -(m_j.at[0] * hi[0] + m_j.at[1] * hi[1]);
    M[0][0] = m_i.at[1] * wj[0] + m_j.at[1] * wi[0];
    M[0][1] = m_i.at[1] * wj[1] - m_j.at[0] * wi[0];
    M[1][0] = m_j.at[1] * wi[1] - m_i.at[0] * wj[0];
    M[1][1] = -(m_i.at[0] * wj[1] + m_j.at[0] * wi[1]);
    M[0][2] = m_i.at[2] * hj[0];
    M[1][2] = m_i.at[2] * hj[1];
    M[2][0] = m_j.at[2] * hi[0];
    M[2][1] = m_j.at[2] * hi[1];
    M[2][2] = corner_i + corner_j;
    // A_i^T C A_j: only the rows and columns of C where A is not zero.
    const Matrix C = matrix_at(parts.C.at, l);
    double CA[3][3];
    for (int k = 0; k < 3; ++k) {
      CA[k][0] = C.column[2].at[k] * wj[0];
      CA[k][1] = C.column[2].at[k] * wj[1];
      CA[k][2] = C.column[0].at[k] * hj[1] - C.column[1].at[k] * hj[0];
    }
    for (int k = 0; k < 3; ++k) {
      M[0][k] += wi[0] * CA[2][k];
      M[1][k] += wi[1] * CA[2][k];
      M[2][k] += hi[1] * CA[0][k] - hi[0] * CA[1][k];
    }
    // The second derivative of the rotation.
    const double in_plane = exact * parts.in_plane.at[0][l];
    const double gamma_i = exact * parts.gamma.at[i][l];
    const double gamma_j = exact * parts.gamma.at[j][l];
    const double eta_i = exact * parts.eta.at[i][l];
    const double across = in_plane * inv_t * (gi[0] * gj[1] + gi[1] * gj[0]);
    const double along = in_plane * inv_t * (gi[0] * gj[0] - gi[1] * gj[1]);
    M[0][0] -= across;
    M[0][1] += along;
    M[1][0] += along;
    M[1][1] += across;
    M[0][2] += hj[0] * gamma_i;
    M[1][2] += hj[1] * gamma_i;
    M[2][0] += gamma_j * hi[0] + eta_i * wj[0];
    M[2][1] += gamma_j * hi[1] + eta_i * wj[1];
    M[2][2] -= in_plane * (hj[1] * gi[0] - hj[0] * gi[1]);
    // R M R^T
    const Matrix R = matrix_at(parts.R.at, l);
    double RM[3][3];
    for (int a = 0; a < 3; ++a) {
      for (int k = 0; k < 3; ++k) {
        RM[a][k] =
            R.column[0].at[a] * M[0][k] + R.column[1].at[a] * M[1][k] + R.column[2].at[a] * M[2][k];
      }
    }
    for (int b = 0; b < 3; ++b) {
      for (int a = 0; a < 3; ++a) {
        block[3 * b + a][l] = RM[a][0] * R.column[0].at[b] + RM[a][1] * R.column[1].at[b] +
                              RM[a][2] * R.column[2].at[b];
      }
    }
  }
}

/// Hessian blocks [m]x A_j, in world axes, between an outer vertex and corner j of the base triangle.
/// Their sum is zero.
DIFFCLOTH_INLINE void outer_blocks(const Parts& parts,
                                   const BendingPoint& point,
                                   Block (&blocks)[3]) {
  for (int l = 0; l < kLanes; ++l) {
    const Vector n = vector_at(parts.R.at, 2, l);
    const Vector m = moment(parts.bQ_world, point, l);
    const Vector across = cross(m, n);
    for (int j = 1; j < 3; ++j) {
      const Vector along = cross(m, vector_at(parts.alpha.at, j, l));
      const Vector epsilon = vector_at(parts.epsilon.at, j, l);
      for (int b = 0; b < 3; ++b) {
        for (int a = 0; a < 3; ++a) {
          blocks[j][3 * b + a][l] = along.at[a] * n.at[b] + across.at[a] * epsilon.at[b];
        }
      }
    }
    for (int k = 0; k < 9; ++k) blocks[0][k][l] = -(blocks[1][k][l] + blocks[2][k][l]);
  }
}

/// Compute the blocks of the base triangle with its first corner: the blocks in each row of the Hessian
/// sum to zero.
///
/// @param rows   lower triangle of the base triangle; the blocks of corners 1 and 2 are known
/// @param outer  sum of the blocks of all vertices beyond the base triangle with each corner
DIFFCLOTH_INLINE void complete_rows(const Block (&outer)[3], Block (&rows)[6]) {
  for (int l = 0; l < kLanes; ++l) {
    for (int b = 0; b < 3; ++b) {
      for (int a = 0; a < 3; ++a) {
        const int k = 3 * b + a;
        const int across = 3 * a + b;
        rows[1][k][l] = -((rows[2][k][l] + rows[4][across][l]) + outer[1][across][l]);
        rows[3][k][l] = -((rows[4][k][l] + rows[5][k][l]) + outer[2][across][l]);
      }
    }
    for (int b = 0; b < 3; ++b) {
      for (int a = 0; a < 3; ++a) {
        const int across = 3 * a + b;
        rows[0][3 * b + a][l] = -((rows[1][across][l] + rows[3][across][l]) + outer[0][across][l]);
      }
    }
  }
}

DIFFCLOTH_INLINE void scatter(const BendingPoint& point,
                              int j,
                              int size,
                              Block& block,
                              const std::int32_t* place,
                              double* blocks) {
  transpose_blocks(point.above[j], block);
  add_blocks(block, point.slot[j], size, place, blocks);
}

void add_hessian(const BendingBatch* batches,
                 std::size_t count,
                 const BendingPoint* points,
                 const BendingState* at,
                 bool positive,
                 const std::int32_t* place,
                 double* blocks) {
  for (const BendingBatch* batch = batches; batch != batches + count; ++batch, ++at) {
    Parts parts;
    with_curved(*batch, [&]<bool kCurved> { find_parts<kCurved>(*batch, *at, positive, parts); });
    const BendingPoint* const first = points + batch->first;
    alignas(64) Block outer[3] = {};
    for (int i = 3; i < batch->points; ++i) {
      alignas(64) Block row[3];
      outer_blocks(parts, first[i], row);
      for (int j = 0; j < 3; ++j) {
        for (int k = 0; k < 9; ++k) {
          for (int l = 0; l < kLanes; ++l) outer[j][k][l] += row[j][k][l];
        }
        scatter(first[i], j, batch->size, row[j], place, blocks);
      }
    }
    alignas(64) Block base[6];  // (0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)
    base_block(parts, first, 1, 1, positive, base[2]);
    base_block(parts, first, 2, 1, positive, base[4]);
    base_block(parts, first, 2, 2, positive, base[5]);
    complete_rows(outer, base);
    for (int i = 0, k = 0; i < 3; ++i) {
      for (int j = 0; j <= i; ++j, ++k) {
        scatter(first[i], j, batch->size, base[k], place, blocks);
      }
    }
  }
}

constexpr BendingKernels kKernels{.evaluate = evaluate,
                                  .energy_change = energy_change,
                                  .add_gradient = add_gradient,
                                  .add_hessian = add_hessian};

}  // namespace
}  // namespace diffcloth::elastic

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
