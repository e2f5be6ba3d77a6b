/* frame_avx2.c - the same path with two quads per vector, for a PC that has AVX2 and fused multiply-add;
 * chosen at run time, so this file alone may use them. */
#if defined(__x86_64__)
#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC target("avx2,fma")
#endif
#define WIDTH 8
#include "frame_path.h"
#include "steering_path.h"

int locagen_frame_avx2(const state *s, const float *in, float *correlation, float *power)
{
    return frame_path(s, in, correlation, power);
}

const locagen_steer_paths locagen_steer_avx2 = {
    WIDTH, listen, add_frame, add_squares, blend, soothe, invert_band, whiten_band, score_groups, place_groups,
};
#if defined(__clang__)
#pragma clang attribute pop
#endif
#else
typedef int locagen_no_avx2; /* ISO C wants a declaration in every file */
#endif
