/* locagen.h - the whole C API of the acoustic kernel.
 *
 * GCC-PHAT (Knapp & Carter 1976, "The generalized correlation method for estimation of time
 * delay") of all microphone pairs of one frame: window, real FFT, whitening, and only those lags
 * that the array's geometry allows, on a sub-sample grid.
 *
 * Conventions, the same words as in Python:
 *   layout    float32, full scale 1.0, microphone by microphone: in[m * frame + n]
 *   pairs     (i, j) with i < j, in the order (0,1) (0,2) .. (0,M-1) (1,2) ..
 *   sign      a peak at a positive lag means that microphone j hears later than i: tau = t_j - t_i
 *   whitening each bin X of power p becomes X / sqrt(p + f), f the larger of floor and relative_floor times
 *             the microphone's mean bin power in the band: silence gives zeros, and bins that are empty
 *             of the source are not blown up to its size
 *   scaling   mean over the band's bins: a pair coherent over the whole band, without noise, has a peak
 *             of 1.0, less what the floor takes
 *   accuracy  1e-4 of the peak against the same in double precision
 *   aliasing  `in` and the outputs must not overlap; `in` is left as it is
 *   threads   one state per thread; states share nothing
 *   memory    the caller brings it (any alignment) and leaves it where it is, for the state points into
 *             itself; nothing allocates, ever, and nothing prints
 *   memory of the past   none: each frame stands alone, so there is nothing to reset
 * Every function that can fail returns a negative locagen_error; locagen_strerror says it in words.
 */
#ifndef LOCAGEN_H
#define LOCAGEN_H
#include <stddef.h>
#include <stdint.h>
#ifdef __cplusplus
extern "C" {
#endif
/* [python] What stands from here to the closing mark is what Python sees. */

enum locagen_error {
    LOCAGEN_OK = 0,
    LOCAGEN_E_MICS = -1,  /* microphones: 2 to 8 */
    LOCAGEN_E_FRAME = -2, /* frame: a power of two, 256 to 4096 */
    LOCAGEN_E_RATE = -3,  /* sample rate: finite and above zero */
    LOCAGEN_E_BAND = -4,  /* band: 0 < low < high < rate / 2, at least eight bins */
    LOCAGEN_E_LAGS = -5,  /* grid: oversample 1 to 64, lags at least 1, longest lag under frame / 4 */
    LOCAGEN_E_FLOOR = -6, /* floors: 0 or more, and below 1 */
    LOCAGEN_E_NULL = -7   /* a pointer is null */
};

typedef struct {
    int32_t mics;
    int32_t frame;         /* samples per microphone and frame */
    int32_t lags;          /* grid points each side of zero: 2 * lags + 1 values per pair */
    int32_t oversample;    /* grid points per sample: lag l stands for l / oversample samples */
    float rate_hz;
    float band_low_hz;     /* bins outside [low, high] count for nothing */
    float band_high_hz;
    float floor;           /* power of one bin, as mean square of full scale, below which it fades to zero */
    float relative_floor;  /* the same, as a share of the microphone's mean bin power in the band */
} locagen_gcc_config;

typedef struct locagen_gcc locagen_gcc;

/* Bytes of state for this configuration, or 0 where locagen_gcc_init would refuse it. */
size_t locagen_gcc_sizeof(const locagen_gcc_config *config);

/* Sets up a state in `memory` of locagen_gcc_sizeof bytes. */
int locagen_gcc_init(locagen_gcc *memory, const locagen_gcc_config *config);

/* One frame. correlation: pairs * (2 * lags + 1). power: mean square of each microphone in the
 * band, corrected for the window: a full-scale sine gives 0.5. Returns 0, or a positive mask with bit
 * m set where microphone m held a sample that is not finite, or so large (about 1e18) that its power
 * overflows: such a microphone counts as silent, its power is 0. */
int locagen_gcc_process(locagen_gcc *state, const float *in, float *correlation, float *power);

/* A sentence for an error code, in static memory. */
const char *locagen_strerror(int code);

/* [/python] */
#ifdef __cplusplus
}
#endif
#endif
