/* Cholesky factor of a symmetric band, and solutions with it.

   Entry (i, j), i >= j, of the matrix is a[i + j * step]: LAPACK's band storage with step + 1 rows. Beyond
   the band, entries down to `step` below the diagonal are there and zero, so that whole vectors may be
   read; step is a multiple of WIDE, and at least band + TILE. There are whole blocks of WIDE columns; those
   added have a diagonal of 1.

   Columns are taken in blocks, from the left; what the columns before take from a tile of TILE rows of a
   block is summed up in registers (a left-looking Cholesky: Golub & Van Loan 2013, 4.2). */
#include <math.h>
#include <string.h>

#ifdef __AVX512F__
#define WIDE 8
#else
#define WIDE 4
#endif
#if defined(__AVX__) && defined(__FMA__)
#define QUICK 1
#else
#define QUICK 0
#endif
#define DEEP 3
#define TILE (DEEP * WIDE)
typedef long long Int;
typedef double V __attribute__((vector_size(8 * WIDE)));
typedef double U __attribute__((vector_size(8 * WIDE), aligned(8)));

/* Columns of a block; 0 where the registers are too few or too short to be quick. */
int banded_wide(void) { return QUICK ? WIDE : 0; }
int banded_tile(void) { return TILE; }

/* A tile less `count` products of a column of rows, `on` numbers after the one before, and a row of heads. */
static inline void less(V t[WIDE][DEEP], const double *rows, Int on, const double *heads, Int by, Int count) {
  for (Int k = 0; k < count; k++, rows += on, heads += by) {
    V own[DEEP];
#pragma GCC unroll 3
    for (int d = 0; d < DEEP; d++) own[d] = *(const U *)(rows + d * WIDE);
#pragma GCC unroll 8
    for (int c = 0; c < WIDE; c++)
#pragma GCC unroll 3
      for (int d = 0; d < DEEP; d++) t[c][d] -= own[d] * heads[c];
  }
}

/* A tile: rows from `row`, columns of the block at `first`, less what the columns before take from it. */
static inline void reduced(V t[WIDE][DEEP], const double *a, const double *l, Int row, Int first,
                           Int band, Int step) {
  const Int begin = row - band > 0 ? row - band : 0;
#pragma GCC unroll 8
  for (int c = 0; c < WIDE; c++)
#pragma GCC unroll 3
    for (int d = 0; d < DEEP; d++) t[c][d] = *(const U *)(a + row + d * WIDE + (first + c) * step);
  less(t, l + row + begin * step, step, l + first + begin * step, step, first - begin);
}

/* The tile times the inverse of the block's transposed factor. */
static inline void divided(V t[WIDE][DEEP], const double corner[WIDE][WIDE], const double *inverse) {
#pragma GCC unroll 8
  for (int c = 0; c < WIDE; c++) {
#pragma GCC unroll 8
    for (int b = 0; b < c; b++)
#pragma GCC unroll 3
      for (int d = 0; d < DEEP; d++) t[c][d] -= t[b][d] * corner[c][b];
#pragma GCC unroll 3
    for (int d = 0; d < DEEP; d++) t[c][d] *= inverse[c];
  }
}

/* The factor of a block's own WIDE x WIDE corner; 0 where it is not positive definite. */
static int cornered(double corner[WIDE][WIDE], double *inverse) {
  for (int c = 0; c < WIDE; c++) {
    double pivot = corner[c][c];
    for (int b = 0; b < c; b++) pivot -= corner[c][b] * corner[c][b];
    if (!(pivot > 0) || !isfinite(pivot)) return 0;
    corner[c][c] = sqrt(pivot);
    inverse[c] = 1 / corner[c][c];
    for (int r = c + 1; r < WIDE; r++) {
      for (int b = 0; b < c; b++) corner[r][c] -= corner[r][b] * corner[c][b];
      corner[r][c] *= inverse[c];
    }
  }
  return 1;
}

/* Factor l (may be a) of a plus a damping on its diagonal; 0, or 1 + the block that is not positive. */
Int banded_factorise(const double *a, double *l, Int size, Int band, Int step, double damping) {
  for (Int first = 0; first < size; first += WIDE) {
    V t[WIDE][DEEP];
    double corner[WIDE][WIDE], inverse[WIDE];
    reduced(t, a, l, first, first, band, step);
    for (int c = 0; c < WIDE; c++) {
      t[c][0][c] += damping;
      for (int r = c; r < WIDE; r++) corner[r][c] = t[c][0][r];
    }
    if (!cornered(corner, inverse)) return 1 + first;
    divided(t, corner, inverse);
    Int row = first + TILE;
    for (int c = 0; c < WIDE; c++) {
      double *column = l + (first + c) * step + first;
      for (int r = c; r < WIDE; r++) column[r] = corner[r][c];
      for (int d = 1; d < DEEP; d++) *(U *)(column + d * WIDE) = t[c][d];
    }
    for (; row < first + WIDE + band; row += TILE) {
      reduced(t, a, l, row, first, band, step);
      divided(t, corner, inverse);
      for (int c = 0; c < WIDE; c++)
        for (int d = 0; d < DEEP; d++) *(U *)(l + row + d * WIDE + (first + c) * step) = t[c][d];
    }
    for (int c = 0; c < WIDE; c++) {
      const Int below = row - first - c;
      if (below <= step) memset(l + row + (first + c) * step, 0, (step + 1 - below) * sizeof(double));
    }
  }
  return 0;
}

/* x = inverse of the factorised matrix times x; x has `band` + TILE numbers more than there are rows. */
void banded_solve(const double *l, double *x, Int size, Int band, Int step) {
  for (Int first = 0; first < size; first += WIDE) {
    const double *block = l + first * step + first;
    double *own = x + first;
    for (int c = 0; c < WIDE; c++) {
      for (int b = 0; b < c; b++) own[c] -= block[c + b * step] * own[b];
      own[c] /= block[c + c * step];
    }
    for (Int r = WIDE; r < band + WIDE; r += WIDE) {
      V sum = *(U *)(own + r);
      for (int c = 0; c < WIDE; c++) sum -= own[c] * *(const U *)(block + r + c * step);
      *(U *)(own + r) = sum;
    }
  }
  for (Int r = size; r < size + band + TILE; r++) x[r] = 0;
  for (Int first = size - WIDE; first >= 0; first -= WIDE) {
    const double *block = l + first * step + first;
    double *own = x + first;
    V sum[WIDE];
    for (int c = 0; c < WIDE; c++) sum[c] = (V){0};
    for (Int r = WIDE; r < band + WIDE; r += WIDE) {
      const V known = *(U *)(own + r);
#pragma GCC unroll 8
      for (int c = 0; c < WIDE; c++) sum[c] += known * *(const U *)(block + r + c * step);
    }
    for (int c = WIDE - 1; c >= 0; c--) {
      for (int d = 0; d < WIDE; d++) own[c] -= sum[c][d];
      for (int b = c + 1; b < WIDE; b++) own[c] -= block[b + c * step] * own[b];
      own[c] /= block[c + c * step];
    }
  }
}

/* x = inverse of the factor l times x, for TILE right-hand sides at once: x has rows of TILE numbers. */
void banded_forward(const double *l, double *x, Int size, Int band, Int step) {
  for (Int first = 0; first < size; first += WIDE) {
    const Int begin = first - band > 0 ? first - band : 0;
    double *own = x + first * TILE;
    V t[WIDE][DEEP];
#pragma GCC unroll 8
    for (int r = 0; r < WIDE; r++)
#pragma GCC unroll 3
      for (int d = 0; d < DEEP; d++) t[r][d] = *(const U *)(own + r * TILE + d * WIDE);
    less(t, x + begin * TILE, TILE, l + first + begin * step, step, first - begin);
    const double *corner = l + first + first * step;
    for (int r = 0; r < WIDE; r++) {
      for (int b = 0; b < r; b++)
        for (int d = 0; d < DEEP; d++) t[r][d] -= t[b][d] * corner[r + b * step];
      const double inverse = 1 / corner[r + r * step];
      for (int d = 0; d < DEEP; d++) *(U *)(own + r * TILE + d * WIDE) = t[r][d] *= inverse;
    }
  }
}

/* Numbers of a column, and columns, of the working space of `banded_inverse`, before a row of that times WIDE. */
Int banded_side(Int band) { return 2 * (band + TILE + WIDE) + 8 * WIDE; }

/* Diagonal blocks of `block` columns from the last of `count` to that of `begin`, of the inverse Z, into `out`. The part
   of Z below a column that its band reaches is kept in a square of `side` numbers, z, whose first row and column are
   those of `origin`; it is moved to the end of the square when its beginning is reached. */
void banded_inverse(const double *l, double *z, double *out, Int size, Int band, Int step, Int block, Int begin,
                    Int count) {
  const Int side = banded_side(band), reach = band + TILE + WIDE;
  double *g = z + side * side;
  Int origin = size + reach - side, next = count - 1;
  memset(z, 0, (side + WIDE) * side * sizeof(double));
  for (Int first = size - WIDE; next >= begin; first -= WIDE) {
    if (first < origin) {
      const Int from = first + WIDE - origin, to = side - reach;
      for (Int c = reach - 1; c >= 0; c--)
        memmove(z + to + (to + c) * side, z + from + (from + c) * side, reach * sizeof(double));
      origin += from - to;
    }
    const Int own = first - origin, below = own + WIDE;
    const double *corner = l + first + first * step;
    V inverse[WIDE] = {{0}}; /* rows of that of the corner */
    for (int c = 0; c < WIDE; c++) {
      inverse[c][c] = 1 / corner[c + c * step];
      for (int r = c + 1; r < WIDE; r++) {
        double sum = 0;
        for (int b = c; b < r; b++) sum -= corner[r + b * step] * inverse[b][c];
        inverse[r][c] = sum / corner[r + r * step];
      }
    }
    V squared[WIDE];
#pragma GCC unroll 8
    for (int a = 0; a < WIDE; a++) {
      squared[a] = (V){0};
#pragma GCC unroll 8
      for (int r = a; r < WIDE; r++) squared[a] += inverse[r][a] * inverse[r];
    }
    for (Int k = 0; k < band; k++) {
      V sum = {0};
#pragma GCC unroll 8
      for (int b = 0; b < WIDE; b++) sum += corner[WIDE + k + b * step] * inverse[b];
      *(U *)(g + k * WIDE) = sum;
    }
    for (Int row = 0; row < band; row += TILE) {
      V t[WIDE][DEEP];
      for (int c = 0; c < WIDE; c++)
        for (int d = 0; d < DEEP; d++) t[c][d] = (V){0};
      less(t, z + below + row + below * side, side, g, WIDE, band);
#pragma GCC unroll 8
      for (int c = 0; c < WIDE; c++) /* rows beyond the band are never read */
#pragma GCC unroll 3
        for (int d = 0; d < DEEP; d++) *(U *)(z + below + row + d * WIDE + (own + c) * side) = t[c][d];
    }
    for (Int k = 0; k < band; k++) {
      V known;
#pragma GCC unroll 8
      for (int c = 0; c < WIDE; c++) known[c] = z[below + k + (own + c) * side];
#pragma GCC unroll 8
      for (int a = 0; a < WIDE; a++) squared[a] -= g[k * WIDE + a] * known;
      *(U *)(z + own + (below + k) * side) = known;
    }
    for (int a = 0; a < WIDE; a++) /* symmetric, else rounding errors grow */
      for (int b = 0; b < WIDE; b++) z[own + a + (own + b) * side] = (squared[a][b] + squared[b][a]) / 2;
    for (; next >= begin && first <= next * block; next--)
      for (Int c = 0; c < block; c++) {
        const Int at = next * block - origin;
        memcpy(out + ((next - begin) * block + c) * block, z + at + (at + c) * side, block * sizeof(double));
      }
  }
}
