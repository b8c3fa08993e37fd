/* Operations of the functions that `simd_codegen` writes: V has one frame per lane. */
#include <math.h>
#define GROUP 8
#ifdef __AVX512F__
#define LANES 8
#define ALL(x) x(0) x(1) x(2) x(3) x(4) x(5) x(6) x(7)
#define EVERY(x) x(0) x(1) x(2) x(3) x(4) x(5) x(6) x(7)
#elif defined(__AVX__)
#define LANES 4
#define ALL(x) x(0) x(1) x(2) x(3)
#define EVERY(x) x(0) x(1) x(2) x(3)
#else
#define LANES 2
#define ALL(x) x(0) x(1)
#define EVERY(x) x(0) x(1)
#endif
typedef double V __attribute__((vector_size(8 * LANES)));
typedef double U __attribute__((vector_size(8 * LANES), aligned(8)));
typedef long long M __attribute__((vector_size(8 * LANES)));
typedef struct {
  const double *const *in;
  double *const *out;
  long long width, frame;
  M live;
  const long long *place;
  double *row[LANES];
} Now;
#define SMALL static inline __attribute__((always_inline))
SMALL V where(M mask, V a) { return (V)(mask & (M)a); }
SMALL V either(M mask, V a, V b) { return (V)((mask & (M)a) | (~mask & (M)b)); }
SMALL V one(M mask) { return where(mask, (V){} + 1.0); }
#define ALIKE(i, k) ((V){} + now->in[i][k])
#define GET(i, k) (*(const U *)(now->in[i] + (k) * now->width + now->frame))
#define PUT(i, k, v) *(U *)(now->out[i] + (k) * now->width + now->frame) = where(now->live, v)
#ifdef __clang__
#define PICK(a, b, lane) __builtin_shufflevector(a, b, EVERY(lane))
#else
#define PICK(a, b, lane) __builtin_shuffle(a, b, (M){EVERY(lane)})
#endif
#define LOW1(l) (l & 1 ? l - 1 + LANES : l),
#define HIGH1(l) (l & 1 ? l + LANES : l + 1),
#define LOW2(l) (l & 2 ? l - 2 + LANES : l),
#define HIGH2(l) (l & 2 ? l + LANES : l + 2),
#define LOW4(l) (l & 4 ? l - 4 + LANES : l),
#define HIGH4(l) (l & 4 ? l + LANES : l + 4),
#define SWAP(i, size) if (!(i & size)) { \
    const V a = v[i], b = v[i + size]; \
    v[i] = PICK(a, b, LOW##size); v[i + size] = PICK(a, b, HIGH##size); }
#define SWAP1(i) SWAP(i, 1)
#define SWAP2(i) SWAP(i, 2)
#define SWAP4(i) SWAP(i, 4)
/* Numbers of all frames -> frames with all numbers; each to its place. */
static void put_group(const Now *now, long long place, const V *all) {
  for (int first = 0; first < GROUP; first += LANES) {
    V v[2 * LANES];
#define TAKE(l) v[l] = all[first + l];
    ALL(TAKE)
    ALL(SWAP1)
#if LANES > 2
    ALL(SWAP2)
#endif
#if LANES > 4
    ALL(SWAP4)
#endif
#define GIVE(l) *(U *)(now->row[l] + place + first) = v[l];
    ALL(GIVE)
  }
}
#define EACH(f) static V each_##f(V a) { for (int l = 0; l < LANES; l++) a[l] = f(a[l]); return a; }
EACH(sqrt) EACH(floor) EACH(log) EACH(sin) EACH(cos)
static V each_atan2(V a, V b) { for (int l = 0; l < LANES; l++) a[l] = atan2(a[l], b[l]); return a; }
