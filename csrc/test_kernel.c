/* test_kernel.c - the kernel's laws in C, for the sanitizers and for CPUs without Python.
 *
 * Needs nothing but libm. Every configuration runs in memory of exactly the size asked for, at an odd
 * address, its outputs exactly sized too, and once for each vector width that this CPU has; the narrow
 * one is what flies. Prints what failed and one line at the end.
 */
#include "gcc_phat.h"
#include "steering.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int passed, failed;

#define CHECK(condition, ...)                                                                                \
    do {                                                                                                     \
        if (condition) {                                                                                     \
            passed++;                                                                                        \
        } else {                                                                                             \
            failed++;                                                                                        \
            printf("%s:%d: %s: ", __FILE__, __LINE__, #condition);                                           \
            printf(__VA_ARGS__);                                                                             \
            printf("\n");                                                                                    \
        }                                                                                                    \
    } while (0)

typedef int (*path)(const state *, const float *, float *, float *);

static path paths[2] = {locagen_frame_quad};
static int path_count = 1;

static const locagen_steer_paths *steer_paths[2] = {&locagen_steer_quad};

static const locagen_gcc_config TRIANGLE = {
    .mics = 3, .frame = 1024, .lags = 63, .oversample = 16, .rate_hz = 10000.0f, .band_low_hz = 300.0f,
    .band_high_hz = 4700.0f, .floor = 1e-12f, .relative_floor = 1e-3f,
};

/* xorshift (Marsaglia 2003): the same numbers everywhere. Uniform, -0.5 to 0.5. */
static uint32_t seed = 1;
static float uniform(void)
{
    seed ^= seed << 13;
    seed ^= seed >> 17;
    seed ^= seed << 5;
    return (float)(seed >> 8) / 16777216.0f - 0.5f;
}

static void *allocate(size_t bytes)
{
    void *p = malloc(bytes);
    if (p == NULL) {
        printf("out of memory\n");
        exit(2);
    }
    return p;
}

/* A kernel with everything around it, each block its own: a sanitizer sees one byte too far. */
typedef struct {
    locagen_gcc_config config;
    char *memory;
    locagen_gcc *kernel;
    int pairs, columns;
    float *in, *correlation, *power;
} bench;

static bench set_up(locagen_gcc_config config, path chosen)
{
    enum { MISALIGNED = 3 };
    bench b = {.config = config, .columns = 2 * config.lags + 1};
    b.pairs = config.mics * (config.mics - 1) / 2;
    size_t bytes = locagen_gcc_sizeof(&config);
    b.memory = allocate(bytes + MISALIGNED);
    memset(b.memory, 0xA5, bytes + MISALIGNED);
    b.kernel = (locagen_gcc *)(b.memory + MISALIGNED);
    int code = locagen_gcc_init(b.kernel, &config);
    CHECK(code == 0, "init gave %d", code);
    CHECK(memcmp(b.memory, "\xA5\xA5\xA5", MISALIGNED) == 0, "init wrote before its memory");
    ((state *)(((uintptr_t)b.kernel + 63) & ~(uintptr_t)63))->frame = chosen;
    b.in = allocate(sizeof(float) * (size_t)(config.mics * config.frame));
    b.correlation = allocate(sizeof(float) * (size_t)(b.pairs * b.columns));
    b.power = allocate(2 * sizeof(float) * (size_t)config.mics);
    for (int n = 0; n < config.mics * config.frame; n++)
        b.in[n] = uniform();
    return b;
}

static void tear_down(bench *b)
{
    free(b->memory);
    free(b->in);
    free(b->correlation);
    free(b->power);
}

static int run(bench *b)
{
    for (int n = 0; n < b->pairs * b->columns; n++)
        b->correlation[n] = NAN;
    for (int m = 0; m < 2 * b->config.mics; m++)
        b->power[m] = NAN;
    return locagen_gcc_process(b->kernel, b->in, b->correlation, b->power);
}

/* The definition, in double and without an FFT. Returns the largest error as a share of its pair's peak. */
static double error_of(const bench *b)
{
    const locagen_gcc_config *c = &b->config;
    const double two_pi = 6.283185307179586;
    int first = (int)ceil(c->band_low_hz * (double)c->frame / c->rate_hz);
    int last = (int)floor(c->band_high_hz * (double)c->frame / c->rate_hz);
    int bins = last - first + 1;
    double *re = allocate(sizeof(double) * (size_t)(c->mics * bins));
    double *im = allocate(sizeof(double) * (size_t)(c->mics * bins));
    double *turn = allocate(sizeof(double) * (size_t)c->frame);
    double worst = 0;
    for (int n = 0; n < c->frame; n++)
        turn[n] = cos(two_pi * n / c->frame);
    for (int m = 0; m < c->mics; m++) {
        double power = 0;
        for (int k = 0; k < bins; k++) {
            double r = 0, i = 0;
            for (int n = 0; n < c->frame; n++) {
                int at = (int)((long)(first + k) * n % c->frame);
                double x = b->in[m * c->frame + n] * (0.5 - 0.5 * turn[n]);
                r += x * turn[at];
                i -= x * turn[(at + 3 * c->frame / 4) % c->frame];
            }
            double gain = sqrt(2 / (0.375 * c->frame * c->frame));
            re[m * bins + k] = r * gain, im[m * bins + k] = i * gain;
            power += gain * gain * (r * r + i * i);
        }
        double off = fabs(b->power[m] - power) / power;
        worst = off > worst ? off : worst;
        double floor = fmax(c->floor, c->relative_floor * power / bins);
        double fill = 0;
        for (int at = m * bins; at < (m + 1) * bins; at++) {
            double scale = 1 / sqrt(re[at] * re[at] + im[at] * im[at] + floor);
            re[at] *= scale, im[at] *= scale;
            fill += (re[at] * re[at] + im[at] * im[at]) / bins;
        }
        off = fabs(b->power[c->mics + m] - fill);
        worst = off > worst ? off : worst;
    }
    const float *row = b->correlation;
    for (int i = 0; i < c->mics; i++)
        for (int j = i + 1; j < c->mics; j++, row += b->columns) {
            double peak = 0, off = 0;
            for (int l = -c->lags; l <= c->lags; l++) {
                double sum = 0;
                for (int k = 0; k < bins; k++) {
                    int x = i * bins + k, y = j * bins + k;
                    double angle = two_pi * (first + k) * l / ((double)c->frame * c->oversample);
                    sum += (re[y] * re[x] + im[y] * im[x]) * cos(angle);
                    sum -= (im[y] * re[x] - re[y] * im[x]) * sin(angle);
                }
                peak = fmax(peak, fabs(sum / bins));
                double distance = fabs(row[l + c->lags] - sum / bins);
                off = distance <= off ? off : distance; /* NaN is kept */
            }
            worst = off / peak <= worst ? worst : off / peak;
        }
    free(re);
    free(im);
    free(turn);
    return worst;
}

static void test_reference(path chosen)
{
    /* mics, frame, lags, oversample, low, high: all group sizes, both parities of the band's edges, blocks of
     * lags that just fit and just do not, every bin (no thinning), a single coarse bin. */
    static const struct {
        int mics, frame, lags, oversample;
        float low, high;
    } cases[] = {
        {3, 1024, 63, 16, 300, 4700},  {2, 256, 1, 1, 300, 4700},     {4, 512, 64, 16, 310, 4690},
        {5, 256, 62, 3, 20, 4979},     {6, 256, 190, 16, 1000, 2000}, {7, 512, 191, 7, 2500, 4000},
        {8, 1024, 63, 16, 300, 4700},  {8, 256, 63, 1, 300, 4700},    {2, 2048, 16, 64, 3000, 3100},
        {3, 4096, 63, 16, 300, 1200},  {3, 512, 127, 1, 20, 4990},    {2, 256, 1, 64, 2000, 2400},
        {3, 256, 4095, 64, 300, 4700}, {4, 1024, 900, 16, 4000, 4990},
    };
    for (size_t n = 0; n < sizeof cases / sizeof *cases; n++) {
        locagen_gcc_config config = TRIANGLE;
        config.mics = cases[n].mics, config.frame = cases[n].frame, config.lags = cases[n].lags;
        config.oversample = cases[n].oversample;
        config.band_low_hz = cases[n].low, config.band_high_hz = cases[n].high;
        bench b = set_up(config, chosen);
        int bad = run(&b);
        CHECK(bad == 0, "case %zu: mask %d", n, bad);
        double error = error_of(&b);
        CHECK(error < 1e-4, "case %zu: error %.2e of the peak", n, error);
        tear_down(&b);
    }
}

static void test_sign(path chosen)
{
    locagen_gcc_config config = TRIANGLE;
    config.mics = 2, config.lags = 160;
    for (int delay = -7; delay <= 7; delay += 14) {
        bench b = set_up(config, chosen);
        for (int n = 7; n < 1024 - 7; n++)
            b.in[1024 + n + (delay > 0 ? delay : 0)] = b.in[n + (delay < 0 ? -delay : 0)];
        run(&b);
        int peak = 0;
        for (int l = 1; l < b.columns; l++)
            if (b.correlation[l] > b.correlation[peak])
                peak = l;
        CHECK(peak - 160 == 16 * delay, "delay %d samples, peak at lag %d / 16", delay, peak - 160);
        tear_down(&b);
    }
}

static void test_faulty_channels(path chosen)
{
    static const float faults[] = {NAN, INFINITY, -INFINITY, 1e30f, 3e38f, 0.0f};
    for (int mics = 2; mics <= 8; mics++)
        for (size_t fault = 0; fault < sizeof faults / sizeof *faults; fault++) {
            locagen_gcc_config config = TRIANGLE;
            config.mics = mics, config.frame = 512;
            bench b = set_up(config, chosen);
            int faulty = (int)fault % mics;
            size_t bytes = sizeof(float) * (size_t)(b.pairs * b.columns);
            float *healthy = allocate(bytes);
            run(&b);
            memcpy(healthy, b.correlation, bytes);
            for (int n = 0; n < 512; n++)
                if (n == 99 || faults[fault] == 0.0f)
                    b.in[faulty * 512 + n] = faults[fault];
            int bad = run(&b);
            int expected = faults[fault] == 0.0f ? 0 : 1 << faulty;
            CHECK(bad == expected, "%d mics, fault %zu: mask %d", mics, fault, bad);
            CHECK(b.power[faulty] == 0.0f, "power %g", (double)b.power[faulty]);
            int row = 0, wrong = 0;
            for (int i = 0; i < mics; i++)
                for (int j = i + 1; j < mics; j++, row++)
                    for (int l = row * b.columns; l < (row + 1) * b.columns; l++)
                        wrong += b.correlation[l] != (i == faulty || j == faulty ? 0.0f : healthy[l]);
            CHECK(wrong == 0, "%d mics, fault %zu: %d values differ", mics, fault, wrong);
            free(healthy);
            tear_down(&b);
        }
}

static void test_silence(path chosen)
{
    for (int with_floor = 0; with_floor < 2; with_floor++) {
        locagen_gcc_config config = TRIANGLE;
        config.mics = 8;
        if (!with_floor)
            config.floor = config.relative_floor = 0.0f;
        bench b = set_up(config, chosen);
        memset(b.in, 0, sizeof(float) * 8 * 1024);
        CHECK(run(&b) == 0, "silence is finite");
        int wrong = 0;
        for (int n = 0; n < b.pairs * b.columns; n++)
            wrong += b.correlation[n] != 0.0f;
        CHECK(wrong == 0, "%d values are not zero", wrong);
        tear_down(&b);
    }
}

static void test_paths_agree(void)
{
    bench b = set_up(TRIANGLE, paths[0]);
    run(&b);
    float narrow[3 * 127];
    memcpy(narrow, b.correlation, sizeof narrow);
    ((state *)(((uintptr_t)b.kernel + 63) & ~(uintptr_t)63))->frame = paths[path_count - 1];
    run(&b);
    float worst = 0.0f;
    for (int n = 0; n < 3 * 127; n++)
        worst = fmaxf(worst, fabsf(b.correlation[n] - narrow[n]));
    CHECK(worst < 1e-6f, "the widths differ by %g", (double)worst); /* rounding of values around 0.1 */
    tear_down(&b);
}

static void refused(locagen_gcc_config config, int expected, const char *what)
{
    char room[1] = {0};
    CHECK(locagen_gcc_sizeof(&config) == 0, "%s", what);
    int code = locagen_gcc_init((locagen_gcc *)room, &config);
    CHECK(code == expected, "%s: %d (%s)", what, code, locagen_strerror(code));
}

static void test_refusals(void)
{
#define REFUSED(field, value, code)                                                                          \
    do {                                                                                                     \
        locagen_gcc_config config = TRIANGLE;                                                                \
        config.field = value;                                                                                \
        refused(config, code, #field " = " #value);                                                          \
    } while (0)
    REFUSED(mics, 1, LOCAGEN_E_MICS);
    REFUSED(mics, 9, LOCAGEN_E_MICS);
    REFUSED(mics, INT32_MIN, LOCAGEN_E_MICS);
    REFUSED(frame, 128, LOCAGEN_E_FRAME);
    REFUSED(frame, 1023, LOCAGEN_E_FRAME);
    REFUSED(frame, 8192, LOCAGEN_E_FRAME);
    REFUSED(rate_hz, 0.0f, LOCAGEN_E_RATE);
    REFUSED(rate_hz, -INFINITY, LOCAGEN_E_RATE);
    REFUSED(rate_hz, NAN, LOCAGEN_E_RATE);
    REFUSED(band_low_hz, 0.0f, LOCAGEN_E_BAND);
    REFUSED(band_low_hz, 4700.0f, LOCAGEN_E_BAND);
    REFUSED(band_low_hz, 4640.0f, LOCAGEN_E_BAND);
    REFUSED(band_high_hz, 5000.0f, LOCAGEN_E_BAND);
    REFUSED(band_high_hz, NAN, LOCAGEN_E_BAND);
    REFUSED(lags, 0, LOCAGEN_E_LAGS);
    REFUSED(lags, 4096, LOCAGEN_E_LAGS);
    REFUSED(lags, INT32_MAX, LOCAGEN_E_LAGS);
    REFUSED(oversample, 0, LOCAGEN_E_LAGS);
    REFUSED(oversample, 65, LOCAGEN_E_LAGS);
    REFUSED(floor, -1e-9f, LOCAGEN_E_FLOOR);
    REFUSED(floor, INFINITY, LOCAGEN_E_FLOOR);
    REFUSED(relative_floor, 1.0f, LOCAGEN_E_FLOOR);
    REFUSED(relative_floor, NAN, LOCAGEN_E_FLOOR);
    CHECK(locagen_gcc_sizeof(NULL) == 0, "no configuration");
    CHECK(locagen_gcc_init(NULL, &TRIANGLE) == LOCAGEN_E_NULL, "no memory");
    bench b = set_up(TRIANGLE, paths[0]);
    CHECK(locagen_gcc_init(b.kernel, NULL) == LOCAGEN_E_NULL, "no configuration");
    CHECK(locagen_gcc_process(NULL, b.in, b.correlation, b.power) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_gcc_process(b.kernel, NULL, b.correlation, b.power) == LOCAGEN_E_NULL, "no input");
    CHECK(locagen_gcc_process(b.kernel, b.in, NULL, b.power) == LOCAGEN_E_NULL, "no correlation");
    CHECK(locagen_gcc_process(b.kernel, b.in, b.correlation, NULL) == LOCAGEN_E_NULL, "no power");
    tear_down(&b);
    for (int code = LOCAGEN_E_LEAST - 1; code <= 1; code++) {
        const char *words = locagen_strerror(code);
        CHECK(strlen(words) > 5, "code %d", code);
        CHECK((strcmp(words, locagen_strerror(INT32_MIN)) == 0) == (code < LOCAGEN_E_RESAMPLE), "code %d", code);
    }
}

/* --- the steered search */

static const locagen_steer_config STEERED = {
    .mics = 3, .frame = 512, .hop = 256, .spans = 2, .smooth_bins = 6, .azimuths = 60, .elevations = 7, .rate_hz = 10000.0f,
    .band_low_hz = 300.0f, .band_high_hz = 4700.0f, .taper = 0.1f, .loading = 1e-3f, .smear = 0.03f,
    .floor = 1e-12f, .speed_m_s = 343.0f,
    .positions_m = {0.0577f, 0.0f, 0.0f, -0.0289f, 0.05f, 0.0f, -0.0289f, -0.05f, 0.0f, 0.0f, 0.0f, -0.08f,
                    0.05f, 0.05f, 0.02f, -0.05f, 0.03f, 0.03f, 0.01f, -0.04f, -0.05f, 0.02f, 0.02f, 0.06f},
};

typedef struct {
    locagen_steer_config config;
    char *memory;
    locagen_steer *kernel;
    steer *state;
    int bins;
    float *in, *power, *map;
    locagen_source *sources;
} steer_bench;

static steer_bench steer_set_up(locagen_steer_config config, const locagen_steer_paths *chosen)
{
    enum { MISALIGNED = 3 };
    steer_bench b = {.config = config};
    size_t bytes = locagen_steer_sizeof(&config);
    b.memory = allocate(bytes + MISALIGNED);
    memset(b.memory, 0xA5, bytes + MISALIGNED);
    b.kernel = (locagen_steer *)(b.memory + MISALIGNED);
    int code = locagen_steer_init(b.kernel, &config);
    CHECK(code == 0, "init gave %d", code);
    CHECK(memcmp(b.memory, "\xA5\xA5\xA5", MISALIGNED) == 0, "init wrote before its memory");
    b.state = locagen_aligned(b.kernel);
    b.state->paths = chosen;
    b.bins = locagen_steer_bin_count(b.kernel);
    b.in = allocate(sizeof(float) * (size_t)(config.mics * config.frame));
    b.power = allocate(sizeof(float) * (size_t)config.mics);
    b.map = allocate(sizeof(float) * (size_t)(config.azimuths * config.elevations));
    b.sources = allocate(sizeof(locagen_source) * (size_t)config.mics);
    return b;
}

static void steer_tear_down(steer_bench *b)
{
    free(b->memory);
    free(b->in);
    free(b->power);
    free(b->map);
    free(b->sources);
}

static void add_hiss(const steer_bench *b, float level)
{
    for (int n = 0; n < b->config.mics * b->config.frame; n++)
        b->in[n] += level * uniform();
}

/* Forty tones of random phase over the band, as a plane wave. */
static void add_wave(const steer_bench *b, double azimuth, double elevation, float level)
{
    const locagen_steer_config *c = &b->config;
    const double two_pi = 6.283185307179586;
    double u[3] = {cos(elevation) * cos(azimuth), cos(elevation) * sin(azimuth), -sin(elevation)};
    for (int tone = 0; tone < 40; tone++) {
        double f = c->band_low_hz + (c->band_high_hz - c->band_low_hz) * (tone + 0.5) / 40;
        double phase = two_pi * (double)uniform();
        for (int m = 0; m < c->mics; m++) {
            const float *p = c->positions_m + 3 * m;
            double early = (p[0] * u[0] + p[1] * u[1] + p[2] * u[2]) / c->speed_m_s;
            for (int n = 0; n < c->frame; n++)
                b->in[m * c->frame + n] += level * (float)cos(phase + two_pi * f * (n / c->rate_hz + early));
        }
    }
}

static void be_silent(const steer_bench *b)
{
    memset(b->in, 0, sizeof(float) * (size_t)(b->config.mics * b->config.frame));
}

static void learn_hiss(const steer_bench *b, int frames)
{
    for (int n = 0; n < frames; n++) {
        be_silent(b);
        add_hiss(b, 0.1f);
        CHECK(locagen_steer_listen(b->kernel, b->in, b->power) == 0, "hiss is finite");
        CHECK(locagen_steer_learn(b->kernel, 0, 1.0f / (float)(n + 1)) == 0, "learnt");
    }
}

static int all_finite(const locagen_source *source)
{
    const float *values = &source->azimuth_rad;
    int finite = 1;
    for (size_t n = 0; n < sizeof *source / sizeof *values; n++)
        finite &= isfinite(values[n]) != 0;
    return finite;
}

/* Degrees between a found direction and the true one. */
static double off_by(const locagen_source *s, double azimuth, double elevation)
{
    double cosine = cos((double)s->elevation_rad) * cos(elevation) * cos((double)s->azimuth_rad - azimuth) +
                    sin((double)s->elevation_rad) * sin(elevation);
    return acos(fmin(1, cosine)) * 57.29577951308232;
}

static void test_steered_angles(const locagen_steer_paths *chosen)
{
    /* mics, frame, smooth_bins, band, grid: flat and not, grids that fill no group of directions, thinning or none,
     * averages as wide as the band. */
    static const struct {
        int mics, frame, smooth, azimuths, elevations;
        float low, high, taper;
    } cases[] = {
        {3, 512, 6, 60, 7, 300, 4700, 0.1f},   {3, 1024, 4, 61, 9, 300, 4700, 1.0f},  {4, 256, 0, 41, 13, 310, 4690, 0.0f},
        {5, 512, 1, 64, 16, 300, 4000, 0.1f},  {6, 256, 64, 61, 17, 20, 4979, 0.5f}, {7, 256, 8, 72, 16, 300, 4900, 0.1f},
        {8, 1024, 12, 64, 16, 300, 4700, 0.1f}, {3, 4096, 64, 60, 7, 2000, 4700, 0.1f}, {4, 512, 40, 41, 13, 2000, 2500, 0.1f},
    };
    for (size_t n = 0; n < sizeof cases / sizeof *cases; n++) {
        locagen_steer_config config = STEERED;
        config.mics = cases[n].mics, config.frame = cases[n].frame, config.smooth_bins = cases[n].smooth;
        config.hop = config.frame / 2, config.taper = cases[n].taper;
        config.azimuths = cases[n].azimuths, config.elevations = cases[n].elevations;
        config.band_low_hz = cases[n].low, config.band_high_hz = cases[n].high;
        steer_bench b = steer_set_up(config, chosen);
        for (int learnt = 0; learnt < 2; learnt++)
            for (int corner = 0; corner < 3; corner++) {
                double azimuth = 2.1 * corner - 2.5, elevation = -0.35 - 0.35 * corner;
                if (learnt)
                    learn_hiss(&b, 20);
                be_silent(&b);
                add_wave(&b, azimuth, elevation, 0.1f);
                add_hiss(&b, 0.1f);
                CHECK(locagen_steer_listen(b.kernel, b.in, b.power) == 0, "finite");
                locagen_steer_hear(b.kernel, 0, 1.0f);
                int found = locagen_steer_search(b.kernel, 0, config.mics, 0, 0, b.sources);
                CHECK(found >= 1 && found < config.mics, "case %zu: %d sources", n, found);
                /* 10 dB and more: under a degree, a few where the band is narrow. */
                double error = off_by(b.sources, azimuth, elevation);
                CHECK(error < 3, "case %zu, learnt %d, corner %d: %.2f degrees", n, learnt, corner, error);
                for (int source = 0; source < found; source++)
                    CHECK(all_finite(&b.sources[source]), "case %zu, source %d", n, source);
                CHECK(locagen_steer_map(b.kernel, 0, b.map) == 0, "map");
            }
        float *bins = allocate(sizeof(float) * 2 * (size_t)(config.mics * b.bins));
        float *noise = allocate(sizeof(float) * 2 * (size_t)(config.mics * config.mics * b.bins));
        float *elevation = allocate(sizeof(float) * (size_t)config.elevations);
        float *azimuth = allocate(sizeof(float) * (size_t)config.azimuths);
        CHECK(locagen_steer_bins(b.kernel, bins) == 0, "bins");
        CHECK(locagen_steer_noise(b.kernel, noise) == 0, "noise");
        CHECK(locagen_steer_axes(b.kernel, elevation, azimuth) == 0, "axes");
        CHECK(azimuth[0] == 0.0f && noise[0] > 0.0f, "azimuth %g, noise %g", (double)azimuth[0], (double)noise[0]);
        float *gain = allocate(sizeof(float) * (size_t)b.bins), least = 1, most = 0;
        CHECK(locagen_steer_gain(b.kernel, 1, gain) == 0 && gain[0] == 1.0f && gain[b.bins - 1] == 1.0f,
              "nothing heard");
        CHECK(locagen_steer_gain(b.kernel, 0, gain) == 0, "gains");
        for (int k = 0; k < b.bins; k++)
            least = gain[k] < least ? gain[k] : least, most = gain[k] > most ? gain[k] : most;
        CHECK(least >= 0 && most > 0.5f && most <= 1, "gains from %g to %g", (double)least, (double)most);
        locagen_steer_reset(b.kernel);
        CHECK(locagen_steer_gain(b.kernel, 0, gain) == 0 && gain[0] == 1.0f, "nothing learnt");
        free(bins), free(noise), free(elevation), free(azimuth), free(gain);
        steer_tear_down(&b);
    }
}

static void test_steered_poles(const locagen_steer_paths *chosen)
{
    for (int mics = 2; mics <= 4; mics++)
        for (int pole = 0; pole < 2; pole++) {
            locagen_steer_config config = STEERED;
            config.mics = mics, config.elevations = mics == 4 ? 14 : 7;
            steer_bench b = steer_set_up(config, chosen);
            be_silent(&b);
            add_wave(&b, 0.3, pole ? -1.5707963267948966 : 0.0, 0.1f);
            locagen_steer_listen(b.kernel, b.in, b.power);
            locagen_steer_hear(b.kernel, 0, 1.0f);
            int found = locagen_steer_search(b.kernel, 0, 1, 0, 0, b.sources);
            CHECK(found == 1 && all_finite(b.sources), "%d mics, pole %d: %d", mics, pole, found);
            double error = off_by(b.sources, 0.3, pole ? -1.5707963267948966 : 0.0);
            CHECK(mics == 2 || error < 2, "%d mics, pole %d: %.2f degrees", mics, pole, error);
            steer_tear_down(&b);
        }
}

static void test_steered_faults(const locagen_steer_paths *chosen)
{
    static const float faults[] = {NAN, INFINITY, -INFINITY, 1e9f, 3e38f, 0.0f};
    for (int mics = 2; mics <= 8; mics += 3)
        for (size_t fault = 0; fault < sizeof faults / sizeof *faults; fault++) {
            locagen_steer_config config = STEERED;
            config.mics = mics, config.frame = 256;
            steer_bench b = steer_set_up(config, chosen);
            int faulty = (int)fault % mics;
            for (int frame = 0; frame < 4; frame++) {
                be_silent(&b);
                add_hiss(&b, 0.1f);
                add_wave(&b, 1.0, -0.6, frame == 3 ? 0.1f : 0.0f);
                for (int n = 0; n < 256; n++)
                    if (n == 99 || faults[fault] == 0.0f)
                        b.in[faulty * 256 + n] = faults[fault];
                int bad = locagen_steer_listen(b.kernel, b.in, b.power);
                CHECK(bad == (faults[fault] == 0.0f ? 0 : 1 << faulty), "%d mics, fault %zu: %d", mics, fault, bad);
                CHECK(b.power[faulty] == 0.0f, "power %g", (double)b.power[faulty]);
                frame < 3 ? locagen_steer_learn(b.kernel, 0, 0.5f) : locagen_steer_hear(b.kernel, 0, 0.5f);
            }
            int found = locagen_steer_search(b.kernel, 0, 8, 0, 0, b.sources);
            CHECK(found < mics && (found > 0) == (mics > 2), "%d mics, fault %zu: %d found", mics, fault, found);
            for (int source = 0; source < found; source++)
                CHECK(all_finite(&b.sources[source]), "%d mics, fault %zu", mics, fault);
            CHECK(mics == 2 || off_by(b.sources, 1.0, -0.6) < 3, "%d mics, fault %zu: %.2f degrees", mics, fault,
                  off_by(b.sources, 1.0, -0.6));
            steer_tear_down(&b);
        }
}

/* What is learnt is the frame so many hops ago, of the ring's every turn; the largest lag of all in bounds. */
static void test_steered_lag(const locagen_steer_paths *chosen)
{
    for (int lag = 0; lag <= MOST_LAG; lag += 1 + lag) {
        locagen_steer_config config = STEERED;
        config.lag = lag;
        steer_bench b = steer_set_up(config, chosen);
        float *now = malloc(sizeof(float) * (size_t)(2 * b.bins * config.mics));
        float *noise = malloc(sizeof(float) * (size_t)(2 * b.bins * config.mics * config.mics));
        float *powers = malloc(sizeof(float) * (size_t)(3 * lag + 3));
        CHECK(now && noise && powers, "memory");
        float expected = 0.0f;
        for (int n = 0; n < 3 * lag + 3; n++) {
            be_silent(&b);
            add_hiss(&b, 0.1f);
            locagen_steer_listen(b.kernel, b.in, b.power);
            locagen_steer_bins(b.kernel, now);
            powers[n] = now[0] * now[0] + now[1] * now[1];
            for (int ago = lag; ago >= 0; ago -= 1 + ago / 2) {
                CHECK(locagen_steer_learn(b.kernel, ago, 1.0f) == 0, "learnt");
                locagen_steer_noise(b.kernel, noise);
                expected = ago <= n ? powers[n - ago] : expected; /* nothing where so many have not been */
                CHECK(fabsf(noise[0] - expected) <= 1e-5f * expected, "%d ago of %d, frame %d", ago, lag, n);
            }
        }
        CHECK(locagen_steer_learn(b.kernel, lag + 1, 1.0f) == LOCAGEN_E_LAG, "older than the ring");
        CHECK(locagen_steer_learn(b.kernel, -1, 1.0f) == LOCAGEN_E_LAG, "yet to come");
        free(now), free(noise), free(powers);
        steer_tear_down(&b);
    }
}

/* Spans do not know of each other; weights of 0 leave nothing; watching harms no direction that kept still. */
static void test_steered_spans(const locagen_steer_paths *chosen)
{
    steer_bench b = steer_set_up(STEERED, chosen);
    learn_hiss(&b, 60);
    be_silent(&b);
    add_hiss(&b, 0.1f);
    locagen_steer_listen(b.kernel, b.in, b.power);
    locagen_steer_hear(b.kernel, 1, 1.0f);
    CHECK(locagen_steer_search(b.kernel, 0, 1, 0, 0, b.sources) == 0, "span 0 has heard nothing");
    CHECK(locagen_steer_search(b.kernel, 1, 1, 0, 0, b.sources) == 1, "span 1 has");
    for (int n = 0; n < 2; n++) {
        CHECK(locagen_steer_watch(b.kernel, 1) == 0, "watched");
        CHECK(locagen_steer_settle(b.kernel, 1, 0.1f) == 0, "settled");
    }
    add_wave(&b, 1.0, -0.5, 0.1f);
    locagen_steer_listen(b.kernel, b.in, b.power);
    locagen_steer_hear(b.kernel, 0, 1.0f), locagen_steer_hear(b.kernel, 1, 1.0f);
    CHECK(locagen_steer_search(b.kernel, 0, 1, 0, 0, b.sources) == 1, "a call");
    float score = b.sources[0].score;
    CHECK(b.sources[0].contrast > -0.1f * score, "one source is as good a reason: %g of %g",
          (double)b.sources[0].contrast, (double)score);
    CHECK(locagen_steer_search(b.kernel, 1, 1, 0, 0, b.sources) == 1, "a call, watched");
    CHECK(b.sources[0].score <= score * 1.001f, "watching only lessens: %g, %g", (double)b.sources[0].score,
          (double)score);
    CHECK(locagen_steer_search(b.kernel, 0, 1, 2 * score, 0, b.sources) == 0, "not loud enough");
    float *weight = calloc((size_t)b.bins, sizeof *weight);
    CHECK(weight && locagen_steer_weigh(b.kernel, weight) == 0, "no bin counts");
    CHECK(locagen_steer_search(b.kernel, 0, 1, 0, 0, b.sources) == 0, "nothing to score");
    free(weight);
    steer_tear_down(&b);

    b = steer_set_up(STEERED, chosen);
    learn_hiss(&b, 60);
    be_silent(&b);
    add_hiss(&b, 0.3f);
    locagen_steer_listen(b.kernel, b.in, b.power);
    locagen_steer_hear(b.kernel, 0, 1.0f);
    CHECK(locagen_steer_search(b.kernel, 0, 1, 0, 0, b.sources) == 1, "louder noise");
    CHECK(b.sources[0].contrast < -0.5f * b.sources[0].score, "no source is the better reason: %g of %g",
          (double)b.sources[0].contrast, (double)b.sources[0].score);
    steer_tear_down(&b);
}

static void test_steered_silence(const locagen_steer_paths *chosen)
{
    steer_bench b = steer_set_up(STEERED, chosen);
    CHECK(locagen_steer_search(b.kernel, 0, 1, 0, 0, b.sources) == 0, "nothing heard");
    be_silent(&b);
    for (int learnt = 0; learnt < 2; learnt++) {
        CHECK(locagen_steer_listen(b.kernel, b.in, b.power) == 0, "silence is finite");
        locagen_steer_hear(b.kernel, 0, 1.0f);
        CHECK(locagen_steer_search(b.kernel, 0, 1, 0, 0, b.sources) == 0, "silence, learnt %d", learnt);
        CHECK(locagen_steer_map(b.kernel, 0, b.map) == 0, "map");
        int wrong = 0;
        for (int n = 0; n < 60 * 7; n++)
            wrong += b.map[n] != 0.0f;
        CHECK(wrong == 0, "%d scores are not zero", wrong);
        locagen_steer_learn(b.kernel, 0, 0.5f);
    }
    add_wave(&b, 1.0, -0.6, 0.1f);
    locagen_steer_listen(b.kernel, b.in, b.power);
    locagen_steer_hear(b.kernel, 0, 1.0f);
    CHECK(locagen_steer_search(b.kernel, 0, 1, 0, 0, b.sources) == 1, "a source over silence");
    CHECK(all_finite(b.sources) && off_by(b.sources, 1.0, -0.6) < 1, "%.2f degrees", off_by(b.sources, 1.0, -0.6));
    float *gain = allocate(sizeof(float) * (size_t)b.bins);
    CHECK(locagen_steer_gain(b.kernel, 0, gain) == 0 && gain[0] >= 0 && gain[0] <= 1, "over silence: %g", (double)gain[0]);
    free(gain);
    locagen_steer_reset(b.kernel);
    CHECK(locagen_steer_search(b.kernel, 0, 1, 0, 0, b.sources) == 0, "forgotten");
    steer_tear_down(&b);
}

static void test_steered_paths_agree(void)
{
    steer_bench b = steer_set_up(STEERED, steer_paths[0]), c = steer_set_up(STEERED, steer_paths[path_count - 1]);
    seed = 99;
    learn_hiss(&b, 10);
    seed = 99;
    learn_hiss(&c, 10);
    be_silent(&b);
    add_wave(&b, 1.0, -0.6, 0.05f);
    add_hiss(&b, 0.1f);
    locagen_steer_listen(b.kernel, b.in, b.power), locagen_steer_listen(c.kernel, b.in, c.power);
    locagen_steer_hear(b.kernel, 0, 1.0f), locagen_steer_hear(c.kernel, 0, 1.0f);
    CHECK(locagen_steer_search(b.kernel, 0, 1, 0, 0, b.sources) == 1 && locagen_steer_search(c.kernel, 0, 1, 0, 0, c.sources) == 1,
          "one source");
    /* Rounding through two inverses, of matrices from ten frames. */
    float ratio = b.sources->score / c.sources->score;
    CHECK(fabsf(ratio - 1) < 1e-3f, "scores' ratio %g", (double)ratio);
    CHECK(off_by(b.sources, (double)c.sources->azimuth_rad, (double)c.sources->elevation_rad) < 0.05, "directions");
    steer_tear_down(&b);
    steer_tear_down(&c);
}

static void steer_refused(locagen_steer_config config, int expected, const char *what)
{
    char room[1] = {0};
    CHECK(locagen_steer_sizeof(&config) == 0, "%s", what);
    int code = locagen_steer_init((locagen_steer *)room, &config);
    CHECK(code == expected, "%s: %d (%s)", what, code, locagen_strerror(code));
}

static void test_steered_refusals(void)
{
#define STEER_REFUSED(field, value, code)                                                                    \
    do {                                                                                                     \
        locagen_steer_config config = STEERED;                                                               \
        config.field = value;                                                                                \
        steer_refused(config, code, #field " = " #value);                                                    \
    } while (0)
    STEER_REFUSED(mics, 1, LOCAGEN_E_MICS);
    STEER_REFUSED(mics, INT32_MAX, LOCAGEN_E_MICS);
    STEER_REFUSED(frame, 1000, LOCAGEN_E_FRAME);
    STEER_REFUSED(rate_hz, NAN, LOCAGEN_E_RATE);
    STEER_REFUSED(band_high_hz, 5000.0f, LOCAGEN_E_BAND);
    STEER_REFUSED(hop, 63, LOCAGEN_E_HOP);
    STEER_REFUSED(hop, INT32_MAX, LOCAGEN_E_HOP);
    STEER_REFUSED(hop, INT32_MIN, LOCAGEN_E_HOP);
    STEER_REFUSED(taper, NAN, LOCAGEN_E_TAPER);
    STEER_REFUSED(taper, 1.01f, LOCAGEN_E_TAPER);
    STEER_REFUSED(smooth_bins, -1, LOCAGEN_E_SMOOTH);
    STEER_REFUSED(smooth_bins, 65, LOCAGEN_E_SMOOTH);
    STEER_REFUSED(spans, 0, LOCAGEN_E_SPAN);
    STEER_REFUSED(spans, 5, LOCAGEN_E_SPAN);
    STEER_REFUSED(lag, -1, LOCAGEN_E_LAG);
    STEER_REFUSED(lag, 65, LOCAGEN_E_LAG);
    STEER_REFUSED(smear, NAN, LOCAGEN_E_NOISE);
    STEER_REFUSED(loading, 0.0f, LOCAGEN_E_NOISE);
    STEER_REFUSED(loading, INFINITY, LOCAGEN_E_NOISE);
    STEER_REFUSED(floor, 0.0f, LOCAGEN_E_NOISE);
    STEER_REFUSED(floor, NAN, LOCAGEN_E_NOISE);
    STEER_REFUSED(speed_m_s, 0.0f, LOCAGEN_E_ARRAY);
    STEER_REFUSED(speed_m_s, NAN, LOCAGEN_E_ARRAY);
    STEER_REFUSED(positions_m[8], INFINITY, LOCAGEN_E_ARRAY);
    STEER_REFUSED(positions_m[3], -10.1f, LOCAGEN_E_ARRAY);
    STEER_REFUSED(azimuths, 7, LOCAGEN_E_GRID);
    STEER_REFUSED(elevations, 181, LOCAGEN_E_GRID);
    locagen_steer_config same_place = STEERED;
    memset(same_place.positions_m, 0, sizeof same_place.positions_m);
    steer_refused(same_place, LOCAGEN_E_ARRAY, "all in one place");
    CHECK(locagen_steer_sizeof(NULL) == 0, "no configuration");
    CHECK(locagen_steer_init(NULL, &STEERED) == LOCAGEN_E_NULL, "no memory");
    steer_bench b = steer_set_up(STEERED, steer_paths[0]);
    be_silent(&b);
    CHECK(locagen_steer_init(b.kernel, NULL) == LOCAGEN_E_NULL, "no configuration");
    CHECK(locagen_steer_reset(NULL) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_listen(NULL, b.in, b.power) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_listen(b.kernel, NULL, b.power) == LOCAGEN_E_NULL, "no input");
    CHECK(locagen_steer_listen(b.kernel, b.in, NULL) == LOCAGEN_E_NULL, "no power");
    CHECK(locagen_steer_learn(NULL, 0, 0.5f) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_hear(NULL, 0, 0.5f) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_learn(b.kernel, 0, NAN) == LOCAGEN_E_SHARE, "no share");
    CHECK(locagen_steer_hear(b.kernel, 0, 1.5f) == LOCAGEN_E_SHARE, "too large a share");
    CHECK(locagen_steer_search(NULL, 0, 1, 0, 0, b.sources) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_search(b.kernel, 0, 1, 0, 0, NULL) == LOCAGEN_E_NULL, "no output");
    CHECK(locagen_steer_search(b.kernel, 0, 0, 0, 0, b.sources) == LOCAGEN_E_COUNT, "no sources asked for");
    CHECK(locagen_steer_search(b.kernel, 0, 1, NAN, 0, b.sources) == LOCAGEN_E_LEAST, "least");
    CHECK(locagen_steer_search(b.kernel, 0, 1, 0, -1, b.sources) == LOCAGEN_E_LEAST, "further");
    for (int span = -1; span <= 2; span += 3) {
        CHECK(locagen_steer_hear(b.kernel, span, 0.5f) == LOCAGEN_E_SPAN, "span %d", span);
        CHECK(locagen_steer_watch(b.kernel, span) == LOCAGEN_E_SPAN, "span %d", span);
        CHECK(locagen_steer_settle(b.kernel, span, 0.5f) == LOCAGEN_E_SPAN, "span %d", span);
        CHECK(locagen_steer_doubt(b.kernel, span) == LOCAGEN_E_SPAN, "span %d", span);
        CHECK(locagen_steer_search(b.kernel, span, 1, 0, 0, b.sources) == LOCAGEN_E_SPAN, "span %d", span);
        CHECK(locagen_steer_map(b.kernel, span, b.map) == LOCAGEN_E_SPAN, "span %d", span);
        CHECK(locagen_steer_gain(b.kernel, span, b.map) == LOCAGEN_E_SPAN, "span %d", span);
    }
    CHECK(locagen_steer_watch(NULL, 0) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_settle(NULL, 0, 0.5f) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_settle(b.kernel, 0, NAN) == LOCAGEN_E_SHARE, "no share");
    CHECK(locagen_steer_doubt(NULL, 0) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_weigh(NULL, b.in) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_weigh(b.kernel, NULL) == LOCAGEN_E_NULL, "no weights");
    CHECK(locagen_steer_gain(NULL, 0, b.map) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_gain(b.kernel, 0, NULL) == LOCAGEN_E_NULL, "no gains");
    b.in[1] = 1.01f;
    CHECK(locagen_steer_weigh(b.kernel, b.in) == LOCAGEN_E_WEIGHT, "a weight over 1");
    b.in[1] = NAN;
    CHECK(locagen_steer_weigh(b.kernel, b.in) == LOCAGEN_E_WEIGHT, "a weight that is none");
    CHECK(locagen_steer_map(b.kernel, 0, NULL) == LOCAGEN_E_NULL, "no map");
    CHECK(locagen_steer_bins(b.kernel, NULL) == LOCAGEN_E_NULL, "no bins");
    CHECK(locagen_steer_noise(b.kernel, NULL) == LOCAGEN_E_NULL, "no noise");
    CHECK(locagen_steer_axes(b.kernel, b.map, NULL) == LOCAGEN_E_NULL, "no axes");
    CHECK(locagen_steer_bin_count(NULL) == LOCAGEN_E_NULL, "no state");
    CHECK(locagen_steer_first_bin(NULL) == LOCAGEN_E_NULL, "no state");
    steer_tear_down(&b);
}

/* Memory just as large as needed: a sanitizer sees one tap too far. */
static void test_resample(void)
{
    enum { UP = 5, DOWN = 24, TAPS = 3 * LOCAGEN_TAPS, COUNT = 7, AT = 3 };
    enum { SAMPLES = (AT + (COUNT - 1) * DOWN) / UP + TAPS };
    for (int mics = 1; mics <= 8; mics++) {
        float *table = allocate(sizeof(float) * UP * TAPS), *in = allocate(sizeof(float) * (size_t)mics * SAMPLES);
        float *out = allocate(sizeof(float) * (size_t)mics * COUNT);
        for (int n = 0; n < UP * TAPS; n++)
            table[n] = uniform();
        for (int n = 0; n < mics * SAMPLES; n++)
            in[n] = uniform();
        int code = locagen_resample(table, TAPS, UP, DOWN, AT, in, mics, SAMPLES, out, COUNT);
        CHECK(code == 0, "code %d", code);
        for (int n = 0; n < COUNT; n++)
            for (int m = 0; m < mics; m++) {
                int place = AT + n * DOWN;
                double sum = 0;
                for (int j = 0; j < TAPS; j++)
                    sum += (double)table[place % UP * TAPS + j] * in[m * SAMPLES + place / UP + j];
                CHECK(fabs(sum - out[n * mics + m]) < 1e-5, "row %d, microphone %d: %g", n, m, sum);
            }
        CHECK(locagen_resample(table, TAPS, UP, DOWN, AT, in, mics, SAMPLES - 1, out, COUNT) == LOCAGEN_E_RESAMPLE,
              "a sample too few");
        CHECK(locagen_resample(table, TAPS, UP, DOWN, AT, in, mics, 0, out, 0) == 0, "nothing of nothing");
        CHECK(locagen_resample(table, TAPS - 1, UP, DOWN, AT, in, mics, SAMPLES, out, COUNT) == LOCAGEN_E_RESAMPLE,
              "taps");
        CHECK(locagen_resample(NULL, TAPS, UP, DOWN, AT, in, mics, SAMPLES, out, COUNT) == LOCAGEN_E_NULL, "null");
        free(table), free(in), free(out);
    }
}

int main(void)
{
#if defined(__x86_64__)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
        steer_paths[path_count] = &locagen_steer_avx2, paths[path_count++] = locagen_frame_avx2;
#endif
    for (int n = 0; n < path_count; n++) {
        test_reference(paths[n]);
        test_sign(paths[n]);
        test_faulty_channels(paths[n]);
        test_silence(paths[n]);
        test_steered_angles(steer_paths[n]);
        test_steered_poles(steer_paths[n]);
        test_steered_faults(steer_paths[n]);
        test_steered_lag(steer_paths[n]);
        test_steered_spans(steer_paths[n]);
        test_steered_silence(steer_paths[n]);
    }
    test_paths_agree();
    test_refusals();
    test_resample();
    test_steered_paths_agree();
    test_steered_refusals();
    printf("%d passed, %d failed (vector widths: %d)\n", passed, failed, path_count);
    return failed != 0;
}
