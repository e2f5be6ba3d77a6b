/* gcc_phat.c - set-up of the kernel: checks the configuration, lays out the memory, fills the tables.
 *
 * Goal: GCC-PHAT at the few lags that an array's geometry allows, on a fine grid, for less than an
 * inverse FFT of the frame's own length would take. A frame of N samples whose lags all lie within
 * +-L has a correlation that is smooth in frequency, so its bins may be thinned out D to 1 behind an
 * anti-aliasing window (the gridding step of the non-uniform FFT: Fessler & Sutton 2003, "Nonuniform fast
 * Fourier transforms using min-max interpolation"): each bin is spread over six coarse bins with the
 * weights of a Kaiser-Bessel window. The correlation comes out multiplied by the window's transform,
 * which is known and divided out; its images, N / D lags apart, come out multiplied by the window's side
 * lobes, which are small there. With N = 1024 and L = 4, 451 bins become 20, and a short table of cosines
 * makes the lags from them.
 */
#include "gcc_phat.h"

#include <float.h>
#include <math.h>
#include <string.h>

static const double PI = 3.14159265358979323846;

/* The least N / (2 L D). An image as strong as the peak itself then leaves 3e-6 of it (computed over all
 * lags and places of a bin); at 2 it would leave 4e-5, too much where an echo outside the lags is the
 * stronger one. With four taps instead of six it would be 4e-4. */
static const double LEAST_OVERSAMPLING = 3.9;

enum { MOST_DECIMATION = 64 }; /* beyond it nothing is left to save */

static int in_unit_interval(float x)
{
    return x >= 0.0f && x < 1.0f;
}

static int check(const locagen_gcc_config *c)
{
    if (c == NULL)
        return LOCAGEN_E_NULL;
    int error = locagen_spectrum_check(c->mics, c->frame, c->rate_hz, c->band_low_hz, c->band_high_hz);
    if (error != LOCAGEN_OK)
        return error;
    if (c->oversample < 1 || c->oversample > 64 || c->lags < 1 || c->lags >= c->frame / 4 * c->oversample)
        return LOCAGEN_E_LAGS;
    if (!in_unit_interval(c->floor) || !in_unit_interval(c->relative_floor))
        return LOCAGEN_E_FLOOR;
    return LOCAGEN_OK;
}

static const int TURN[TURNS][4] = {
    [TURN_RING3] = {1, 2, 0, 3}, [TURN_0] = {0, 1, 2, 3}, [TURN_1] = {1, 2, 3, 0},
    [TURN_2] = {2, 3, 0, 1},     [TURN_3] = {3, 0, 1, 2},
};

static int pair_row(int mics, int i, int j)
{
    return i * (2 * mics - i - 1) / 2 + j - i - 1;
}

/* Adds a product if it holds a pair that no product before it held. */
static void add_product(state *s, int group_i, int group_j, enum turn turn, uint32_t *held)
{
    locagen_product p = {.group_i = group_i, .group_j = group_j, .turn = turn};
    for (int lane = 0; lane < 4; lane++) {
        int i = 4 * group_i + lane, j = 4 * group_j + TURN[turn][lane];
        p.direction[lane] = i < j ? 1.0f : -1.0f;
        if (i == j || i >= s->spectrum.mics || j >= s->spectrum.mics)
            continue;
        int row = i < j ? pair_row(s->spectrum.mics, i, j) : pair_row(s->spectrum.mics, j, i);
        if (*held >> row & 1)
            continue;
        *held |= UINT32_C(1) << row;
        p.lane[p.pairs] = lane;
        p.row[p.pairs++] = row;
    }
    if (p.pairs > 0)
        s->product[s->products++] = p;
}

static void choose_products(state *s)
{
    uint32_t held = 0;
    for (int group = 0; group < s->spectrum.groups; group++) {
        if (s->spectrum.mics - 4 * group < 4) {
            add_product(s, group, group, TURN_RING3, &held);
        } else {
            add_product(s, group, group, TURN_1, &held);
            add_product(s, group, group, TURN_2, &held);
        }
    }
    for (enum turn turn = TURN_0; s->spectrum.groups == 2 && turn <= TURN_3; turn++)
        add_product(s, 0, 1, turn, &held);
}

static int choose_decimation(const locagen_gcc_config *c)
{
    double span = 2.0 * c->lags / c->oversample;
    int decimation = 1;
    while (decimation < MOST_DECIMATION && c->frame / (span * decimation * 2) >= LEAST_OVERSAMPLING)
        decimation *= 2;
    return decimation;
}

/* Everything but the tables' contents; with a null base only the arena's count is meant. */
static void lay_out(state *s, const locagen_gcc_config *c, locagen_arena *a)
{
    memset(s, 0, sizeof *s);
    locagen_spectrum_lay_out(&s->spectrum, c->mics, c->frame, c->rate_hz, c->band_low_hz, c->band_high_hz, a);
    s->lags = c->lags;
    s->floor = c->floor;
    s->relative_floor = c->relative_floor;
    s->bin_share = 1.0f / (float)(s->spectrum.last_bin - s->spectrum.first_bin + 1);
    choose_products(s);

    s->decimation = choose_decimation(c);
    int first = s->spectrum.first_bin, last = s->spectrum.last_bin;
    s->coarse = s->decimation == 1 ? (last | 1) - (first & ~1) + 1
                                   : last / s->decimation - first / s->decimation + TAPS;
    s->half = s->lags < BLOCK_HALF ? s->lags : BLOCK_HALF;
    s->blocks = 2 * ((s->lags + BLOCK_HALF) / (2 * BLOCK_HALF + 1)) + 1;
    s->table_lags = (s->half + 16) / 16 * 16;

    s->weights = locagen_take(a, 4 * TAPS * (size_t)s->decimation);
    s->coarse_re = locagen_take(a, 4 * (size_t)s->coarse);
    s->coarse_im = locagen_take(a, 4 * (size_t)s->coarse);
    s->table = locagen_take(a, 2 * (size_t)s->coarse * (size_t)s->table_lags);
    s->start = locagen_take(a, 2 * (size_t)s->coarse), s->step = locagen_take(a, 2 * (size_t)s->coarse);
    s->gain = locagen_take(a, 2 * (size_t)s->lags + 1);
}

/* Modified Bessel function I0, by its power series: exact to double precision for the x < 19 used here. */
static double bessel_i0(double x)
{
    double sum = 1, term = 1;
    for (int k = 1; term > 1e-17 * sum; k++) {
        term *= x * x / (4.0 * k * k);
        sum += term;
    }
    return sum;
}

static void fill_spreading(state *s, double span)
{
    double frame = s->spectrum.samples, decimation = s->decimation;
    double bins = s->spectrum.last_bin - s->spectrum.first_bin + 1;
    double shape = TAPS * PI * (1 - span / 2 * decimation / frame);
    for (int tap = 0; tap < TAPS; tap++)
        for (int f = 0; f < s->decimation; f++) {
            double u = (f + 0.5) / decimation + TAPS / 2 - 1 - tap;
            double weight = bessel_i0(shape * sqrt(1 - 4 * u * u / (TAPS * TAPS))) / bessel_i0(shape);
            for (int i = 0; i < 4; i++)
                s->weights[4 * (tap * s->decimation + f) + i] = (float)weight;
        }
    for (int l = -s->lags; l <= s->lags; l++) {
        double lag = span / 2 * l / s->lags;
        double root = shape * shape - pow(TAPS * PI * lag * decimation / frame, 2);
        double window = TAPS * sinh(sqrt(root)) / sqrt(root) / bessel_i0(shape);
        s->gain[l + s->lags] = (float)(1 / (bins * (s->decimation == 1 ? 1 : window)));
    }
}

static void put_phasor(float *re, float *im, double turns)
{
    *re = (float)cos(2 * PI * turns);
    *im = (float)sin(2 * PI * turns);
}

static void fill_synthesis(state *s, int oversample)
{
    int block_lags = 2 * BLOCK_HALF + 1;
    for (int c = 0; c < s->coarse; c++) {
        /* Coarse bins lie half a bin below their block, so that no bin falls on the window's edge. */
        double bin = (s->spectrum.first_bin & ~1) + c;
        if (s->decimation > 1)
            bin = (s->spectrum.first_bin / s->decimation - (TAPS / 2 - 1) + c) * s->decimation - 0.5;
        double turns = bin / ((double)s->spectrum.samples * oversample);
        float *row = s->table + 2 * (size_t)c * (size_t)s->table_lags;
        for (int l = 0; l < s->table_lags; l++)
            put_phasor(&row[l], &row[s->table_lags + l], turns * l);
        put_phasor(&s->start[2 * c], &s->start[2 * c + 1], -turns * (s->blocks / 2) * block_lags);
        put_phasor(&s->step[2 * c], &s->step[2 * c + 1], turns * block_lags);
    }
}

size_t locagen_gcc_sizeof(const locagen_gcc_config *config)
{
    if (check(config) != LOCAGEN_OK)
        return 0;
    state s;
    locagen_arena count = {NULL, 0};
    locagen_take(&count, sizeof s / sizeof(float) + 1);
    lay_out(&s, config, &count);
    return count.used + LOCAGEN_LINE - 1;
}

int locagen_gcc_init(locagen_gcc *memory, const locagen_gcc_config *config)
{
    int error = memory == NULL ? LOCAGEN_E_NULL : check(config);
    if (error != LOCAGEN_OK)
        return error;
    memset(memory, 0, locagen_gcc_sizeof(config));
    state *s = locagen_aligned(memory);
    locagen_arena room = {(char *)s, 0};
    locagen_take(&room, sizeof *s / sizeof(float) + 1);
    lay_out(s, config, &room);

    locagen_spectrum_init(&s->spectrum, 1.0); /* Hann */
    fill_spreading(s, 2.0 * config->lags / config->oversample);
    fill_synthesis(s, config->oversample);

    s->frame = locagen_frame_quad;
#if defined(__x86_64__)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
        s->frame = locagen_frame_avx2;
#endif
    return LOCAGEN_OK;
}

int locagen_gcc_process(locagen_gcc *memory, const float *in, float *correlation, float *power)
{
    if (memory == NULL || in == NULL || correlation == NULL || power == NULL)
        return LOCAGEN_E_NULL;
    const state *s = locagen_aligned(memory);
    return s->frame(s, in, correlation, power);
}

const char *locagen_strerror(int code)
{
    if (code >= 0)
        return "no error";
    switch (code) {
    case LOCAGEN_E_MICS:
        return "microphones: must be 2 to 8";
    case LOCAGEN_E_FRAME:
        return "frame: must be a power of two, 256 to 4096 samples";
    case LOCAGEN_E_RATE:
        return "sample rate: must be finite and above zero";
    case LOCAGEN_E_BAND:
        return "band: must be 0 < low < high < rate / 2 and hold at least eight bins of the frame";
    case LOCAGEN_E_LAGS:
        return "lags: oversample must be 1 to 64, lags at least 1, longest lag below frame / 4";
    case LOCAGEN_E_FLOOR:
        return "floors: must be at least 0 and below 1";
    case LOCAGEN_E_NULL:
        return "a pointer is null";
    case LOCAGEN_E_HOP:
        return "hop: must be 0 (frames that do not overlap) or at least an eighth of the frame";
    case LOCAGEN_E_TAPER:
        return "taper: must be 0 to 1";
    case LOCAGEN_E_SMOOTH:
        return "smooth_bins: must be 0 to 64";
    case LOCAGEN_E_NOISE:
        return "noise: loading must be 1e-5 to 1, floor 1e-15 to 1";
    case LOCAGEN_E_ARRAY:
        return "array: positions must lie within 10 m, not all in one place; speed of sound 100 to 2000 m/s";
    case LOCAGEN_E_GRID:
        return "grid: must have 8 to 720 azimuths and 2 to 180 elevations";
    case LOCAGEN_E_SHARE:
        return "share: must be 0 to 1";
    case LOCAGEN_E_SPAN:
        return "spans: 1 to 4 of them, counted from 0";
    case LOCAGEN_E_LAG:
        return "lag: 0 to 64 hops are needed";
    case LOCAGEN_E_WEIGHT:
        return "weights: 0 to 1 are needed";
    case LOCAGEN_E_LEAST:
        return "least score: 0 or more is needed";
    case LOCAGEN_E_RESAMPLE:
        return "resampling: taps must be a multiple of 16, nothing below zero, and samples enough";
    case LOCAGEN_E_COUNT:
        return "sources: at least one must be asked for";
    default:
        return "unknown error";
    }
}
