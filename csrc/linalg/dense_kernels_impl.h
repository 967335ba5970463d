// The dense kernels, written once over packs of numbers that fill a cache line: eight doubles or sixteen
// floats. A file that compiles them for some instructions defines, in its anonymous namespace and
// before it includes this one, the types Doubles and Floats of such packs, with the operations on them,
// and
//
//   kPacks  packs of rows in a block of registers,   kWidth  columns of it, a divisor of eight
//
// Such a file must hold nothing that another file could define, too: the linker would keep one copy,
// perhaps of instructions that the machine lacks. So this one includes no Eigen and no standard
// templates, and everything in it is in an anonymous namespace.

#pragma once

#include <cstddef>

#include "linalg/dense_kernels.h"

// Plain arrays: those of the standard library are templates that the whole program would share.
// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::linalg {
namespace {

inline double square_root(double a) { return __builtin_sqrt(a); }
inline float square_root(float a) { return __builtin_sqrtf(a); }

/// The factorization of fronts, over packs of either precision.
template <class Pack>
struct Fronts {
  using Real = typename Pack::Real;  // NOLINT(readability-redundant-typename): for older compilers
  static constexpr int kLanes = 64 / sizeof(Real);

  static constexpr int up_to_pack(int n) { return (n + kLanes - 1) / kLanes * kLanes; }
  static constexpr int down_to_pack(int n) { return n / kLanes * kLanes; }

  /// A block of P packs of rows and W columns in registers.
  ///
  /// Its operands are in slabs: a pack of rows each, column after column, so that whatever a product reads
  /// is contiguous. Slabs are `stride` apart.
  template <int P, int W>
  struct Tile {
    Pack c[W][P];

    DIFFCLOTH_INLINE void clear() {
#pragma GCC unroll 8
      for (int j = 0; j < W; ++j) {
#pragma GCC unroll 8
        for (int p = 0; p < P; ++p) c[j][p] = Pack{};
      }
    }

    /// The first `columns` of them from a column-major matrix.
    DIFFCLOTH_INLINE void load_from(const Real* from, std::ptrdiff_t ld, int columns = W) {
#pragma GCC unroll 8
      for (int j = 0; j < W; ++j) {
#pragma GCC unroll 8
        for (int p = 0; p < P; ++p) {
          c[j][p] = j < columns ? load(from + j * ld + kLanes * p) : Pack{};
        }
      }
    }

    DIFFCLOTH_INLINE void store_to(Real* to, std::ptrdiff_t ld, int columns = W) const {
#pragma GCC unroll 8
      for (int j = 0; j < W; ++j) {
        if (j >= columns) break;
#pragma GCC unroll 8
        for (int p = 0; p < P; ++p) store(to + j * ld + kLanes * p, c[j][p]);
      }
    }

    DIFFCLOTH_INLINE void store_to_slabs(Real* to, std::ptrdiff_t stride) const {
#pragma GCC unroll 8
      for (int j = 0; j < W; ++j) {
#pragma GCC unroll 8
        for (int p = 0; p < P; ++p) store(to + p * stride + kLanes * j, c[j][p]);
      }
    }

    /// C -= A B^T over `depth` columns of the slabs a [P] and of W rows b of a slab.
    DIFFCLOTH_INLINE void subtract_product(const Real* a,
                                           std::ptrdiff_t stride,
                                           const Real* b,
                                           int depth) {
      for (int k = 0; k < depth; ++k) {
        Pack a_k[P];
#pragma GCC unroll 8
        for (int p = 0; p < P; ++p) a_k[p] = load(a + p * stride);
#pragma GCC unroll 8
        for (int j = 0; j < W; ++j) {
          const Pack b_k = broadcast(b[j]);
#pragma GCC unroll 8
          for (int p = 0; p < P; ++p) c[j][p] = subtract_product_of(c[j][p], a_k[p], b_k);
        }
        a += kLanes;
        b += kLanes;
      }
    }

    /// C := C L^-T for a lower triangle [W, W] in a slab, with its diagonal inverted.
    DIFFCLOTH_INLINE void solve(const Real* l) {
#pragma GCC unroll 8
      for (int j = 0; j < W; ++j) {
        const Pack inverse = broadcast(l[j + kLanes * j]);
#pragma GCC unroll 8
        for (int p = 0; p < P; ++p) c[j][p] = c[j][p] * inverse;
#pragma GCC unroll 8
        for (int i = j + 1; i < W; ++i) {
          const Pack l_ij = broadcast(l[i + kLanes * j]);
#pragma GCC unroll 8
          for (int p = 0; p < P; ++p) c[i][p] = subtract_product_of(c[i][p], c[j][p], l_ij);
        }
      }
    }
  };

  /// Call f<W>() for a width of 1 .. kWidth that is known only now.
  template <int W = kWidth, class Call>
  static DIFFCLOTH_INLINE void with_width(int width, Call call) {
    if constexpr (W == 1) {
      call.template operator()<1>();
    } else if (width == W) {
      call.template operator()<W>();
    } else {
      with_width<W - 1>(width, call);
    }
  }

  /// The same for a number of packs, 1 .. kPacks.
  template <int P = kPacks, class Call>
  static DIFFCLOTH_INLINE void with_packs(int packs, Call call) {
    if constexpr (P == 1) {
      call.template operator()<1>();
    } else if (packs == P) {
      call.template operator()<P>();
    } else {
      with_packs<P - 1>(packs, call);
    }
  }

  /// Some columns of a panel, at most kColumnBlock: the triangle on the diagonal and all rows below.
  /// `slabs` takes what is finished.
  struct Block {
    Real* panel;  ///< where the triangle begins, with leading dimension ld
    std::ptrdiff_t ld;
    Real* slabs;
    std::ptrdiff_t stride;
    int columns;
  };

  /// Finish columns begin .. end - 1 in P packs of rows below the triangle.
  template <int P>
  static void solve_rows(const Block& block, int row, int begin, int end) {
    Real* const a = block.slabs + row / kLanes * block.stride;
    for (int c = begin; c < end; c += kWidth) {
      const Real* const strip = block.slabs + c / kLanes * block.stride + c % kLanes;
      with_width(end - c < kWidth ? end - c : kWidth, [&]<int W> {
        Tile<P, W> tile;
        Real* const l = block.panel + row + c * block.ld;
        tile.load_from(l, block.ld);
        tile.subtract_product(a, block.stride, strip, c);
        tile.solve(strip + kLanes * c);
        tile.store_to_slabs(a + kLanes * c, block.stride);
        tile.store_to(l, block.ld);
      });
    }
  }

  static void solve_rows(const Block& block, int row, int packs, int begin, int end) {
    with_packs(packs, [&]<int P> { solve_rows<P>(block, row, begin, end); });
  }

  /// Cholesky factor of the first rows and columns of a slab's block, 1 / l_jj on the diagonal. What
  /// it leaves above the diagonal means nothing.
  static Verdict factor_corner(Real* l, int columns) {
    for (int j = 0; j < columns; ++j) {
      Real* const l_j = l + kLanes * j;
      const Real pivot = l_j[j];
      if (!(pivot > Pack::kLeastPivot && pivot <= Pack::kLargest)) {
        return pivot < -Pack::kLeastPivot || Pack::kLeastPivot == 0 ? Verdict::kIndefinite
                                                                    : Verdict::kUnclear;
      }
      const Real inverse = 1 / square_root(pivot);
      const Pack column = load(l_j) * broadcast(inverse);
      store(l_j, column);
      for (int k = j + 1; k < columns; ++k) {
        Real* const l_k = l + kLanes * k;
        store(l_k, subtract_product_of(load(l_k), column, broadcast(l_j[k])));
      }
      l_j[j] = inverse;
    }
    return Verdict::kPositive;
  }

  /// The triangle of a block, a pack of columns at a time.
  static Verdict factor_triangle(const Block& block) {
    const int columns = block.columns;
    const int end = up_to_pack(columns);
    for (int c = 0; c < columns; c += kLanes) {
      const int width = columns - c < kLanes ? columns - c : kLanes;
      Real* const slab = block.slabs + c / kLanes * block.stride;
      Real* const l = block.panel + c + c * block.ld;
      for (int j = 0; j < width; j += kWidth) {
        with_width(width - j < kWidth ? width - j : kWidth, [&]<int W> {
          Tile<1, W> tile;
          tile.load_from(l + j * block.ld, block.ld);
          tile.subtract_product(slab, block.stride, slab + j, c);
          tile.store_to_slabs(slab + kLanes * (c + j), block.stride);
        });
      }
      Real* const corner = slab + kLanes * c;
      const Verdict verdict = factor_corner(corner, width);
      if (verdict != Verdict::kPositive) return verdict;
      for (int j = 0; j < width; ++j) store(l + j * block.ld, load(corner + kLanes * j));
      for (int row = c + kLanes; row < end; row += kLanes * kPacks) {
        const int packs = (end - row) / kLanes;
        solve_rows(block, row, packs < kPacks ? packs : kPacks, c, c + width);
      }
    }
    return Verdict::kPositive;
  }

  /// C -= A B^T for P packs of rows and the columns that belong to one slab b, as far as they exist; C itself
  /// counts as zero where nothing has been added to it.
  template <int P>
  static void subtract_from(Real* to,
                            std::ptrdiff_t ld,
                            int columns,
                            bool is_zero,
                            const Real* a,
                            const Real* b,
                            const Block& block) {
    for (int j = 0; j < columns; j += kWidth) {
      Tile<P, kWidth> tile;
      Real* const c = to + j * ld;
      if (is_zero) {
        tile.clear();
      } else {
        tile.load_from(c, ld, columns - j);
      }
      tile.subtract_product(a, block.stride, b + j, block.columns);
      tile.store_to(c, ld, columns - j);
    }
  }

  /// What a finished block subtracts from `packs` packs of rows from `row` on of later columns, those of
  /// the panel and those of the update matrix.
  static void update_rows(
      const Block& block, const Front& front, int first, int row, int packs, Real* panel, Real* u) {
    const int end = row + kLanes * packs;
    for (int strip = up_to_pack(block.columns); strip < end; strip += kLanes) {
      const int from = strip < row ? row : strip;  // above are only entries of no meaning
      const Real* const a = block.slabs + from / kLanes * block.stride;
      const Real* const b = block.slabs + strip / kLanes * block.stride;
      const int column = first + strip;
      with_packs((end - from) / kLanes, [&]<int P> {
        if (column < front.top) {
          const int left = front.columns - column;
          subtract_from<P>(panel + front.panel().place(first + from, column),
                           front.panel().stride(column), left < kLanes ? left : kLanes, false, a, b,
                           block);
        } else {
          const int u_column = column - front.top;
          subtract_from<P>(u + front.update().place(first + from - front.top, u_column),
                           front.update().stride(u_column), kLanes, first == 0, a, b, block);
        }
      });
    }
  }

  static Verdict factor(const Front& front, Real* panel, Real* u, Real* scratch) {
    const int end = front.top + up_to_pack(front.rows);
    for (int first = 0; first < front.columns; first += kColumnBlock) {
      const int left = front.columns - first;
      const int columns = left < kColumnBlock ? left : kColumnBlock;
      const Block block{.panel = panel + front.panel().place(first, first),
                        .ld = front.panel().stride(first),
                        .slabs = scratch,
                        .stride = static_cast<std::ptrdiff_t>(kLanes) * columns,
                        .columns = columns};
      const Verdict verdict = factor_triangle(block);
      if (verdict != Verdict::kPositive) return verdict;
      // A few rows at a time, which stay in the cache: first those of later columns, then the others.
      for (int row = up_to_pack(columns); first + row < end;) {
        const int bound = first + row < front.top ? front.top : end;
        const int rest = (bound - first - row) / kLanes;
        const int packs = rest < kPacks ? rest : kPacks;
        solve_rows(block, row, packs, 0, columns);
        update_rows(block, front, first, row, packs, panel, u);
        row += kLanes * packs;
      }
    }
    return Verdict::kPositive;
  }

  static DIFFCLOTH_INLINE void add(const Real* from, int count, Real* to) {
    int i = 0;
    for (; i + kLanes <= count; i += kLanes) store(to + i, load(to + i) + load(from + i));
    if (i < count) add_some(from + i, count - i, to + i);
  }

  static void add_to_panel(
      const Front& child, const Real* u, const ChildMap& map, const Front& front, Real* panel) {
    for (int r = 0; r < map.column_runs; ++r) {
      for (int k = 0; k < map.runs[r].count; ++k) {
        const Real* const from = u + child.update().place(0, map.runs[r].from + k);
        Real* const to = panel + front.panel().place(0, map.runs[r].to + k);
        add(from + map.runs[r].from + k, map.runs[r].count - k, to + map.runs[r].to + k);
        for (int q = r + 1; q < map.column_runs; ++q) {
          add(from + map.runs[q].from, map.runs[q].count, to + map.runs[q].to);
        }
        for (int q = map.column_runs; q < map.run_count; ++q) {
          add(from + map.runs[q].from, map.runs[q].count, to + front.top + map.runs[q].to);
        }
      }
    }
  }

  static void add_to_update(
      const Front& child, const Real* u, const ChildMap& map, const Front& front, Real* parent_u) {
    for (int r = map.column_runs; r < map.run_count; ++r) {
      for (int k = 0; k < map.runs[r].count; ++k) {
        const Real* const from = u + child.update().place(0, map.runs[r].from + k);
        Real* const to = parent_u + front.update().place(0, map.runs[r].to + k);
        add(from + map.runs[r].from + k, map.runs[r].count - k, to + map.runs[r].to + k);
        for (int q = r + 1; q < map.run_count; ++q) {
          add(from + map.runs[q].from, map.runs[q].count, to + map.runs[q].to);
        }
      }
    }
  }

  /// y := L^-1 y for `width` columns l of a panel from their diagonal on, in registers.
  template <int Width>
  static DIFFCLOTH_INLINE void solve_triangle(const Real* l, std::ptrdiff_t ld, Real* y) {
    Real t[Width];
#pragma GCC unroll 16
    for (int i = 0; i < Width; ++i) t[i] = y[i];
#pragma GCC unroll 16
    for (int j = 0; j < Width; ++j) {
      t[j] *= l[j * ld + j];
#pragma GCC unroll 16
      for (int i = j + 1; i < Width; ++i) t[i] = subtract_product_of(t[i], l[j * ld + i], t[j]);
    }
#pragma GCC unroll 16
    for (int i = 0; i < Width; ++i) y[i] = t[i];
  }

  /// y := L^-T y, likewise.
  template <int Width>
  static DIFFCLOTH_INLINE void solve_transposed_triangle(const Real* l,
                                                         std::ptrdiff_t ld,
                                                         Real* y) {
    Real t[Width];
#pragma GCC unroll 16
    for (int i = 0; i < Width; ++i) t[i] = y[i];
#pragma GCC unroll 16
    for (int j = Width - 1; j >= 0; --j) {
      t[j] *= l[j * ld + j];
#pragma GCC unroll 16
      for (int i = 0; i < j; ++i) t[i] = subtract_product_of(t[i], l[i * ld + j], t[j]);
    }
#pragma GCC unroll 16
    for (int i = 0; i < Width; ++i) y[i] = t[i];
  }

  /// Call f<Width>() for the width of a triangle; supernodes are made of vertices of three columns each,
  /// and widths below kLanes are what is left of those.
  template <int Width = 1, class Call>
  static DIFFCLOTH_INLINE void with_triangle(int width, Call call) {
    if constexpr (Width < kLanes) {
      if (width > Width) {
        with_triangle<Width + 1>(width, call);
        return;
      }
    }
    call.template operator()<Width>();
  }

  template <int R>
  static void forward(const Front& front, const Real* panel, Real* c, std::ptrdiff_t stride) {
    for (int column = 0; column < front.columns; column += kLanes) {
      const int width = front.columns - column < kLanes ? front.columns - column : kLanes;
      const Real* const l = panel + front.panel().place(0, column);
      const std::ptrdiff_t ld = front.panel().stride(column);
      for (int r = 0; r < R; ++r) {
        with_triangle(width, [&]<int Width> {
          solve_triangle<Width>(l + column, ld, c + r * stride + column);
        });
      }
      for (int row = column + kLanes; row < front.ld; row += kLanes) {
        Pack sum[R];
        for (int r = 0; r < R; ++r) sum[r] = load(c + r * stride + row);
        for (int j = 0; j < width; ++j) {
          const Pack l_j = load(l + j * ld + row);
          for (int r = 0; r < R; ++r) {
            sum[r] = subtract_product_of(sum[r], l_j, broadcast(c[r * stride + column + j]));
          }
        }
        for (int r = 0; r < R; ++r) store(c + r * stride + row, sum[r]);
      }
    }
  }

  /// Subtract from y[0 .. W - 1] the products of W columns, `ld` apart, with the vectors c.
  template <int R, int W>
  static void subtract_dots(
      const Real* l, std::ptrdiff_t ld, int length, const Real* c, Real* y, std::ptrdiff_t stride) {
    Pack sum[R][W];
    for (int r = 0; r < R; ++r) {
      for (int j = 0; j < W; ++j) sum[r][j] = Pack{};
    }
    for (int row = 0; row < length; row += kLanes) {
      Pack l_j[W];
      for (int j = 0; j < W; ++j) l_j[j] = load(l + j * ld + row);
      for (int r = 0; r < R; ++r) {
        const Pack c_r = load(c + r * stride + row);
        for (int j = 0; j < W; ++j) sum[r][j] = subtract_product_of(sum[r][j], l_j[j], c_r);
      }
    }
    for (int r = 0; r < R; ++r) {
      for (int j = 0; j < W; ++j) y[r * stride + j] += total(sum[r][j]);
    }
  }

  template <int R>
  static void backward(const Front& front, const Real* panel, Real* c, std::ptrdiff_t stride) {
    for (int column = down_to_pack(front.columns - 1); column >= 0; column -= kLanes) {
      const int width = front.columns - column < kLanes ? front.columns - column : kLanes;
      const int below = column + kLanes;
      const Real* const l = panel + front.panel().place(0, column);
      const std::ptrdiff_t ld = front.panel().stride(column);
      constexpr int kAtOnce = R > 4 ? 2 : 4;  // sums stay in registers
      int j = 0;
      for (; j + kAtOnce <= width; j += kAtOnce) {
        subtract_dots<R, kAtOnce>(l + j * ld + below, ld, front.ld - below, c + below,
                                  c + column + j, stride);
      }
      for (; j < width; ++j) {
        subtract_dots<R, 1>(l + j * ld + below, ld, front.ld - below, c + below, c + column + j,
                            stride);
      }
      for (int r = 0; r < R; ++r) {
        with_triangle(width, [&]<int Width> {
          solve_transposed_triangle<Width>(l + column, ld, c + r * stride + column);
        });
      }
    }
  }

  /// Call f<R>() for the number of vectors.
  template <int R = 1, class Call>
  static DIFFCLOTH_INLINE void with_count(int count, Call call) {
    if constexpr (R < kMaxVectors) {
      if (count > R) {
        with_count<R + 1>(count, call);
        return;
      }
    }
    call.template operator()<R>();
  }

  static void forward(
      const Front& front, const Real* panel, Real* c, std::ptrdiff_t stride, int count) {
    with_count(count, [&]<int R> { forward<R>(front, panel, c, stride); });
  }

  static void backward(
      const Front& front, const Real* panel, Real* c, std::ptrdiff_t stride, int count) {
    with_count(count, [&]<int R> { backward<R>(front, panel, c, stride); });
  }

  static constexpr FrontKernels<Real> kKernels{.factor = factor,
                                               .add_to_panel = add_to_panel,
                                               .add_to_update = add_to_update,
                                               .forward = forward,
                                               .backward = backward};
};

using Four = double __attribute__((vector_size(32)));
using UnalignedFour = double __attribute__((vector_size(32), aligned(8), may_alias));

DIFFCLOTH_INLINE const UnalignedFour& four(const double* from) {
  return *reinterpret_cast<const UnalignedFour*>(from);
}

/// Columns of a block, each in the first three lanes; nothing behind the block is read.
struct Columns {
  Four c[3];

  DIFFCLOTH_INLINE void read(const double* block) {
    c[0] = four(block);
    c[1] = four(block + 3);
    c[2] = Four{block[6], block[7], block[8], 0.0};
  }

  DIFFCLOTH_INLINE void add_product(const Four& x, Four& y) const {
    y += c[0] * x[0] + c[1] * x[1] + c[2] * x[2];
  }
};

template <int R>
void multiply_some(const std::int32_t* column_start,
                   const std::int32_t* row,
                   std::int32_t size,
                   const double* blocks,
                   const double* x,
                   double* y) {
  const std::ptrdiff_t stride = 4 * static_cast<std::ptrdiff_t>(size);
  for (std::int32_t j = 0; j < size; ++j) {
    const std::ptrdiff_t place = 4 * static_cast<std::ptrdiff_t>(j);
    Four dots[R][3] = {};
    Four x_j[R];
    Four y_j[R] = {};
    std::int32_t k = column_start[j];
    Columns block;
    block.read(blocks + 9 * static_cast<std::ptrdiff_t>(k));
    for (int r = 0; r < R; ++r) {
      x_j[r] = four(x + r * stride + place);
      block.add_product(x_j[r], y_j[r]);
    }
    for (++k; k < column_start[j + 1]; ++k) {
      block.read(blocks + 9 * static_cast<std::ptrdiff_t>(k));
      const std::ptrdiff_t i = 4 * static_cast<std::ptrdiff_t>(row[k]);
      for (int r = 0; r < R; ++r) {
        const Four x_i = four(x + r * stride + i);
        Four y_i = four(y + r * stride + i);
        block.add_product(x_j[r], y_i);
        *reinterpret_cast<UnalignedFour*>(y + r * stride + i) = y_i;
        for (int a = 0; a < 3; ++a) dots[r][a] += block.c[a] * x_i;
      }
    }
    for (int r = 0; r < R; ++r) {
      for (int a = 0; a < 3; ++a) y_j[r][a] += dots[r][a][0] + dots[r][a][1] + dots[r][a][2];
      *reinterpret_cast<UnalignedFour*>(y + r * stride + place) += y_j[r];
    }
  }
}

void multiply_blocks(const std::int32_t* column_start,
                     const std::int32_t* row,
                     std::int32_t size,
                     const double* blocks,
                     const double* x,
                     double* y,
                     int count) {
  constexpr int kAtOnce = 4;  // sums stay in registers
  const std::ptrdiff_t stride = 4 * static_cast<std::ptrdiff_t>(size);
  for (; count >= kAtOnce; count -= kAtOnce, x += kAtOnce * stride, y += kAtOnce * stride) {
    multiply_some<kAtOnce>(column_start, row, size, blocks, x, y);
  }
  for (; count > 0; --count, x += stride, y += stride) {
    multiply_some<1>(column_start, row, size, blocks, x, y);
  }
}

constexpr DenseKernels kKernels{.multiply_blocks = multiply_blocks,
                                .doubles = Fronts<Doubles>::kKernels,
                                .floats = Fronts<Floats>::kKernels};

}  // namespace
}  // namespace diffcloth::linalg

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
