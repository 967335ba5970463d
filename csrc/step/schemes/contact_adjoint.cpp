// The adjoint of a step.
//
// Let E_k be the objective of friction iteration k = 1..K, x_k its minimizer over the free vertices, and
// grad the gradient over *all* vertices: free, pinned and bodies'. The outputs are x_K, v = (x_K -
// x_n)/h and the forces f_o = -grad_o E_K at fixed x_K (bodies' rows). For cotangents x_bar, v_bar,
// f_bar (forces on pins, grad_p E_K, have rows of zhat likewise, with the opposite sign; for forces on
// the cloths' vertices, -grad of barrier and friction alone, see the last lines):
//
//   g_K   = x_bar + v_bar / h
//   z_k   = H_k^-1 (g_k - H_xo f_bar [k = K])      at the free vertices
//   zhat  = (z_k, 0 at pins, f_bar at bodies [k = K, else 0])
//
// Then every input theta of E_k, which may act through the solution or through the forces, gets the same
// expression,
//
//   theta_bar -= d/d(theta) ( zhat . grad E_k ),
//
// which each potential accumulates for its own inputs; in particular prescribed positions (pins c,
// bodies o) get  -(H zhat) at their rows, and pins also the direct g_k. Friction's displacement from
// x_start yields x_start_bar, or the cotangent of the origins if these are given. Contact forces with
// cotangent c_bar on the cloths' vertices are like another f_bar of the objective C = barrier +
// friction: g_K loses H_C c_bar, and C is pulled back at zhat + c_bar. The lag configuration of k is
// x_{k-1} (x_n for k = 1): its cotangent becomes g_{k-1}, and the sweep continues from K to 1.
//
// If vertices y(q, s) of links follow coordinates q and frames s, x stands for all of z = (cloth, q),
// with  dy = J dz;  H includes the second derivative of  y . grad_y E_k  by q, and zhat has J z_k at
// those vertices besides f_bar. Prescribed joints and frames are treated like pins: from  zhat . grad
// E_k  they get  -J_s^T (H zhat)  and, as J itself depends on them,  -d/ds (J z_k) . grad_y E_k.

#include <algorithm>
#include <utility>

#include "step/schemes/contact_stage.h"
#include "step/schemes/contact_sum.h"
#include "step/schemes/taken_solves.h"

namespace diffcloth::step {
namespace {

using Array = std::vector<double>;

/// Cotangents of the forces that are a gradient of the whole objective; its sign is reversed for bodies.
///
/// @param with_bodies  true to include the forces on bodies
/// @param out          [points, 3], zero
/// @return true if any cotangent is not zero
bool read_held_forces(const Backward& step, std::size_t l, bool with_bodies, Array& out) {
  const Cotangents& bars = step.losses[l];
  const bool bodies = with_bodies && !is_zero(bars.body_forces);
  if (bodies) {
    std::ranges::copy(bars.body_forces,
                      out.begin() + static_cast<std::ptrdiff_t>(step.problem.cloth_size));
  }
  if (is_zero(bars.pin_forces)) return bodies;
  const std::vector<Index>& pins = step.problem.scene.given.pins;
  for (std::size_t p = 0; p < pins.size(); ++p) {
    for (std::size_t k = 0; k < 3; ++k) out[3 * pins[p] + k] = -bars.pin_forces[3 * p + k];
  }
  return true;
}

}  // namespace

void pull_back_solve(const Backward& step,
                     const solver::Objective& f,
                     const Array& x,
                     solver::Certificate certificate,
                     const std::vector<Array>& g,
                     bool with_forces,
                     const std::vector<contact::TouchingPotential*>& touching,
                     const Turn::Exchange& exchange) {
  const solver::Coordinates& coordinates = *f.coordinates;
  const bool with_bodies = !touching.empty() || step.problem.scene.has_attached_bodies();
  solver::LinearSystem system(f, *step.context.workspace, *step.context.watch,
                              *step.context.counts);
  Array gradient;
  certificate = certified(system, f, x, std::move(certificate), gradient);

  std::vector<Array> b(g.size(), Array(x.size(), 0.0));
  std::vector<Array> forces = b;
  std::vector<Array> touched(g.size());
  Array product;
  for (std::size_t l = 0; l < g.size(); ++l) {
    coordinates.add_rows(g[l], b[l]);
    if (!with_forces) continue;
    if (read_held_forces(step, l, with_bodies, forces[l])) {
      f.hessian_product(x.data(), forces[l].data(), product);
      for (std::size_t a = 0; a < product.size(); ++a) b[l][a] -= product[a];
    }
    const Array& bar = step.losses[l].contact_forces;
    if (touching.empty() || is_zero(bar)) continue;
    touched[l] = bar;
    touched[l].resize(x.size(), 0.0);
    product.assign(x.size(), 0.0);
    for (const Potential* p : touching) {
      p->add_hessian_product(x.data(), touched[l].data(), product.data());
    }
    for (std::size_t a = 0; a < product.size(); ++a) b[l][a] -= product[a];
  }
  std::vector<Array> z;
  system.solve(certificate, b, z);

  for (std::size_t l = 0; l < g.size(); ++l) {
    step.context.checkpoint->check();
    Array& zhat = z[l];
    for (std::size_t a = 0; a < zhat.size(); ++a) zhat[a] = forces[l][a] - zhat[a];
    f.held_product(x.data(), zhat.data(), product);
    Array with_touched = zhat;
    if (!touched[l].empty()) {
      for (const Potential* p : touching) {
        p->add_held_product(x.data(), touched[l].data(), product.data());
      }
      for (std::size_t a = 0; a < zhat.size(); ++a) with_touched[a] += touched[l][a];
    }
    for (double& value : product) value = -value;
    coordinates.gather(x, product);
    if (coordinates.is_curved()) {
      coordinates.subtract_change(x, zhat, gradient, product);
    }
    coordinates.add_rows(g[l], product);
    Array& ends = step.losses[l].ends;
    for (Index i = 0; i < coordinates.point_count(); ++i) {
      if (coordinates.prescribed()[i] == 0) continue;
      for (Index a = 3 * i; a < 3 * i + 3; ++a) ends[a] += product[a];
    }
    const Turn turn(exchange, l);
    f.for_each([&](Potential& p) {
      const bool touches = std::ranges::find(touching, &p) != touching.end();
      p.accumulate(x.data(), (touches ? with_touched : zhat).data());
    });
  }
}

namespace {

/// The cotangent of the origins of friction's displacements.
void add_start(const Array& start_bar, Cotangents& bars) {
  Array& bar = bars.origins.empty() ? bars.start : bars.origins;
  for (std::size_t a = 0; a < start_bar.size(); ++a) bar[a] += start_bar[a];
}

/// The cotangent of the lag configuration: of the start, or of the rows g of the previous solve.
void add_lag(const Problem& problem,
             const Array& x_lag,
             bool is_start,
             Array lag_bar,
             Cotangents& bars,
             Array& g) {
  if (is_start) {
    for (std::size_t a = 0; a < lag_bar.size(); ++a) bars.start[a] += lag_bar[a];
    return;
  }
  lag_bar.resize(x_lag.size(), 0.0);
  problem.coordinates.gather(x_lag, lag_bar);
  problem.coordinates.take_rows(lag_bar, g);
  // All other points are prescribed and have no rows: bodies and frames.
  problem.coordinates.clear_rows(lag_bar);
  for (std::size_t a = 0; a < lag_bar.size(); ++a) bars.ends[a] += lag_bar[a];
}

}  // namespace

void ContactStage::backward(const Backward& step, std::vector<Array> g) {
  Problem& problem = step.problem;
  // Cotangents of barrier and friction of the current loss.
  contact::ContactModel::Bar contact_bar(problem.scene.collision_mesh);
  ContactSum sum(potentials(), problem, step.detection, step.friction ? &contact_bar : nullptr,
                 step.barrier ? &contact_bar : nullptr);
  std::vector<Array> start_bars(g.size());
  std::vector<Array> lag_bars(g.size());
  const Turn::Exchange exchange_all = [&](std::size_t l) {
    exchange(l);
    std::swap(contact_bar, step.losses[l].contact);
    if (!sum.friction) return;
    std::swap(sum.friction->start_bar, start_bars[l]);
    std::swap(sum.friction->lag_bar, lag_bars[l]);
  };
  TakenSolves solves(step, sum, first_factor);
  for (std::size_t k = solves.count(); k-- > 0;) {
    step.context.checkpoint->check();
    solves.stand(k);
    pull_back_solve(step, sum.objective, solves.x(), solves.certificate(), g,
                    k + 1 == solves.count(), sum.touching(), exchange_all);

    for (std::size_t l = 0; l < g.size(); ++l) {
      std::ranges::fill(g[l], 0.0);
      if (!sum.friction) continue;
      const Array start_bar = std::exchange(start_bars[l], {});
      add_start(start_bar, step.losses[l]);
      add_lag(problem, solves.x_lag(), k == 0, std::exchange(lag_bars[l], {}), step.losses[l],
              g[l]);
    }
  }
}

}  // namespace diffcloth::step
