// The dense kernels, written once over packs of eight doubles. A file that compiles them for some
// instructions defines, in its anonymous namespace and before it includes this one, the type Pack
// with the operations on it, and
//
//   kPacks  packs of rows in a register block of C (1 or 4),   kWidth  columns of it (3 or 6)
//
// Such a file must hold nothing that another file could define, too: the linker would keep one copy,
// perhaps of instructions that the machine lacks. So this one includes no Eigen and no standard
// templates, and everything in it is in an anonymous namespace.

#pragma once

#include <cstddef>

#include "linalg/dense_kernels.h"

namespace diffcloth::linalg {
namespace {

constexpr int kLanes = 8;
constexpr double kLargest = 1.7976931348623157e308;

constexpr int up_to_pack(int n) { return (n + kLanes - 1) / kLanes * kLanes; }
constexpr int down_to_pack(int n) { return n / kLanes * kLanes; }

/// A block of 8 P rows and W columns in registers.
template <int P, int W>
struct Tile {
  Pack c[W][P];

  inline __attribute__((always_inline)) void clear() {
#pragma GCC unroll 8
    for (int j = 0; j < W; ++j) {
#pragma GCC unroll 8
      for (int p = 0; p < P; ++p) c[j][p] = zero();
    }
  }

  inline __attribute__((always_inline)) void load_from(const double* from, std::ptrdiff_t ld) {
#pragma GCC unroll 8
    for (int j = 0; j < W; ++j) {
#pragma GCC unroll 8
      for (int p = 0; p < P; ++p) c[j][p] = load(from + j * ld + kLanes * p);
    }
  }

  inline __attribute__((always_inline)) void store_to(double* to, std::ptrdiff_t ld) const {
#pragma GCC unroll 8
    for (int j = 0; j < W; ++j) {
#pragma GCC unroll 8
      for (int p = 0; p < P; ++p) store(to + j * ld + kLanes * p, c[j][p]);
    }
  }

  /// C -= A B^T with A [8 P, depth] and B [W, depth] of one leading dimension.
  inline __attribute__((always_inline)) void subtract_product(const double* a,
                                                              const double* b,
                                                              std::ptrdiff_t ld,
                                                              int depth) {
    for (int k = 0; k < depth; ++k) {
      Pack a_k[P];
#pragma GCC unroll 8
      for (int p = 0; p < P; ++p) a_k[p] = load(a + kLanes * p);
#pragma GCC unroll 8
      for (int j = 0; j < W; ++j) {
        const Pack b_k = broadcast(b[j]);
#pragma GCC unroll 8
        for (int p = 0; p < P; ++p) c[j][p] = subtract_product_of(c[j][p], a_k[p], b_k);
      }
      a += ld;
      b += ld;
    }
  }

  /// C := C L^-T for a lower triangle [W, W] with its diagonal inverted.
  inline __attribute__((always_inline)) void solve(const double* l, std::ptrdiff_t ld) {
#pragma GCC unroll 8
    for (int j = 0; j < W; ++j) {
      const Pack inverse = broadcast(l[j + j * ld]);
#pragma GCC unroll 8
      for (int p = 0; p < P; ++p) c[j][p] = c[j][p] * inverse;
#pragma GCC unroll 8
      for (int i = j + 1; i < W; ++i) {
        const Pack l_ij = broadcast(l[i + j * ld]);
#pragma GCC unroll 8
        for (int p = 0; p < P; ++p) c[i][p] = subtract_product_of(c[i][p], c[j][p], l_ij);
      }
    }
  }
};

/// Rows `row` .. row + 8 P - 1 of the block of W columns that begins at `column`.
template <int P, int W>
void panel_tile(double* panel, std::ptrdiff_t ld, int row, int column) {
  Tile<P, W> tile;
  double* const c = panel + row + column * ld;
  tile.load_from(c, ld);
  tile.subtract_product(panel + row, panel + column, ld, column);
  tile.solve(panel + column + column * ld, ld);
  tile.store_to(c, ld);
}

template <int W>
void panel_tile(double* panel, std::ptrdiff_t ld, int row, int packs, int column) {
  if constexpr (kPacks == 4) {
    if (packs == 4) return panel_tile<4, W>(panel, ld, row, column);
    if (packs == 3) return panel_tile<3, W>(panel, ld, row, column);
    if (packs == 2) return panel_tile<2, W>(panel, ld, row, column);
  }
  panel_tile<1, W>(panel, ld, row, column);
}

/// Cholesky factor of the lower triangle [W, W] at l, 1 / l_jj on its diagonal.
template <int W>
bool factor_corner(double* l, std::ptrdiff_t ld) {
  for (int j = 0; j < W; ++j) {
    const double pivot = l[j + j * ld];
    if (!(pivot > 0.0 && pivot <= kLargest)) return false;
    const double inverse = 1.0 / __builtin_sqrt(pivot);
    l[j + j * ld] = inverse;
    for (int i = j + 1; i < W; ++i) l[i + j * ld] *= inverse;
    for (int k = j + 1; k < W; ++k) {
      for (int i = k; i < W; ++i) {
        l[i + k * ld] = subtract_product_of(l[i + k * ld], l[i + j * ld], l[k + j * ld]);
      }
    }
  }
  return true;
}

/// Finish W columns of the triangle, whose earlier columns are done. Packs may begin above it; what
/// they then change means nothing.
template <int W>
bool factor_columns(double* panel, std::ptrdiff_t ld, int top, int column) {
  const int end = up_to_pack(column + W);
  for (int row = down_to_pack(column); row < end; row += kLanes) {
    Tile<1, W> tile;
    double* const c = panel + row + column * ld;
    tile.load_from(c, ld);
    tile.subtract_product(panel + row, panel + column, ld, column);
    tile.store_to(c, ld);
  }
  double* const corner = panel + column + column * ld;
  if (!factor_corner<W>(corner, ld)) return false;
  if (column + W < end) {  // the last pack goes on below the corner, which has to stay
    double kept[W][W];
    for (int j = 0; j < W; ++j) {
      for (int i = 0; i < W; ++i) kept[j][i] = corner[i + j * ld];
    }
    Tile<1, W> tile;
    double* const c = panel + end - kLanes + column * ld;
    tile.load_from(c, ld);
    tile.solve(corner, ld);
    tile.store_to(c, ld);
    for (int j = 0; j < W; ++j) {
      for (int i = 0; i < W; ++i) corner[i + j * ld] = kept[j][i];
    }
  }
  for (int row = end; row < top; row += kLanes * kPacks) {
    const int packs = (top - row) / kLanes;
    panel_tile<W>(panel, ld, row, packs < kPacks ? packs : kPacks, column);
  }
  return true;
}

bool factor(const Front& front, double* panel) {
  const int columns = front.columns;
  const int whole = columns / kWidth * kWidth;
  for (int j = 0; j < whole; j += kWidth) {
    if (!factor_columns<kWidth>(panel, front.ld, front.top, j)) return false;
  }
  if (whole < columns && !factor_columns<3>(panel, front.ld, front.top, whole)) return false;

  // Below the triangle, rows by rows: a strip of them stays in the cache over all columns.
  for (int row = front.top; row < front.ld; row += kLanes * kPacks) {
    const int left = (front.ld - row) / kLanes;
    const int packs = left < kPacks ? left : kPacks;
    for (int j = 0; j < whole; j += kWidth) panel_tile<kWidth>(panel, front.ld, row, packs, j);
    if (whole < columns) panel_tile<3>(panel, front.ld, row, packs, whole);
  }
  return true;
}

template <int P, int W>
void update_tile(
    const double* a, const double* b, std::ptrdiff_t ld, int depth, double* u, std::ptrdiff_t ldu) {
  Tile<P, W> tile;
  tile.clear();
  tile.subtract_product(a, b, ld, depth);
  tile.store_to(u, ldu);
}

template <int W>
void update_tile(const double* a,
                 const double* b,
                 std::ptrdiff_t ld,
                 int depth,
                 double* u,
                 std::ptrdiff_t ldu,
                 int packs) {
  if constexpr (kPacks == 4) {
    if (packs == 4) return update_tile<4, W>(a, b, ld, depth, u, ldu);
    if (packs == 3) return update_tile<3, W>(a, b, ld, depth, u, ldu);
    if (packs == 2) return update_tile<2, W>(a, b, ld, depth, u, ldu);
  }
  update_tile<1, W>(a, b, ld, depth, u, ldu);
}

void update(const Front& front, const double* panel, double* u) {
  const double* const l = panel + front.top;
  const std::ptrdiff_t ld = front.ld;
  const std::ptrdiff_t ldu = front.update_ld;
  const int padded = up_to_pack(front.rows);
  for (int strip = 0; strip < padded; strip += kLanes * kPacks) {
    const int end = strip + kLanes * kPacks < padded ? strip + kLanes * kPacks : padded;
    for (int j = 0; j < front.rows && j < end; j += kWidth) {
      const int row = j < strip ? strip : down_to_pack(j);  // above are only entries of no meaning
      const int packs = (end - row) / kLanes;
      double* const c = u + row + j * ldu;
      if (j + kWidth <= front.rows) {
        update_tile<kWidth>(l + row, l + j, ld, front.columns, c, ldu, packs);
      } else {
        update_tile<3>(l + row, l + j, ld, front.columns, c, ldu, packs);
      }
    }
  }
}

inline __attribute__((always_inline)) void add(const double* from, int count, double* to) {
  int i = 0;
  for (; i + kLanes <= count; i += kLanes) store(to + i, load(to + i) + load(from + i));
  if (i < count) add_some(from + i, count - i, to + i);
}

void add_to_panel(
    const Front& child, const double* u, const ChildMap& map, const Front& front, double* panel) {
  for (int r = 0; r < map.column_runs; ++r) {
    for (int k = 0; k < map.runs[r].count; ++k) {
      const double* const from =
          u + static_cast<std::ptrdiff_t>(map.runs[r].from + k) * child.update_ld;
      double* const to = panel + static_cast<std::ptrdiff_t>(map.runs[r].to + k) * front.ld;
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

void add_to_update(const Front& child,
                   const double* u,
                   const ChildMap& map,
                   const Front& front,
                   double* parent_u) {
  for (int r = map.column_runs; r < map.run_count; ++r) {
    for (int k = 0; k < map.runs[r].count; ++k) {
      const double* const from =
          u + static_cast<std::ptrdiff_t>(map.runs[r].from + k) * child.update_ld;
      double* const to =
          parent_u + static_cast<std::ptrdiff_t>(map.runs[r].to + k) * front.update_ld;
      add(from + map.runs[r].from + k, map.runs[r].count - k, to + map.runs[r].to + k);
      for (int q = r + 1; q < map.run_count; ++q) {
        add(from + map.runs[q].from, map.runs[q].count, to + map.runs[q].to);
      }
    }
  }
}

template <int R>
void forward(const Front& front, const double* panel, double* c, std::ptrdiff_t stride) {
  for (int column = 0; column < front.columns; column += kLanes) {
    const int width = front.columns - column < kLanes ? front.columns - column : kLanes;
    const double* const l = panel + static_cast<std::ptrdiff_t>(column) * front.ld;
    for (int r = 0; r < R; ++r) {
      double* const y = c + r * stride + column;
      for (int j = 0; j < width; ++j) {
        const double* const l_j = l + static_cast<std::ptrdiff_t>(j) * front.ld + column;
        y[j] *= l_j[j];
        for (int i = j + 1; i < width; ++i) y[i] = subtract_product_of(y[i], l_j[i], y[j]);
      }
    }
    for (int row = column + kLanes; row < front.ld; row += kLanes) {
      Pack sum[R];
      for (int r = 0; r < R; ++r) sum[r] = load(c + r * stride + row);
      for (int j = 0; j < width; ++j) {
        const Pack l_j = load(l + static_cast<std::ptrdiff_t>(j) * front.ld + row);
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
void subtract_dots(const double* l,
                   std::ptrdiff_t ld,
                   int length,
                   const double* c,
                   double* y,
                   std::ptrdiff_t stride) {
  Pack sum[R][W];
  for (int r = 0; r < R; ++r) {
    for (int j = 0; j < W; ++j) sum[r][j] = zero();
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
void backward(const Front& front, const double* panel, double* c, std::ptrdiff_t stride) {
  const std::ptrdiff_t ld = front.ld;
  for (int column = down_to_pack(front.columns - 1); column >= 0; column -= kLanes) {
    const int width = front.columns - column < kLanes ? front.columns - column : kLanes;
    const int below = column + kLanes;
    const double* const l = panel + column * ld;
    int j = 0;
    for (; j + 4 <= width; j += 4) {
      subtract_dots<R, 4>(l + j * ld + below, ld, front.ld - below, c + below, c + column + j,
                          stride);
    }
    for (; j < width; ++j) {
      subtract_dots<R, 1>(l + j * ld + below, ld, front.ld - below, c + below, c + column + j,
                          stride);
    }
    for (int r = 0; r < R; ++r) {
      double* const y = c + r * stride + column;
      for (j = width - 1; j >= 0; --j) {
        const double* const l_j = l + j * ld + column;
        for (int i = width - 1; i > j; --i) y[j] = subtract_product_of(y[j], l_j[i], y[i]);
        y[j] *= l_j[j];
      }
    }
  }
}

void forward(const Front& front, const double* panel, double* c, std::ptrdiff_t stride, int count) {
  switch (count) {
    case 1:
      return forward<1>(front, panel, c, stride);
    case 2:
      return forward<2>(front, panel, c, stride);
    case 3:
      return forward<3>(front, panel, c, stride);
    default:
      return forward<4>(front, panel, c, stride);
  }
}

void backward(
    const Front& front, const double* panel, double* c, std::ptrdiff_t stride, int count) {
  switch (count) {
    case 1:
      return backward<1>(front, panel, c, stride);
    case 2:
      return backward<2>(front, panel, c, stride);
    case 3:
      return backward<3>(front, panel, c, stride);
    default:
      return backward<4>(front, panel, c, stride);
  }
}

constexpr DenseKernels kKernels{.factor = factor,
                                .update = update,
                                .add_to_panel = add_to_panel,
                                .add_to_update = add_to_update,
                                .forward = forward,
                                .backward = backward};

}  // namespace
}  // namespace diffcloth::linalg
