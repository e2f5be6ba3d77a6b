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

enum {
    LINE = 64,           /* bytes of a cache line */
    MOST_DECIMATION = 64 /* beyond it nothing is left to save */
};

typedef struct {
    char *base; /* null: only count */
    size_t used;
} arena;

static float *take(arena *a, size_t floats)
{
    float *at = a->base ? (float *)(void *)(a->base + a->used) : NULL;
    a->used += (floats * sizeof(float) + LINE - 1) / LINE * LINE;
    return at;
}

static state *aligned(const void *memory)
{
    return (state *)(((uintptr_t)memory + LINE - 1) & ~(uintptr_t)(LINE - 1));
}

static int in_unit_interval(float x)
{
    return x >= 0.0f && x < 1.0f;
}

static int check(const locagen_gcc_config *c)
{
    if (c == NULL)
        return LOCAGEN_E_NULL;
    if (c->mics < 2 || c->mics > 8)
        return LOCAGEN_E_MICS;
    if (c->frame < 256 || c->frame > 4096 || (c->frame & (c->frame - 1)) != 0)
        return LOCAGEN_E_FRAME;
    if (!(c->rate_hz > 0.0f && c->rate_hz <= FLT_MAX))
        return LOCAGEN_E_RATE;
    if (!(c->band_low_hz > 0.0f && c->band_low_hz < c->band_high_hz && c->band_high_hz < c->rate_hz / 2))
        return LOCAGEN_E_BAND;
    double bins_per_hz = c->frame / (double)c->rate_hz;
    if (floor(c->band_high_hz * bins_per_hz) - ceil(c->band_low_hz * bins_per_hz) + 1 < 8)
        return LOCAGEN_E_BAND;
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
        if (i == j || i >= s->mics || j >= s->mics)
            continue;
        int row = i < j ? pair_row(s->mics, i, j) : pair_row(s->mics, j, i);
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
    for (int group = 0; group < s->groups; group++) {
        if (s->mics - 4 * group < 4) {
            add_product(s, group, group, TURN_RING3, &held);
        } else {
            add_product(s, group, group, TURN_1, &held);
            add_product(s, group, group, TURN_2, &held);
        }
    }
    for (enum turn turn = TURN_0; s->groups == 2 && turn <= TURN_3; turn++)
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
static void lay_out(state *s, const locagen_gcc_config *c, arena *a)
{
    double bins_per_hz = c->frame / (double)c->rate_hz;
    int points = c->frame / 2;
    memset(s, 0, sizeof *s);
    s->mics = c->mics;
    s->groups = (c->mics + 3) / 4;
    s->samples = c->frame;
    s->lags = c->lags;
    s->floor = c->floor;
    s->relative_floor = c->relative_floor;
    s->first_bin = (int32_t)ceil(c->band_low_hz * bins_per_hz);
    s->last_bin = (int32_t)floor(c->band_high_hz * bins_per_hz);
    s->bin_share = 1.0f / (float)(s->last_bin - s->first_bin + 1);
    int mirror_first = points - s->last_bin, mirror_last = points - s->first_bin;
    s->part_low = (s->first_bin < mirror_first ? s->first_bin : mirror_first) & ~1;
    s->part_high = s->last_bin < mirror_last ? s->last_bin : mirror_last;
    if (s->part_high > points / 2)
        s->part_high = points / 2;
    choose_products(s);

    s->decimation = choose_decimation(c);
    s->coarse = s->decimation == 1 ? (s->last_bin | 1) - (s->first_bin & ~1) + 1
                                   : s->last_bin / s->decimation - s->first_bin / s->decimation + TAPS;
    s->half = s->lags < BLOCK_HALF ? s->lags : BLOCK_HALF;
    s->blocks = 2 * ((s->lags + BLOCK_HALF) / (2 * BLOCK_HALF + 1)) + 1;
    s->table_lags = (s->half + 16) / 16 * 16;

    size_t quads = 4 * (size_t)(points + 2);
    s->work_re = take(a, quads), s->work_im = take(a, quads);
    for (int group = 0; group < s->groups; group++)
        s->bins_re[group] = take(a, quads), s->bins_im[group] = take(a, quads);
    s->weights = take(a, 4 * TAPS * (size_t)s->decimation);
    s->coarse_re = take(a, 4 * (size_t)s->coarse), s->coarse_im = take(a, 4 * (size_t)s->coarse);
    s->table = take(a, 2 * (size_t)s->coarse * (size_t)s->table_lags);
    s->start = take(a, 2 * (size_t)s->coarse), s->step = take(a, 2 * (size_t)s->coarse);
    s->gain = take(a, 2 * (size_t)s->lags + 1);
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
    double frame = s->samples, decimation = s->decimation;
    double bins = s->last_bin - s->first_bin + 1;
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
        double bin = (s->first_bin & ~1) + c;
        if (s->decimation > 1)
            bin = (s->first_bin / s->decimation - (TAPS / 2 - 1) + c) * s->decimation - 0.5;
        double turns = bin / ((double)s->samples * oversample);
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
    arena count = {NULL, 0};
    take(&count, sizeof s / sizeof(float) + 1);
    lay_out(&s, config, &count);
    take(&count, locagen_fft_floats(config->frame));
    return count.used + LINE - 1;
}

int locagen_gcc_init(locagen_gcc *memory, const locagen_gcc_config *config)
{
    int error = memory == NULL ? LOCAGEN_E_NULL : check(config);
    if (error != LOCAGEN_OK)
        return error;
    memset(memory, 0, locagen_gcc_sizeof(config));
    state *s = aligned(memory);
    arena room = {(char *)s, 0};
    take(&room, sizeof *s / sizeof(float) + 1);
    lay_out(s, config, &room);

    /* With this gain the squared magnitude of a bin is its power: 2 / (N sum(w^2)) |X|^2, where the squares
     * of Hann's window add up to 3 N / 8, and a half goes to the parting of the real bins. */
    double gain = 0.5 * sqrt(2 / (config->frame * (0.375 * config->frame)));
    locagen_fft_init(&s->fft, config->frame, gain, take(&room, locagen_fft_floats(config->frame)));
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
    const state *s = aligned(memory);
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
    default:
        return "unknown error";
    }
}
