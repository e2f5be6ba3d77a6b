/* steering.h - the state of the steered search, shared by its set-up, its search and the paths of each width.
 *
 * A Hermitian matrix per bin is kept as planes of `stride` floats, one per number, so that lanes are bins:
 * first the M diagonals, then re and im of each pair (i, j), i < j, in the order of all pairs.
 */
#ifndef LOCAGEN_STEERING_H
#define LOCAGEN_STEERING_H
#include "locagen.h"
#include "spectrum.h"

enum {
    MOST_MICS = 8,
    DIRECTIONS = 8, /* directions scored side by side, in one vector or two */
    BIN_BLOCK = 16  /* planes are padded to whole cache lines */
};

/* What a search reads: numerator and denominator of q as sums over pairs. Two diagonals' sums first, then of
 * each pair re and im of the numerator, re and im of the denominator. */
typedef struct {
    int32_t bins, stride, half; /* half: bins each side that q is averaged over */
    float weight;               /* bins of the band that one of these stands for */
    float least;                /* denominators below it count as this */
    float *planes;
    float *share;               /* of each bin: 1 / bins that its average holds */
} locagen_response;

struct locagen_steer_paths;

typedef struct steer {
    const struct locagen_steer_paths *paths;
    locagen_spectrum spectrum;
    int32_t mics, pairs, bins, stride;
    int32_t elevations, azimuths, whole_sphere, flat;
    float loading, floor;
    double axes[3][3];          /* in the array's plane: first and second axis, and its normal, downwards */
    double offset[MOST_MICS][3];/* p_m - p_0, as radians of phase per bin of frequency and unit of u */
    double reach;               /* radians of phase at the band's upper end across the array */
    double looks;               /* independent looks in one frame: under 1 for a tapered window */
    double overlap[8];          /* squared coherence of the windows of frames 1 .. hops apart */
    int32_t hops;

    int32_t frame_mics;         /* mask: microphones that the last frame may be used of */
    double learnt, heard;       /* sum of the weights in R_n, R_x: 0 at the start, then towards 1 */
    double heard_variance, heard_weights[8];
    float lost_noise[MOST_MICS], lost_signal[MOST_MICS]; /* of those weights, what lacks this microphone */

    float *bins_re, *bins_im;   /* [mic][stride]: the last frame */
    float *noise, *signal;      /* matrices R_n, R_x times the sum of their weights */
    locagen_response fine, coarse;
    float *nulls;               /* [source][mic][re, im][stride]: the phases of sources found */
    float *grid;                /* [group of directions][mic][start re, im, step re, im][DIRECTIONS] */
    float *aim;                 /* one such group, of the refinement */
    float *scores;              /* of the grid */
    float *q;                   /* [bin][lane] */
    double *grid_u;             /* [direction][3] */
} steer;

/* How the matrices of a search are to be made. */
typedef struct {
    int32_t mics;               /* mask */
    int32_t nulls;
    float noise_scale, signal_scale; /* 1 / sum of the weights */
    float white;                /* above 0: R_n is this times the unit matrix */
} locagen_whitening;

enum locagen_measure { MEASURE_RATIO, MEASURE_POWER }; /* sum of g(q), or of q */

typedef struct locagen_steer_paths {
    int (*listen)(steer *s, const float *in, float *power);
    void (*add)(const steer *s, float keep, float share, float *matrix);
    void (*whiten)(const steer *s, const locagen_whitening *how);
    void (*score)(const steer *s, const locagen_response *r, enum locagen_measure measure,
                  const float *phases, int32_t groups, float *score, float *mean_q);
} locagen_steer_paths;

extern const locagen_steer_paths locagen_steer_quad;
#if defined(__x86_64__)
extern const locagen_steer_paths locagen_steer_avx2;
#endif

#endif
