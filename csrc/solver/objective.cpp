#include "solver/objective.h"

#include <algorithm>

namespace diffcloth::solver {

using contact::Contact;
using contact::Curvature;

AssemblyCache::AssemblyCache(linalg::BlockPattern base, std::vector<char> fixed)
    : base_(std::move(base)), fixed_(std::move(fixed)) {
  auto plain = std::make_shared<Assembly>();
  plain->merged = linalg::merge(base_, {});
  plain->analysis = std::make_shared<linalg::CholeskyAnalysis>(plain->merged.pattern, fixed_);
  plain_ = std::move(plain);
}

std::shared_ptr<const Assembly> AssemblyCache::find(const Key& pairs) {
  if (pairs.empty()) return plain_;
  {
    const std::lock_guard lock(mutex_);
    for (auto entry = entries_.begin(); entry != entries_.end(); ++entry) {
      if (entry->first != pairs) continue;
      entries_.splice(entries_.begin(), entries_, entry);
      return entry->second;
    }
  }
  auto assembly = std::make_shared<Assembly>();
  assembly->merged = linalg::merge(base_, pairs);
  assembly->analysis = std::make_shared<linalg::CholeskyAnalysis>(assembly->merged.pattern, fixed_);
  const std::lock_guard lock(mutex_);
  entries_.emplace_front(pairs, assembly);
  if (entries_.size() > kCapacity) entries_.pop_back();
  return assembly;
}

double Objective::energy(const double* x, const std::vector<double>& contact_energies) const {
  double e = 0.0;
  for (Index i = 0; i < cloth_vertex_count; ++i) {
    e += metric[i] * (row(x, i) - row(target.data(), i)).squaredNorm();
  }
  e /= 2.0 * h * h;
  if (elastic != nullptr) e += elastic::energy(*elastic, x);
  if (anchors != nullptr) e += elastic::energy(*anchors, x);
  for (const double k : contact_energies) e += k;
  return e;
}

double Objective::energy_change(const double* x0,
                                const std::vector<double>& contact_energies0,
                                const double* x1,
                                const std::vector<double>& contact_energies1) const {
  double change = 0.0;
  for (Index i = 0; i < cloth_vertex_count; ++i) {
    if (!is_free(i)) continue;
    const Vec3 a = row(x0, i);
    const Vec3 step = row(x1, i) - a;
    change += metric[i] * step.dot(2.0 * (a - row(target.data(), i)) + step);
  }
  change /= 2.0 * h * h;
  if (elastic != nullptr) change += elastic::energy_change(*elastic, x0, x1);
  if (anchors != nullptr) change += elastic::energy_change(*anchors, x0, x1);
  for (std::size_t k = 0; k < contact_energies0.size(); ++k) {
    change += contact_energies1[k] - contact_energies0[k];
  }
  if (!friction.empty()) change += friction.energy_change(x_start, x0, x1);
  return change;
}

void Objective::gradient(const double* x,
                         const std::vector<Contact>& contacts,
                         std::vector<double>& g) const {
  g.assign(3 * static_cast<std::size_t>(vertex_count), 0.0);
  const double inv_h_sq = 1.0 / (h * h);
  for (Index i = 0; i < cloth_vertex_count; ++i) {
    Eigen::Map<Vec3>(g.data() + 3 * i) = metric[i] * inv_h_sq * (row(x, i) - row(target.data(), i));
  }
  if (elastic != nullptr) elastic::add_gradient(*elastic, x, g.data());
  if (anchors != nullptr) elastic::add_gradient(*anchors, x, g.data());
  if (contact != nullptr) contact->add_gradient(contacts, x, g.data());
  if (!friction.empty()) friction.add_gradient(x_start, x, g.data());
}

void Objective::hessian_product(const double* x,
                                const std::vector<Contact>& contacts,
                                const double* z,
                                std::vector<double>& y) const {
  y.assign(3 * static_cast<std::size_t>(vertex_count), 0.0);
  const double inv_h_sq = 1.0 / (h * h);
  for (Index i = 0; i < cloth_vertex_count; ++i) {
    Eigen::Map<Vec3>(y.data() + 3 * i) = metric[i] * inv_h_sq * row(z, i);
  }
  if (elastic != nullptr) elastic::add_hessian_product(*elastic, x, z, y.data());
  if (anchors != nullptr) elastic::add_hessian_product(*anchors, z, y.data());
  if (contact != nullptr) contact->add_hessian_product(contacts, x, z, y.data());
  if (!friction.empty()) friction.add_hessian_product(x_start, x, z, y.data());
}

namespace {

/// Couplings (row > column) among free cloth vertices that contacts and friction add.
std::vector<std::pair<Index, Index>> couplings(const Objective& f,
                                               const std::vector<Contact>& contacts,
                                               const linalg::BlockPattern& base) {
  std::vector<std::pair<Index, Index>> pairs;
  const auto add = [&](const std::array<Index, 4>& v) {
    for (int p = 0; p < 4; ++p) {
      for (int q = 0; q < 4; ++q) {
        const Index i = v[p];
        const Index j = v[q];
        if (i <= j || i >= f.cloth_vertex_count || !f.is_free(i) || !f.is_free(j)) continue;
        const Index k = base.slot(i, j);
        if (k < base.column_start()[j + 1] && base.row()[k] == i) continue;
        pairs.emplace_back(i, j);
      }
    }
  };
  for (const Contact& k : contacts) add(k.pair.vertices);
  for (const contact::FrictionSet::Entry& k : f.friction.entries()) add(k.lag.pair.vertices);
  std::ranges::sort(pairs, [](const auto& a, const auto& b) {
    return a.second != b.second ? a.second < b.second : a.first < b.first;
  });
  pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());
  return pairs;
}

/// Add the free cloth blocks of a pair's 12x12 Hessian.
void add_pair(const Objective& f,
              const linalg::BlockPattern& pattern,
              const std::array<Index, 4>& v,
              const Mat12& h,
              std::vector<double>& blocks) {
  for (int p = 0; p < 4; ++p) {
    for (int q = 0; q < 4; ++q) {
      const Index i = v[p];
      const Index j = v[q];
      if (i < j || i >= f.cloth_vertex_count || !f.is_free(i) || !f.is_free(j)) continue;
      Eigen::Map<Mat3>(blocks.data() + 9 * static_cast<std::ptrdiff_t>(pattern.slot(i, j))) +=
          h.block<3, 3>(3 * p, 3 * q);
    }
  }
}

/// out += the free rows of a pair's Hessian times d at its prescribed corners.
void add_pair_product(const Objective& f,
                      const std::array<Index, 4>& v,
                      const Mat12& h,
                      const double* d,
                      double* out) {
  Vec12 z = Vec12::Zero();
  for (int i = 0; i < 4; ++i) {
    if (!f.is_free(v[i])) z.segment<3>(3 * i) = row(d, v[i]);
  }
  const Vec12 product = h * z;
  for (int i = 0; i < 4; ++i) {
    if (f.is_free(v[i])) Eigen::Map<Vec3>(out + 3 * v[i]) += product.segment<3>(3 * i);
  }
}

}  // namespace

Hessian assemble(const Objective& f,
                 const double* x,
                 const std::vector<Contact>& contacts,
                 Curvature curvature) {
  const linalg::BlockPattern& base = f.assemblies->base();
  Hessian result;
  result.assembly = f.assemblies->find(couplings(f, contacts, base));

  std::vector<double> base_blocks(9 * static_cast<std::size_t>(base.block_count()), 0.0);
  const double inv_h_sq = 1.0 / (f.h * f.h);
  for (Index i = 0; i < f.cloth_vertex_count; ++i) {
    Eigen::Map<Mat3>(base_blocks.data() + 9 * static_cast<std::ptrdiff_t>(base.column_start()[i]))
        .diagonal()
        .array() += f.metric[i] * inv_h_sq;
  }
  if (f.elastic != nullptr) {
    elastic::add_hessian(*f.elastic, *f.slots, x,
                         curvature == Curvature::kExact ? elastic::Projection::kExact
                                                        : elastic::Projection::kPositive,
                         base_blocks.data());
  }
  if (f.anchors != nullptr) {
    elastic::add_hessian(*f.anchors, base.column_start(), base_blocks.data());
  }

  const linalg::MergedPattern& merged = result.assembly->merged;
  if (merged.pattern.block_count() == base.block_count()) {
    result.blocks = std::move(base_blocks);
  } else {
    result.blocks.assign(9 * static_cast<std::size_t>(merged.pattern.block_count()), 0.0);
    for (Index k = 0; k < base.block_count(); ++k) {
      std::copy_n(base_blocks.data() + 9 * static_cast<std::ptrdiff_t>(k), 9,
                  result.blocks.data() + 9 * static_cast<std::ptrdiff_t>(merged.slot_of_base[k]));
    }
  }
  for (const Contact& k : contacts) {
    add_pair(f, merged.pattern, k.pair.vertices, f.contact->hessian(k, x, curvature),
             result.blocks);
  }
  for (const contact::FrictionSet::Entry& k : f.friction.entries()) {
    add_pair(f, merged.pattern, k.lag.pair.vertices, f.friction.hessian(k, f.x_start, x, curvature),
             result.blocks);
  }
  return result;
}

void add_prescribed_product(const Objective& f,
                            const Hessian& hessian,
                            const double* x,
                            const std::vector<Contact>& contacts,
                            Curvature curvature,
                            const double* d,
                            double* out) {
  // The assembled matrix holds the elastic coupling of free and pinned vertices; the contacts'
  // couplings with prescribed vertices are applied one by one.
  const std::size_t size = 3 * static_cast<std::size_t>(f.cloth_vertex_count);
  std::vector<double> pins(size, 0.0);
  std::vector<double> product(size, 0.0);
  bool moves = false;
  for (Index i = 0; i < f.cloth_vertex_count; ++i) {
    if (f.is_free(i)) continue;
    for (Index a = 3 * i; a < 3 * i + 3; ++a) {
      pins[a] = d[a];
      moves = moves || d[a] != 0.0;
    }
  }
  if (moves) {
    linalg::add_product(hessian.assembly->merged.pattern, hessian.blocks.data(), pins.data(),
                        product.data());
    for (Index i = 0; i < f.cloth_vertex_count; ++i) {
      if (!f.is_free(i)) continue;
      for (Index a = 3 * i; a < 3 * i + 3; ++a) out[a] += product[a];
    }
  }
  for (const Contact& k : contacts) {
    if (std::ranges::all_of(k.pair.vertices, [&](Index v) { return f.is_free(v); })) continue;
    add_pair_product(f, k.pair.vertices, f.contact->hessian(k, x, curvature), d, out);
  }
  for (const contact::FrictionSet::Entry& k : f.friction.entries()) {
    if (std::ranges::all_of(k.lag.pair.vertices, [&](Index v) { return f.is_free(v); })) continue;
    add_pair_product(f, k.lag.pair.vertices, f.friction.hessian(k, f.x_start, x, curvature), d,
                     out);
  }
}

}  // namespace diffcloth::solver
