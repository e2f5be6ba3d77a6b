/* lanes.h - vectors whose lanes are microphones, and the moves between lanes that the kernel needs.
 *
 * Four lanes hold the same sample or bin of four microphones; a vector of WIDTH floats (4 on SSE and
 * NEON, 8 on AVX) holds one such quad or two neighbouring ones. A file that defines WIDTH and includes
 * this header is compiled for that width; the code above it does not ask which. Only GCC's vector
 * extensions are used (gcc 12 or later; clang has them too), so the same source is SSE, AVX and NEON.
 */
#ifndef LOCAGEN_LANES_H
#define LOCAGEN_LANES_H
#include <stdint.h>
#include <string.h>

#ifndef WIDTH
#error "define WIDTH, 4 or 8, before lanes.h"
#endif
#define QUADS (WIDTH / 4)
#define INLINE static inline __attribute__((always_inline))
/* A step of the way that keeps the registers to itself: in one large function they spill. */
#define STEP static __attribute__((noinline))

typedef float quad __attribute__((vector_size(16)));
typedef float vec __attribute__((vector_size(4 * WIDTH)));
typedef int32_t ivec __attribute__((vector_size(4 * WIDTH)));

/* Memory of any alignment; on every CPU since 2011 this costs nothing where the address is aligned. */
INLINE vec load(const float *p)
{
    vec v;
    memcpy(&v, p, sizeof v);
    return v;
}

INLINE void store(float *p, vec v)
{
    memcpy(p, &v, sizeof v);
}

INLINE quad load_quad(const float *p)
{
    quad v;
    memcpy(&v, p, sizeof v);
    return v;
}

INLINE void store_quad(float *p, quad v)
{
    memcpy(p, &v, sizeof v);
}

INLINE vec all(float x)
{
    return x - (vec){0};
}

#if WIDTH == 4

#define SHUFFLED(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
INLINE quad low(vec v) { return v; }
INLINE vec both(quad v) { return v; }
INLINE quad folded(vec v) { return v; }
INLINE vec reversed(vec v) { return __builtin_shufflevector(v, v, 3, 2, 1, 0); }

/* Quad k in steps downwards: k, then k - 1. */
INLINE vec load_down(const float *p) { return load_quad(p); }
INLINE void store_down(float *p, vec v) { store_quad(p, v); }

/* The quads of a vector, each to its own place. */
INLINE void store_apart(float *p, long apart, vec v)
{
    (void)apart;
    store_quad(p, v);
}

#elif WIDTH == 8

/* Indices count through both arguments: 0-7 for quads, 0-15 here; both quads are shuffled alike. */
#define LOW(i) ((i) + ((i) > 3 ? 4 : 0))
#define SHUFFLED(a, b, i, j, k, l) \
    __builtin_shufflevector(a, b, LOW(i), LOW(j), LOW(k), LOW(l), LOW(i) + 4, LOW(j) + 4, LOW(k) + 4,        \
                            LOW(l) + 4)
INLINE quad low(vec v) { return __builtin_shufflevector(v, v, 0, 1, 2, 3); }
INLINE quad high(vec v) { return __builtin_shufflevector(v, v, 4, 5, 6, 7); }
INLINE vec joined(quad a, quad b) { return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7); }
INLINE vec both(quad v) { return joined(v, v); }
INLINE quad folded(vec v) { return low(v) + high(v); }
INLINE vec reversed(vec v) { return __builtin_shufflevector(v, v, 7, 6, 5, 4, 3, 2, 1, 0); }
INLINE vec load_down(const float *p) { return joined(load_quad(p), load_quad(p - 4)); }

INLINE void store_down(float *p, vec v)
{
    store_quad(p, low(v));
    store_quad(p - 4, high(v));
}

INLINE void store_apart(float *p, long apart, vec v)
{
    store_quad(p, low(v));
    store_quad(p + apart, high(v));
}

#endif
#endif
