/* locagen.h - the whole C API of the acoustic kernel: from a card's rate to the processing rate, and two ways
 * from a frame to where its sound comes from.
 *
 * locagen_gcc: GCC-PHAT (Knapp & Carter 1976, "The generalized correlation method for estimation of time
 * delay") of all microphone pairs of one frame: window, real FFT, whitening, and only those lags
 * that the array's geometry allows, on a sub-sample grid.
 *
 * locagen_steer: maximum likelihood over directions, with cross-spectra averaged over frames and whitened by
 * the noise's own matrix. For each bin k: the microphones' bins x (M of them), R_x their averaged
 * cross-spectra x x^H, R_n those of the noise, a(u) the phases of a plane wave from direction u. The score of
 * a direction is
 *     T sum_k g(q_k),  g(q) = q - 1 - log q for q > 1, else 0,
 *     q_k = a^H R_n^-1 R_x R_n^-1 a / (a^H R_n^-1 a), averaged over smooth_bins bins each side
 * - the generalised likelihood ratio of "one source of unknown spectrum, and noise" against "noise only", T
 * the number of independent looks that R_x holds. The slope of g, 1 - 1/q, is the maximum-likelihood weight of
 * Hannan & Thomson 1973, "Estimating group delay", and Knapp & Carter 1976. As a bearing estimator: Jaffer
 * 1988, "Maximum likelihood direction finding of stochastic sources"; Krim & Viberg 1996, "Two decades of
 * array signal processing research". A tapered window makes T less than the number of frames by
 * sum(w^2)^2 / (N sum(w^4)) (0.95 at taper 0.1, 0.51 for Hann), overlapping frames make it less again: so the
 * score's own curvature is the information on the direction, without another factor.
 *
 * locagen_resample: a polyphase FIR filter (Crochiere & Rabiner 1983, Multirate Digital Signal Processing,
 * section 3.3), without a state and without blocks: each sample can be had as soon as what it is made of is there.
 *
 * Conventions, the same words as in Python:
 *   layout    float32, full scale 1.0, microphone by microphone: in[m * frame + n]
 *   pairs     (i, j) with i < j, in the order (0,1) (0,2) .. (0,M-1) (1,2) ..
 *   sign      a peak at a positive lag means that microphone j hears later than i: tau = t_j - t_i
 *   axes      FRD: x forward, y right, z down. Azimuth atan2(y, x), elevation positive up, of the unit
 *             vector u from the array to the source; microphone m hears p_m . u / c before the origin does
 *   whitening (gcc) each bin X of power p becomes X / sqrt(p + f), f the larger of floor and relative_floor
 *             times the microphone's mean bin power in the band: silence gives zeros, and bins that are
 *             empty of the source are not blown up to its size
 *   scaling   (gcc) mean over the band's bins: a pair coherent over the whole band, without noise, has a peak
 *             of 1.0, less what the floor takes
 *   accuracy  (gcc) 1e-4 of the peak, (steer) 1e-3 of the score against the same in double precision
 *   aliasing  `in` and the outputs must not overlap; `in` is left as it is
 *   threads   one state per thread; states share nothing
 *   memory    the caller brings it (any alignment) and leaves it where it is, for the state points into
 *             itself; nothing allocates, ever, and nothing prints
 *   memory of the past   (gcc) none: each frame stands alone, so there is nothing to reset; (steer) R_x and
 *             R_n, until locagen_steer_reset
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
    LOCAGEN_E_MICS = -1,    /* microphones: 2 to 8 */
    LOCAGEN_E_FRAME = -2,   /* frame: a power of two, 256 to 4096 */
    LOCAGEN_E_RATE = -3,    /* sample rate: finite and above zero */
    LOCAGEN_E_BAND = -4,    /* band: 0 < low < high < rate / 2, at least eight bins */
    LOCAGEN_E_LAGS = -5,    /* grid: oversample 1 to 64, lags at least 1, longest lag under frame / 4 */
    LOCAGEN_E_FLOOR = -6,   /* floors: 0 or more, and below 1 */
    LOCAGEN_E_NULL = -7,    /* a pointer is null */
    LOCAGEN_E_HOP = -8,     /* hop: 0, or frame / 8 and more */
    LOCAGEN_E_TAPER = -9,   /* taper: 0 to 1 */
    LOCAGEN_E_SMOOTH = -10, /* smooth_bins: 0 to 64 */
    LOCAGEN_E_NOISE = -11,  /* loading 1e-5 to 1, floor 1e-15 to 1, smear 0 to 1 */
    LOCAGEN_E_ARRAY = -12,  /* positions within 10 m, two of them 1 mm apart; speed of sound 100 to 2000 m/s */
    LOCAGEN_E_GRID = -13,   /* grid: azimuths 8 to 720, elevations 2 to 180 */
    LOCAGEN_E_SHARE = -14,  /* share: 0 to 1 */
    LOCAGEN_E_COUNT = -15,  /* sources: at least 1 */
    LOCAGEN_E_SPAN = -16,   /* spans: 1 to 4, counted from 0 */
    LOCAGEN_E_LAG = -17,    /* lag: 0 to 64 hops */
    LOCAGEN_E_WEIGHT = -18, /* weights: 0 to 1 */
    LOCAGEN_E_LEAST = -19,  /* least score: 0 or more */
    LOCAGEN_E_RESAMPLE = -20 /* taps: a multiple of LOCAGEN_TAPS; nothing below zero, and samples enough */
};

enum { LOCAGEN_TAPS = 16 };

/* Sample n of `count` of each microphone: the sum over j of table[phase * taps + j] * in[m * samples + start + j],
 * start and phase being quotient and remainder of (at + n * down) / up. table: [up][taps]. in: [mics][samples].
 * out: [count][mics]. Each sample is added up in the same order, however a stream is cut. */
int locagen_resample(const float *table, int32_t taps, int32_t up, int32_t down, int32_t at, const float *in,
                     int32_t mics, int32_t samples, float *out, int32_t count);

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

/* One frame. correlation: pairs * (2 * lags + 1). levels: 2 * mics values; the mean square of each microphone in
 * the band, corrected for the window (a full-scale sine gives 0.5), then the share of the band that each fills:
 * the mean of p / (p + f), which is what a coherent pair's peak can reach. Returns 0, or a positive mask with bit
 * m set where microphone m held a sample that is not finite, or so large (about 1e18) that its power
 * overflows: such a microphone counts as silent, its power is 0. */
int locagen_gcc_process(locagen_gcc *state, const float *in, float *correlation, float *levels);

typedef struct {
    int32_t mics;
    int32_t frame;         /* samples per microphone and frame */
    int32_t hop;           /* samples from frame to frame, 0: no overlap; only to count what frames are worth */
    int32_t spans;         /* averages R_x side by side, each with a memory of its own: 1 to 4 */
    int32_t lag;           /* learn can take a frame of so many listens ago: a call is known only after a while */
    int32_t smooth_bins;   /* bins each side over which q is averaged: the source's spectrum is smooth there */
    int32_t azimuths;      /* coarse grid: azimuths of the full circle, the first at 0 */
    int32_t elevations;    /* rows, at half steps: over the lower half for a flat array, else the whole sphere */
    float rate_hz;
    float band_low_hz;     /* bins outside [low, high] count for nothing */
    float band_high_hz;
    float taper;           /* share of the window that is tapered (Tukey's): 0 rectangle, 1 Hann */
    float loading;         /* added to R_n's diagonal, as a share of its mean diagonal */
    float smear;           /* share of R_n, averaged over 100 Hz each side, that is added to it: tones wander */
    float floor;           /* the same as power of one bin, mean square of full scale: silence stays finite */
    float speed_m_s;       /* of sound */
    float positions_m[24]; /* FRD, x y z of each microphone in turn; what follows the last one is not read */
} locagen_steer_config;

/* score: log of the likelihood ratio against "noise only", for a further source against "noise and the
 * sources before it". Noise alone gives some tens at 451 bins.
 *
 * contrast: the same for the strongest source against "all of the noise has become louder": below 0 where
 * rotors rise, wind or a touch of the microphones is the better reason.
 *
 * rival: of the strongest source, score of the best direction in another lobe over its own: near 1 where a narrow
 * sound has several answers, for microphones farther apart than half of its wavelength.
 *
 * snr: per microphone, power ratio: (mean q - 1) / microphones, 0 or more. Under coloured noise: that of white
 * noise in which the source would be as well seen.
 *
 * information: minus the score's second derivatives xx, xy, yy in 1 / rad^2, along two arcs on the sphere: x
 * towards greater azimuth (x = azimuth cos(elevation)), y towards greater elevation. Its inverse is the
 * covariance. yy goes to 0 in the plane of a flat array, and the matrix is singular everywhere where all
 * microphones stand in a line. */
typedef struct {
    float azimuth_rad;   /* -pi to pi */
    float elevation_rad; /* positive up; of two images that a flat array cannot tell apart the lower one */
    float score;
    float contrast;
    float rival;
    float snr;
    float information[3];
} locagen_source;

typedef struct locagen_steer locagen_steer;

/* Bytes of state for this configuration, or 0 where locagen_steer_init would refuse it. */
size_t locagen_steer_sizeof(const locagen_steer_config *config);

/* Sets up a state in `memory` of locagen_steer_sizeof bytes. */
int locagen_steer_init(locagen_steer *memory, const locagen_steer_config *config);

/* Forgets R_n, R_x and the frame's bins. */
int locagen_steer_reset(locagen_steer *state);

/* One frame: window, FFT; keeps its bins. power: mean square of each microphone in the band, as of
 * locagen_gcc_process. Returns 0, or a positive mask with bit m set where microphone m held a sample that is
 * not finite, or a power of 1e8 and more: its power is 0. Such a microphone, and one that is 50 dB and more
 * under the loudest (dead: no two microphones of one array differ so much), is left out of learn and hear;
 * one that was left out of more than a tenth of R_n or R_x is left out of the search; where those that are left
 * stand in a line, and all of them do not, there is none. */
int locagen_steer_listen(locagen_steer *state, const float *in, float *power);

/* R_n <- (1 - share) R_n + share x x^H with the bins of the frame `ago` before the last (0: the last; at most
 * `lag`), while nothing calls; nothing where so many have not been. The start is corrected for: after the first
 * call R_n is x x^H, whatever the share. */
int locagen_steer_learn(locagen_steer *state, int32_t ago, float share);

/* The same for the R_x of one span, with the last frame. share 1: this frame alone. */
int locagen_steer_hear(locagen_steer *state, int32_t span, float share);

/* Looks for up to `most` sources in R_x, strongest first; each is nulled (in whitened space) before the next
 * is looked for, and at last the directions of those that are clearly more than noise are refined, each with
 * the others nulled. Returns how many `out` holds: none before hear, in silence or with less than two
 * microphones; at most one less than there are microphones; none that scores `least` or less, and where
 * nothing does on the grid nothing is refined, which saves half of the time. With `further` above 0 a further
 * source has to score more than that, and more than what a null may leave of the first. A state that never learnt
 * takes the noise for white, and its level from what R_x holds across its best direction (M - 1 of M
 * dimensions). */
int locagen_steer_search(locagen_steer *state, int32_t span, int32_t most, float least, float further,
                         locagen_source *out);

/* Puts aside how far q strayed from 1 in the last search, in each direction of the grid and each part of the
 * band; while nothing calls. */
int locagen_steer_watch(locagen_steer *state, int32_t span);

/* Now and then, say every half second, while nothing calls: keeps in mind what was put aside before the last
 * settle, with this share of each search; by now a call that began then would be known as one. What is kept in mind
 * lessens T in each direction and part of the band to 1 / (E (q - 1)^2 * bins averaged), which is T itself where
 * the noise keeps still. So a score means the same under rotors that hum and under rotors that hunt: a constant
 * false-alarm rate. Which direction is best, its information and its rival are told with nearly all looks of what
 * stands far above anything that the noise has reached. */
int locagen_steer_settle(locagen_steer *state, int32_t span, float share);

/* Instead of watch, while something calls: what was put aside is dropped. */
int locagen_steer_doubt(locagen_steer *state, int32_t span);

/* Weights 0 to 1 of all bins, for the searches to come: each bin counts as so many looks less. */
int locagen_steer_weigh(locagen_steer *state, const float *weight);

/* Wiener's gain of each bin, 1 - noise / power and 0 or more (Wiener, Extrapolation, Interpolation, and Smoothing of
 * Stationary Time Series, 1949, chapter 3), from the diagonals of the span's R_x and of R_n: power over noise is a mean
 * over the microphones of both and over smooth_bins bins each side. 1 where nothing was heard or learnt. */
int locagen_steer_gain(locagen_steer *state, int32_t span, float *gain);

/* Bins in the band, and the number of the first. */
int locagen_steer_bin_count(const locagen_steer *state);
int locagen_steer_first_bin(const locagen_steer *state);

/* For tests and other stages. bins: complex (re, im) [mics][bins], |x|^2 the bin's power. noise: complex
 * [bins][mics][mics], R_n without smear, loading and floor, zeros where nothing was learnt. map: scores
 * [elevations][azimuths] on the coarse grid, for which bins are added up by the few (see steering.c), of the
 * span's last search, with its axes in radians. */
int locagen_steer_bins(const locagen_steer *state, float *bins);
int locagen_steer_noise(const locagen_steer *state, float *noise);
int locagen_steer_axes(const locagen_steer *state, float *elevation, float *azimuth);
int locagen_steer_map(const locagen_steer *state, int32_t span, float *map);

/* A sentence for an error code, in static memory. */
const char *locagen_strerror(int code);

/* [/python] */
#ifdef __cplusplus
}
#endif
#endif
