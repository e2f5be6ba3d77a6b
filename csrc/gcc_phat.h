/* gcc_phat.h - the state of the kernel, shared by its set-up and by the path of a frame. */
#ifndef LOCAGEN_GCC_PHAT_H
#define LOCAGEN_GCC_PHAT_H
#include "spectrum.h"

enum {
    TAPS = 6,       /* coarse bins that one bin is spread over */
    BLOCK_HALF = 63 /* lags each side of a block's centre: a typical array's lags are one block */
};

/* How lane l of one group of four microphones meets lane turn[l] of another (or the same) group. */
enum turn { TURN_RING3, TURN_0, TURN_1, TURN_2, TURN_3, TURNS };

/* One product of two groups of spectra: up to four pairs of microphones at once. */
typedef struct {
    int32_t group_i, group_j;
    enum turn turn;
    int32_t pairs;
    int32_t lane[4];     /* of each pair: where the product holds it */
    int32_t row[4];      /*               its place in the output */
    float direction[4];  /* by lane: -1 where the lane holds (j, i), as the ring of three does once */
} locagen_product;

typedef struct state {
    int (*frame)(const struct state *, const float *in, float *correlation, float *power);
    locagen_spectrum spectrum;
    int32_t lags;
    float floor, relative_floor, bin_share; /* bin_share: 1 / bins in the band */
    int32_t products;
    locagen_product product[8];       /* eight microphones: 2 in each group, 4 across */
    int32_t decimation;               /* bins per coarse bin, a power of two; 1: no spreading */
    int32_t coarse;                   /* number of coarse bins */
    float *weights;                   /* [tap][bin in its block], in quads */
    float *coarse_re, *coarse_im;     /* quads */
    int32_t blocks, half, table_lags; /* blocks of lags; lags each side of a centre; the same, padded, with 0 */
    float *table;                     /* [coarse bin][cos, sin][table_lags] */
    float *start, *step;              /* phasors of each coarse bin: to the first block, to the next */
    float *gain;                      /* of each lag */
} state;

int locagen_frame_quad(const state *s, const float *in, float *correlation, float *power);
#if defined(__x86_64__)
int locagen_frame_avx2(const state *s, const float *in, float *correlation, float *power);
#endif

#endif
