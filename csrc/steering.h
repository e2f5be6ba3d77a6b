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
    MOST_SPANS = 4,
    REACH = 5,      /* standard deviations that noise hardly exceeds in one part of the band */
    MOST_LAG = 64,
    DIRECTIONS = 8, /* directions scored side by side, in one vector or two */
    BIN_BLOCK = 16  /* planes are padded to whole cache lines */
};

/* What a search reads: numerator and denominator of q as sums over pairs. Two diagonals' sums first, then of
 * each pair re and im of the numerator, re and im of the denominator; at last the power of all microphones. */
typedef struct {
    int32_t bins, stride, half; /* half: bins each side that q is averaged over */
    int32_t thinning;           /* bins of the band that one of these stands for */
    float least;                /* denominators below it count as this */
    float *planes;
    float *share;               /* of each bin: 1 / bins that its average holds */
    float *looks;               /* that each bin is worth */
} locagen_response;

/* One average R_x, and what its q have been while nothing called. */
typedef struct {
    double heard;               /* sum of the weights in R_x: 0 at the start, then towards 1 */
    double heard_variance, heard_weights[8];
    double watched;             /* sum of the weights in `spread` */
    float lost[MOST_MICS];      /* of heard, what lacks this microphone */
    float *signal;              /* R_x times the sum of its weights */
    float *scores;              /* careful ones of the grid, in the last search */
    float *over, *spread, *calm; /* [vector of directions][coarse bin][lane]: q - 1 where above 0, in the last
                                 * search; its mean square over theory's, times the sum of the weights; what that
                                 * comes to (locagen_spread), made anew where the spread is */
    float *aside[2];            /* sums of such squares, since settle and before */
    int32_t aside_count[2];
} locagen_span;

struct locagen_steer_paths;

typedef struct steer {
    const struct locagen_steer_paths *paths;
    locagen_spectrum spectrum;
    int32_t mics, pairs, bins, stride;
    int32_t elevations, azimuths, whole_sphere, flat;
    int32_t groups;             /* of directions in the grid */
    float loading, floor;
    double axes[3][3];          /* in the array's plane: first and second axis, and its normal, downwards */
    double offset[MOST_MICS][3];/* p_m - p_0, as radians of phase per bin of frequency and unit of u */
    double per_metre;           /* radians of phase per bin of frequency and metre */
    double reach;               /* radians of phase at the band's upper end across the array */
    double looks;               /* independent looks in one frame: under 1 for a tapered window */
    double overlap[8];          /* squared coherence of the windows of frames 1 .. hops apart */
    int32_t hops;

    int32_t lag, spans;
    int32_t slot, listened;     /* of the ring: where the last frame is, how many frames it holds */
    int32_t frame_mics[MOST_LAG + 1]; /* masks: microphones that each frame may be used of */
    double learnt, learnt_variance; /* sum of the weights in R_n: 0 at the start, then towards 1 */
    double learnt_weights[8];
    float lost_noise[MOST_MICS];
    float smear;
    int32_t smear_half;         /* bins each side */
    int32_t inverse_mics;       /* that `inverse` was made for; 0: it has to be made anew */

    float *bins_re, *bins_im;   /* [frame of the ring][mic][stride] */
    float *noise;               /* matrix R_n times the sum of its weights */
    float *smeared;             /* the same, averaged over neighbouring bins */
    float *inverse, *rate;      /* (R_n / level + loading)^-1; 1 / level */
    float *mask;                /* [stride]: weight of each bin, 0 to 1 */
    locagen_span span[MOST_SPANS];
    locagen_response fine, coarse;
    float *nulls;               /* [source][mic][re, im][stride]: the phases of sources found */
    float *grid;                /* [group of directions][mic][start re, im, step re, im][DIRECTIONS] */
    float *aim;                 /* one such group, of the refinement */
    float *scores, *careful;    /* of the grid, the last time; careful ones with nulls */
    float *q;                   /* [bin][lane] */
    double *grid_u;             /* [direction][3] */
} steer;

/* How the matrices of a search are to be made. */
typedef struct {
    const locagen_span *span;
    int32_t mics;               /* mask */
    int32_t nulls;
    float noise_scale, signal_scale; /* 1 / sum of the weights */
    float white;                /* above 0: R_n is this times the unit matrix */
} locagen_whitening;

enum locagen_measure { MEASURE_RATIO, MEASURE_POWER }; /* sum of g(q), or of q */

/* Beside the scores of the grid: its q, and how calm each was before: 1 / wild, wild = max(1, spread over theory).
 * A careful score multiplies looks by it: whether there is a source. Where it is, the score tells with nearly all
 * looks of what is far beyond the noise's reach, less what noise takes that is louder than R_n: as it was
 * before, on average by theory * (wild - 1). */
typedef struct {
    float *over, *careful;      /* where to put q - 1 and careful scores; null: nowhere */
    const float *seen;          /* q - 1 of the grid before any null */
    const float *calm;          /* null: as theory says */
    float theory;               /* mean (q - 1)^2 of noise as theory has it */
} locagen_spread;

typedef struct locagen_steer_paths {
    int32_t width;              /* lanes */
    int (*listen)(steer *s, const float *in, float *power);
    void (*add)(const steer *s, int32_t slot, float keep, float share, float *matrix);
    void (*add_squares)(long count, float scale, float most, const float *over, float *sum);
    void (*blend)(long count, float keep, float share, const float *from, float *to);
    void (*soothe)(long count, float prior, float total, const float *spread, float *calm);
    void (*invert)(const steer *s, const locagen_whitening *how);
    void (*whiten)(const steer *s, const locagen_whitening *how);
    void (*score)(const steer *s, const locagen_response *r, enum locagen_measure measure,
                  const locagen_spread *spread, const float *phases, int32_t groups, float *score,
                  float *mean_q);
    void (*place)(const steer *s, const locagen_spread *spread, float *score);
} locagen_steer_paths;

extern const locagen_steer_paths locagen_steer_quad;
#if defined(__x86_64__)
extern const locagen_steer_paths locagen_steer_avx2;
#endif

#endif
