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

/* A tile: rows from `row`, columns of the block at `first`, less what the columns before take from it. */
static inline void reduced(V t[WIDE][DEEP], const double *a, const double *l, Int row, Int first,
                           Int band, Int step) {
  const Int begin = row - band > 0 ? row - band : 0;
#pragma GCC unroll 8
  for (int c = 0; c < WIDE; c++)
#pragma GCC unroll 3
    for (int d = 0; d < DEEP; d++) t[c][d] = *(const U *)(a + row + d * WIDE + (first + c) * step);
  const double *rows = l + row + begin * step, *heads = l + first + begin * step;
  for (Int k = begin; k < first; k++, rows += step, heads += step) {
    V own[DEEP];
#pragma GCC unroll 3
    for (int d = 0; d < DEEP; d++) own[d] = *(const U *)(rows + d * WIDE);
#pragma GCC unroll 8
    for (int c = 0; c < WIDE; c++)
#pragma GCC unroll 3
      for (int d = 0; d < DEEP; d++) t[c][d] -= own[d] * heads[c];
  }
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
    const double *heads = l + first + begin * step, *known = x + begin * TILE;
    for (Int k = begin; k < first; k++, heads += step, known += TILE) {
      V row[DEEP];
#pragma GCC unroll 3
      for (int d = 0; d < DEEP; d++) row[d] = *(const U *)(known + d * WIDE);
#pragma GCC unroll 8
      for (int r = 0; r < WIDE; r++)
#pragma GCC unroll 3
        for (int d = 0; d < DEEP; d++) t[r][d] -= row[d] * heads[r];
    }
    const double *corner = l + first + first * step;
    for (int r = 0; r < WIDE; r++) {
      for (int b = 0; b < r; b++)
        for (int d = 0; d < DEEP; d++) t[r][d] -= t[b][d] * corner[r + b * step];
      const double inverse = 1 / corner[r + r * step];
      for (int d = 0; d < DEEP; d++) *(U *)(own + r * TILE + d * WIDE) = t[r][d] *= inverse;
    }
  }
}
