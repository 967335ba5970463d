// The dense kernels, written once over packs of numbers that fill a cache line: eight doubles or sixteen
// floats. dense_kernels_LEVEL.h, included before this file, defines the types Doubles and Floats of such packs,
// ManyFloats of kMaxVectors floats, the operations on them, and
//
//   kPacks   packs of rows in a block of registers,   kWidth  columns of it, a divisor of eight
//   kAcross  vectors in registers in a product with a block, a divisor of kMaxVectors
//
// A file that is compiled for a level of instructions must not define a symbol that another file may
// define too: the linker would keep one copy, perhaps with instructions that the machine lacks. Headers
// for such files include neither Eigen nor standard templates, and all their definitions are in
// anonymous namespaces.

#pragma once

#include <cstddef>

#include "linalg/dense_kernels.h"

// Plain arrays: std::array is a template that the whole program would share.
// NOLINTBEGIN(modernize-avoid-c-arrays)

#define DIFFCLOTH_INLINE inline __attribute__((always_inline))

namespace diffcloth::linalg {
namespace {

inline double square_root(double a) { return __builtin_sqrt(a); }
inline float square_root(float a) { return __builtin_sqrtf(a); }

/// The factorization of fronts, over packs of either precision, and of numbers of kMaxVectors vectors.
template <class Pack, class Many>
struct Fronts {
  using Real = typename Pack::Real;  // NOLINT(readability-redundant-typename): for older compilers
  static constexpr int kLanes = 64 / sizeof(Real);

  static constexpr int up_to_pack(int n) { return (n + kLanes - 1) / kLanes * kLanes; }
  static constexpr int down_to_pack(int n) { return n / kLanes * kLanes; }

  /// A block of P packs of rows and W columns in registers.
  ///
  /// Its operands are in slabs: each is a pack of rows, column after column, so that a product reads
  /// contiguous memory. Slabs are `stride` apart.
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

    /// Load the first `columns` of W columns from a column-major matrix.
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

  /// Call f<W>() for a run-time width of 1 .. kWidth.
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

  /// Same for a number of packs, 1 .. kPacks.
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

  /// At most kColumnBlock columns of a panel: the triangle on the diagonal and all rows below. `slabs`
  /// receives the finished entries.
  struct Block {
    Real* panel;  ///< start of the triangle, with leading dimension ld
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

  /// Cholesky factor of the first rows and columns of a slab's block, 1 / l_jj on the diagonal. Entries
  /// above the diagonal are undefined.
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

  /// Factor the triangle of a block, a pack of columns at a time.
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

  /// C -= A B^T for P packs of rows and the existing columns of one slab b; if is_zero, C is overwritten
  /// without being read.
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

  /// Subtract the contribution of a finished block from `packs` packs of rows, from `row` on, in later
  /// columns of the panel and in the update matrix.
  static void update_rows(
      const Block& block, const Front& front, int first, int row, int packs, Real* panel, Real* u) {
    const int end = row + kLanes * packs;
    for (int strip = up_to_pack(block.columns); strip < end; strip += kLanes) {
      const int from = strip < row ? row : strip;  // entries above are not meaningful
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
      // Few rows at a time, which stay in the cache: first the rows of later columns, then the others.
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

  /// y := L^-1 y for `Width` columns l of a panel from their diagonal on, in registers; Number is Real
  /// for one vector, Many for several.
  template <int Width, class Number>
  static DIFFCLOTH_INLINE void solve_triangle(const Real* l, std::ptrdiff_t ld, Number* y) {
    Number t[Width];
#pragma GCC unroll 16
    for (int i = 0; i < Width; ++i) t[i] = y[i];
#pragma GCC unroll 16
    for (int j = 0; j < Width; ++j) {
      t[j] = t[j] * same<Number>(l[j * ld + j]);
#pragma GCC unroll 16
      for (int i = j + 1; i < Width; ++i) {
        t[i] = subtract_product_of(t[i], same<Number>(l[j * ld + i]), t[j]);
      }
    }
#pragma GCC unroll 16
    for (int i = 0; i < Width; ++i) y[i] = t[i];
  }

  /// y := L^-T y, likewise.
  template <int Width, class Number>
  static DIFFCLOTH_INLINE void solve_transposed_triangle(const Real* l,
                                                         std::ptrdiff_t ld,
                                                         Number* y) {
    Number t[Width];
#pragma GCC unroll 16
    for (int i = 0; i < Width; ++i) t[i] = y[i];
#pragma GCC unroll 16
    for (int j = Width - 1; j >= 0; --j) {
      t[j] = t[j] * same<Number>(l[j * ld + j]);
#pragma GCC unroll 16
      for (int i = 0; i < j; ++i) {
        t[i] = subtract_product_of(t[i], same<Number>(l[i * ld + j]), t[j]);
      }
    }
#pragma GCC unroll 16
    for (int i = 0; i < Width; ++i) y[i] = t[i];
  }

  /// Broadcast a number to all vectors.
  template <class Number>
  static DIFFCLOTH_INLINE Number same(Real a) {
    if constexpr (sizeof(Number) == sizeof(Real)) {
      return a;
    } else {
      return to_many(a);
    }
  }

  /// Call f<Width>() for the width of a triangle. A supernode has three columns for each vertex; widths
  /// below kLanes are the remainder of its columns.
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

  /// c -= L y for W columns, `ld` apart: few at a time, as memory is read fastest along columns.
  template <int W>
  static void subtract_columns(
      const Real* l, std::ptrdiff_t ld, int length, const Real* y, Real* c) {
    Pack y_j[W];
    for (int j = 0; j < W; ++j) y_j[j] = broadcast(y[j]);
    for (int row = 0; row < length; row += kLanes) {
      Pack sum = load(c + row);
      for (int j = 0; j < W; ++j) sum = subtract_product_of(sum, load(l + j * ld + row), y_j[j]);
      store(c + row, sum);
    }
  }

  static void forward(const Front& front, const Real* panel, Real* c) {
    for (int column = 0; column < front.columns; column += kLanes) {
      const int width = front.columns - column < kLanes ? front.columns - column : kLanes;
      const int below = column + kLanes;
      const Real* const l = panel + front.panel().place(0, column);
      const std::ptrdiff_t ld = front.panel().stride(column);
      with_triangle(width, [&]<int Width> { solve_triangle<Width>(l + column, ld, c + column); });
      int j = 0;
      for (; j + 4 <= width; j += 4) {
        subtract_columns<4>(l + j * ld + below, ld, front.ld - below, c + column + j, c + below);
      }
      for (; j < width; ++j) {
        subtract_columns<1>(l + j * ld + below, ld, front.ld - below, c + column + j, c + below);
      }
    }
  }

  /// Subtract from y[0 .. W - 1] the products of W columns, `ld` apart, with the vector c.
  template <int W>
  static void subtract_dots(const Real* l, std::ptrdiff_t ld, int length, const Real* c, Real* y) {
    Pack sum[W];
    for (int j = 0; j < W; ++j) sum[j] = Pack{};
    for (int row = 0; row < length; row += kLanes) {
      const Pack c_row = load(c + row);
      for (int j = 0; j < W; ++j) {
        sum[j] = subtract_product_of(sum[j], load(l + j * ld + row), c_row);
      }
    }
    for (int j = 0; j < W; ++j) y[j] += total(sum[j]);
  }

  static void backward(const Front& front, const Real* panel, Real* c) {
    for (int column = down_to_pack(front.columns - 1); column >= 0; column -= kLanes) {
      const int width = front.columns - column < kLanes ? front.columns - column : kLanes;
      const int below = column + kLanes;
      const Real* const l = panel + front.panel().place(0, column);
      const std::ptrdiff_t ld = front.panel().stride(column);
      int j = 0;
      for (; j + 4 <= width; j += 4) {
        subtract_dots<4>(l + j * ld + below, ld, front.ld - below, c + below, c + column + j);
      }
      for (; j < width; ++j) {
        subtract_dots<1>(l + j * ld + below, ld, front.ld - below, c + below, c + column + j);
      }
      with_triangle(
          width, [&]<int Width> { solve_transposed_triangle<Width>(l + column, ld, c + column); });
    }
  }

  /// Solve with the triangle of a block of columns, for many vectors.
  template <bool kTransposed>
  static DIFFCLOTH_INLINE void solve_triangle_of_many(const Real* l,
                                                      std::ptrdiff_t ld,
                                                      int width,
                                                      Real* c) {
    with_triangle(width, [&]<int Width> {
      Many y[Width];
      for (int i = 0; i < Width; ++i) y[i] = load_many(c + kMaxVectors * i);
      if constexpr (kTransposed) {
        solve_transposed_triangle<Width>(l, ld, y);
      } else {
        solve_triangle<Width>(l, ld, y);
      }
      for (int i = 0; i < Width; ++i) store(c + kMaxVectors * i, y[i]);
    });
  }

  static void forward_many(const Front& front, const Real* panel, Real* c) {
    constexpr int kRows = 8;  // sums stay in registers
    for (int column = 0; column < front.columns; column += kLanes) {
      const int width = front.columns - column < kLanes ? front.columns - column : kLanes;
      const Real* const l = panel + front.panel().place(0, column);
      const std::ptrdiff_t ld = front.panel().stride(column);
      Real* const c_column = c + kMaxVectors * column;
      solve_triangle_of_many<false>(l + column, ld, width, c_column);
      for (int row = column + kLanes; row < front.ld; row += kRows) {
        Many sum[kRows];
        for (int i = 0; i < kRows; ++i) sum[i] = load_many(c + kMaxVectors * (row + i));
        for (int j = 0; j < width; ++j) {
          const Many c_j = load_many(c_column + kMaxVectors * j);
          const Real* const l_j = l + j * ld + row;
#pragma GCC unroll 8
          for (int i = 0; i < kRows; ++i) {
            sum[i] = subtract_product_of(sum[i], to_many(l_j[i]), c_j);
          }
        }
        for (int i = 0; i < kRows; ++i) store(c + kMaxVectors * (row + i), sum[i]);
      }
    }
  }

  /// Subtract from y[0 .. W - 1] the products of W columns, `ld` apart, with many vectors. Sums have the
  /// order of subtract_dots(): by lane, here L lanes at a time, which are added in the order of total().
  template <int L, int W>
  static void subtract_dots_of_many(
      const Real* l, std::ptrdiff_t ld, int length, const Real* c, Real* y) {
    Many sum[W][kLanes];
    for (int lane = 0; lane < kLanes; lane += L) {
      Many s[W][L];
#pragma GCC unroll 8
      for (int k = 0; k < W * L; ++k) s[k / L][k % L] = Many{};
      for (int row = lane; row < length; row += kLanes) {
#pragma GCC unroll 8
        for (int i = 0; i < L; ++i) {
          const Many c_i = load_many(c + kMaxVectors * (row + i));
#pragma GCC unroll 8
          for (int j = 0; j < W; ++j) {
            s[j][i] = subtract_product_of(s[j][i], to_many(l[j * ld + row + i]), c_i);
          }
        }
      }
#pragma GCC unroll 8
      for (int k = 0; k < W * L; ++k) sum[k / L][lane + k % L] = s[k / L][k % L];
    }
    for (int j = 0; j < W; ++j) {
      for (int half = kLanes / 2; half > 0; half /= 2) {
        for (int i = 0; i < half; ++i) sum[j][i] = sum[j][i] + sum[j][i + half];
      }
      Real* const y_j = y + kMaxVectors * j;
      store(y_j, load_many(y_j) + sum[j][0]);
    }
  }

  static void backward_many(const Front& front, const Real* panel, Real* c) {
    for (int column = down_to_pack(front.columns - 1); column >= 0; column -= kLanes) {
      const int width = front.columns - column < kLanes ? front.columns - column : kLanes;
      const int below = column + kLanes;
      const Real* const l = panel + front.panel().place(0, column);
      const std::ptrdiff_t ld = front.panel().stride(column);
      Real* const c_column = c + kMaxVectors * column;
      const Real* const c_below = c + kMaxVectors * below;
      int j = 0;
      for (; j + 4 <= width; j += 4) {
        subtract_dots_of_many<2, 4>(l + j * ld + below, ld, front.ld - below, c_below,
                                    c_column + kMaxVectors * j);
      }
      for (; j < width; ++j) {
        subtract_dots_of_many<8, 1>(l + j * ld + below, ld, front.ld - below, c_below,
                                    c_column + kMaxVectors * j);
      }
      solve_triangle_of_many<true>(l + column, ld, width, c_column);
    }
  }

  static constexpr FrontKernels<Real> kKernels{.factor = factor,
                                               .add_to_panel = add_to_panel,
                                               .add_to_update = add_to_update,
                                               .forward = forward,
                                               .backward = backward,
                                               .forward_many = forward_many,
                                               .backward_many = backward_many};
};

using Four = double __attribute__((vector_size(32)));
using UnalignedFour = double __attribute__((vector_size(32), aligned(8), may_alias));

DIFFCLOTH_INLINE const UnalignedFour& four(const double* from) {
  return *reinterpret_cast<const UnalignedFour*>(from);
}

/// Columns of a block, each in the first three lanes; no memory behind the block is read.
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

void multiply_blocks(const std::int32_t* column_start,
                     const std::int32_t* row,
                     std::int32_t size,
                     const double* blocks,
                     const double* x,
                     double* y) {
  for (std::int32_t j = 0; j < size; ++j) {
    const std::ptrdiff_t place = 4 * static_cast<std::ptrdiff_t>(j);
    Four dots[3] = {};
    const Four x_j = four(x + place);
    Four y_j = {};
    std::int32_t k = column_start[j];
    Columns block;
    block.read(blocks + 9 * static_cast<std::ptrdiff_t>(k));
    block.add_product(x_j, y_j);
    for (++k; k < column_start[j + 1]; ++k) {
      block.read(blocks + 9 * static_cast<std::ptrdiff_t>(k));
      const std::ptrdiff_t i = 4 * static_cast<std::ptrdiff_t>(row[k]);
      const Four x_i = four(x + i);
      Four y_i = four(y + i);
      block.add_product(x_j, y_i);
      *reinterpret_cast<UnalignedFour*>(y + i) = y_i;
      for (int a = 0; a < 3; ++a) dots[a] += block.c[a] * x_i;
    }
    for (int a = 0; a < 3; ++a) y_j[a] += dots[a][0] + dots[a][1] + dots[a][2];
    *reinterpret_cast<UnalignedFour*>(y + place) += y_j;
  }
}

/// Numbers of kAcross vectors, of kMaxVectors.
using Across = double __attribute__((vector_size(8 * kAcross)));
using UnalignedAcross = double __attribute__((vector_size(8 * kAcross), aligned(8), may_alias));

DIFFCLOTH_INLINE const UnalignedAcross& across(const double* from) {
  return *reinterpret_cast<const UnalignedAcross*>(from);
}

/// Product for kAcross of kMaxVectors interleaved vectors.
void multiply_some(const std::int32_t* __restrict column_start,
                   const std::int32_t* __restrict row,
                   std::int32_t size,
                   const double* __restrict blocks,
                   const double* __restrict x,
                   double* __restrict y) {
  constexpr std::ptrdiff_t kRow = 3 * kMaxVectors;
  for (std::int32_t j = 0; j < size; ++j) {
    Across x_j[3];
    Across y_j[3];
    Across dots[3][3] = {};
    for (int b = 0; b < 3; ++b) x_j[b] = across(x + j * kRow + b * kMaxVectors);
    std::int32_t k = column_start[j];
    const double* A = blocks + 9 * static_cast<std::ptrdiff_t>(k);
    for (int b = 0; b < 3; ++b) y_j[b] = A[b] * x_j[0] + A[3 + b] * x_j[1] + A[6 + b] * x_j[2];
    for (++k; k < column_start[j + 1]; ++k) {
      A += 9;
      const double* const x_i = x + row[k] * kRow;
      double* const y_i = y + row[k] * kRow;
#pragma GCC unroll 3
      for (int b = 0; b < 3; ++b) {
        const Across x_ib = across(x_i + b * kMaxVectors);
#pragma GCC unroll 3
        for (int a = 0; a < 3; ++a) dots[a][b] += A[3 * a + b] * x_ib;
        const Across sum = A[b] * x_j[0] + A[3 + b] * x_j[1] + A[6 + b] * x_j[2];
        *reinterpret_cast<UnalignedAcross*>(y_i + b * kMaxVectors) += sum;
      }
    }
    for (int a = 0; a < 3; ++a) {
      y_j[a] += dots[a][0] + dots[a][1] + dots[a][2];
      *reinterpret_cast<UnalignedAcross*>(y + j * kRow + a * kMaxVectors) += y_j[a];
    }
  }
}

void multiply_blocks_many(const std::int32_t* column_start,
                          const std::int32_t* row,
                          std::int32_t size,
                          const double* blocks,
                          const double* x,
                          double* y) {
  for (int first = 0; first < kMaxVectors; first += kAcross) {
    multiply_some(column_start, row, size, blocks, x + first, y + first);
  }
}

constexpr DenseKernels kKernels{.multiply_blocks = multiply_blocks,
                                .multiply_blocks_many = multiply_blocks_many,
                                .doubles = Fronts<Doubles, Doubles>::kKernels,
                                .floats = Fronts<Floats, ManyFloats>::kKernels};

}  // namespace
}  // namespace diffcloth::linalg

#undef DIFFCLOTH_INLINE

// NOLINTEND(modernize-avoid-c-arrays)
