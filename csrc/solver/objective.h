#pragma once

#include <list>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

#include "common/types.h"
#include "contact/contact_set.h"
#include "contact/friction_set.h"
#include "elastic/anchors.h"
#include "elastic/elastic.h"
#include "linalg/block_matrix.h"
#include "linalg/cholesky.h"

namespace diffcloth::solver {

/// A matrix pattern with contacts in it, and its symbolic factorization.
struct Assembly {
  linalg::MergedPattern merged;
  std::shared_ptr<const linalg::CholeskyAnalysis> analysis;
};

/// Symbolic factorizations seen before, by the couplings that contact adds to the base pattern.
///
/// Only a memory: an entry is a function of its key, so results do not depend on what is in it.
class AssemblyCache {
 public:
  AssemblyCache(linalg::BlockPattern base, std::vector<char> fixed);

  /// @param pairs  lower-triangle couplings (row > column), sorted by (column, row), unique
  std::shared_ptr<const Assembly> find(const std::vector<std::pair<Index, Index>>& pairs);

  const linalg::BlockPattern& base() const { return base_; }

 private:
  using Key = std::vector<std::pair<Index, Index>>;
  static constexpr std::size_t kCapacity = 64;

  linalg::BlockPattern base_;
  std::vector<char> fixed_;
  std::shared_ptr<const Assembly> plain_;
  std::mutex mutex_;
  std::list<std::pair<Key, std::shared_ptr<const Assembly>>> entries_;  // most recent first
};

/// A sum of potentials over the positions of all vertices, cloth first, then bodies:
///
///   P(x) = 1/(2 h^2) (x - y)^T G (x - y) + W(x) + anchors + kappa B(x) + D(x - x_start)   [J]
///
/// Parts that are absent are null. Prescribed vertices (pins, bodies) are given; the others are the
/// unknowns. Positions and gradients are arrays of 3 doubles a vertex.
struct Objective {
  Index cloth_vertex_count;
  Index vertex_count;
  double h;
  const std::vector<char>* prescribed;  ///< [vertex_count]

  std::vector<double> metric;  ///< G_i [kg], [cloth_vertex_count]
  std::vector<double> target;  ///< y [3 cloth_vertex_count]

  const elastic::Model* elastic = nullptr;
  const elastic::Slots* slots = nullptr;
  const elastic::Anchors* anchors = nullptr;
  const contact::ContactModel* contact = nullptr;
  contact::FrictionSet friction;
  const double* x_start = nullptr;  ///< start-of-step positions, for friction

  AssemblyCache* assemblies;

  bool is_free(Index vertex) const { return (*prescribed)[vertex] == 0; }

  /// P(x), without friction, which only differences of are used.
  double energy(const double* x, const std::vector<double>& contact_energies) const;

  /// P(x1) - P(x0), element by element so that little cancels. The contact energies are those of
  /// one candidate list at x0 and at x1.
  double energy_change(const double* x0,
                       const std::vector<double>& contact_energies0,
                       const double* x1,
                       const std::vector<double>& contact_energies1) const;

  /// grad P at all vertices, prescribed ones included.
  void gradient(const double* x,
                const std::vector<contact::Contact>& contacts,
                std::vector<double>& g) const;

  /// y = (d^2 P) z over all vertices, exact.
  void hessian_product(const double* x,
                       const std::vector<contact::Contact>& contacts,
                       const double* z,
                       std::vector<double>& y) const;
};

/// Hessian of an objective at one point, on the blocks of the cloth's vertices.
struct Hessian {
  std::shared_ptr<const Assembly> assembly;
  std::vector<double> blocks;
};

/// Assemble the Hessian at x; kPositive replaces each element's by a positive semi-definite one.
Hessian assemble(const Objective& objective,
                 const double* x,
                 const std::vector<contact::Contact>& contacts,
                 contact::Curvature curvature);

/// out += H_xo d at the free vertices, for a motion d of the prescribed ones (zero elsewhere), with
/// the same curvature as the assembled Hessian.
void add_prescribed_product(const Objective& objective,
                            const Hessian& hessian,
                            const double* x,
                            const std::vector<contact::Contact>& contacts,
                            contact::Curvature curvature,
                            const double* d,
                            double* out);

}  // namespace diffcloth::solver
