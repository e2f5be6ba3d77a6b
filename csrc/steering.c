/* steering.c - maximum likelihood over directions: set-up, memory of frames, coarse grid, refinement.
 *
 * What is scored and why stands in locagen.h. How it is made cheap: all of a coarse grid's directions are
 * scored on bins added up by the few (up to eight, as long as no phase across the array differs by more than
 * THIN_PHASE from that of their middle), and q is averaged over as many neighbours as it would be on the
 * fine bins. From the best one Newton's method goes on to the continuum, on all bins: eight directions are
 * scored side by side, which is just what finite differences of a parabola in two dimensions take.
 *
 * Newton's coordinates are direction cosines in the plane of a flat array: the score is nearly a parabola in
 * them, and they know neither rim nor pole. Beyond the rim (noise may put the best there) the best on it is
 * taken. Of two directions that a flat array cannot tell apart the lower one is meant. An array in space has
 * the two arcs of the tangent plane for coordinates.
 */
#include "steering.h"

#include <float.h>
#include <math.h>
#include <string.h>

static const double PI = 3.14159265358979323846;

/* 0.15 radians at the outer bins of a block lower their mean by 0.4 % and do not shift it. */
static const double THIN_PHASE = 0.15;

/* Half widths of the parabola through the scores, as phase across the array at the band's upper end: wide
 * where the grid's own step is to be bridged, and kept where that is not enough, along a low voice's ridge; at
 * last as narrow as float's rounding of the scores allows. */
static const double WIDTHS[] = {0.6, 0.4, 0.2, 0.2};

static const double STILL = 0.02; /* radians of phase: after so short a step the next is about its square */

static const double LOBE = 3.0;  /* radians of phase from a lobe's top to beyond its foot */
static const double FAINT = 0.05; /* of the first source's score: what an inexact null may leave of it */
static const float CLOSE = 0.9f; /* the grid costs a lobe less than a tenth of its score */

static const double SMEAR_HZ = 100;      /* each side: what a rotor's tones wander in some seconds at 4 kHz */
static const double PRIOR_LOOKS = 4;     /* worth of theory against what q has been: independent values of it */
static const double LEAST_UNBIASED = 0.25;
static const float MOST_OVER = 10; /* q - 1 that is watched: a bang is forgotten within the usual time */
static const double LOST = 0.1;          /* a microphone missing from more of R does not count */
static const double SILENT = 1e-5;       /* power under the loudest one's: -50 dB */
static const float LEAST_DENOMINATOR = 1e-6f; /* of microphones: loading keeps the true ones above it */
static const float LEAST_AFTER_NULL = 0.05f;  /* nearer to a nulled source nothing can be told */
static const double WHITE_SHARE = 1e-7;  /* of the signal, the least noise that is estimated: float's own */

static const double WATCH_SHARE = 1.0 / 300; /* the usual share of one hop in the spread: 15 s of hops */

static const locagen_spread PLAIN; /* as theory says */

enum { MOST_THINNING = 8, LEAST_COARSE = 8, MOST_LOBES = 4, MOST_STEPS = 12 };

static steer *state_of(const void *memory)
{
    return (steer *)locagen_aligned(memory);
}

static int within(double x, double low, double high)
{
    return x >= low && x <= high;
}

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static double normalise(double a[3])
{
    double length = sqrt(dot(a, a));
    for (int n = 0; n < 3 && length > 0; n++)
        a[n] /= length;
    return length;
}

static void cross(const double a[3], const double b[3], double to[3])
{
    to[0] = a[1] * b[2] - a[2] * b[1];
    to[1] = a[2] * b[0] - a[0] * b[2];
    to[2] = a[0] * b[1] - a[1] * b[0];
}

/* p_m - p_0, metres, and the longest of them. */
static double arms(const locagen_steer_config *c, double arm[MOST_MICS][3], int *longest)
{
    double most = 0;
    *longest = 0;
    for (int m = 0; m < c->mics; m++) {
        for (int n = 0; n < 3; n++)
            arm[m][n] = (double)c->positions_m[3 * m + n] - c->positions_m[n];
        if (dot(arm[m], arm[m]) > most)
            most = dot(arm[m], arm[m]), *longest = m;
    }
    return sqrt(most);
}

static int check(const locagen_steer_config *c)
{
    if (c == NULL)
        return LOCAGEN_E_NULL;
    int error = locagen_spectrum_check(c->mics, c->frame, c->rate_hz, c->band_low_hz, c->band_high_hz);
    if (error != LOCAGEN_OK)
        return error;
    if (c->hop != 0 && (c->hop < c->frame / 8 || c->hop > 1 << 24))
        return LOCAGEN_E_HOP;
    if (!within(c->taper, 0, 1))
        return LOCAGEN_E_TAPER;
    if (c->smooth_bins < 0 || c->smooth_bins > 64)
        return LOCAGEN_E_SMOOTH;
    if (c->spans < 1 || c->spans > MOST_SPANS)
        return LOCAGEN_E_SPAN;
    if (c->lag < 0 || c->lag > MOST_LAG)
        return LOCAGEN_E_LAG;
    if (!within(c->loading, 0.999e-5, 1) || !within(c->floor, 0.999e-15, 1) || !within(c->smear, 0, 1))
        return LOCAGEN_E_NOISE;
    for (int n = 0; n < 3 * c->mics; n++)
        if (!within(c->positions_m[n], -10, 10))
            return LOCAGEN_E_ARRAY;
    double arm[MOST_MICS][3];
    int longest;
    if (arms(c, arm, &longest) < 1e-3 || !within(c->speed_m_s, 100, 2000))
        return LOCAGEN_E_ARRAY;
    if (c->azimuths < 8 || c->azimuths > 720 || c->elevations < 2 || c->elevations > 180)
        return LOCAGEN_E_GRID;
    return LOCAGEN_OK;
}

/* The array's plane: along its longest arm, along what is left of the others, and across. */
static void find_plane(steer *s, const locagen_steer_config *c)
{
    double arm[MOST_MICS][3], most = 1e-3; /* 1 mm is a position's tolerance */
    int longest;
    arms(c, arm, &longest);
    double *x = s->axes[0], *y = s->axes[1], *z = s->axes[2];
    memcpy(x, arm[longest], sizeof s->axes[0]);
    normalise(x);
    /* All in a line: any second axis will do; a level one keeps "below" below. */
    const double down[3] = {0, 0, 1};
    cross(down, x, y);
    if (normalise(y) < 1e-9)
        y[0] = 1, y[1] = y[2] = 0;
    for (int m = 0; m < c->mics; m++) {
        double rest[3];
        for (int n = 0; n < 3; n++)
            rest[n] = arm[m][n] - dot(arm[m], x) * x[n];
        double length = normalise(rest);
        if (length > most)
            most = length, memcpy(y, rest, sizeof rest);
    }
    cross(x, y, z);
    for (int n = 0; n < 3 && z[2] < 0; n++)
        y[n] = -y[n];
    cross(x, y, z);
    s->flat = 1;
    for (int m = 0; m < c->mics; m++)
        s->flat &= fabs(dot(arm[m], z)) <= 1e-3;
}

static void lay_out_response(locagen_response *r, const steer *s, int bins, int half, int thinning,
                             locagen_arena *a)
{
    r->bins = bins;
    r->stride = (bins + BIN_BLOCK - 1) / BIN_BLOCK * BIN_BLOCK;
    r->half = half < bins - 1 ? half : bins - 1;
    r->thinning = thinning;
    r->planes = locagen_take(a, (size_t)(3 + 4 * s->pairs) * (size_t)r->stride);
    r->share = locagen_take(a, (size_t)bins);
    r->looks = locagen_take(a, (size_t)bins);
}

/* Sizes and places; with a null base only the arena's count is meant. */
static void lay_out(steer *s, const locagen_steer_config *c, locagen_arena *a)
{
    memset(s, 0, sizeof *s);
    locagen_spectrum_lay_out(&s->spectrum, c->mics, c->frame, c->rate_hz, c->band_low_hz, c->band_high_hz, a);
    s->mics = c->mics;
    s->pairs = c->mics * (c->mics - 1) / 2;
    s->bins = s->spectrum.last_bin - s->spectrum.first_bin + 1;
    s->stride = (s->bins + BIN_BLOCK - 1) / BIN_BLOCK * BIN_BLOCK;
    s->loading = c->loading, s->floor = c->floor;
    s->azimuths = c->azimuths, s->elevations = c->elevations;
    s->groups = (c->azimuths * c->elevations + DIRECTIONS - 1) / DIRECTIONS;
    s->spans = c->spans, s->lag = c->lag;
    s->smear = c->smear, s->smear_half = (int32_t)(SMEAR_HZ * c->frame / c->rate_hz);
    find_plane(s, c);
    s->whole_sphere = !s->flat;

    double per_metre = 2 * PI * c->rate_hz / c->frame / c->speed_m_s, arm[MOST_MICS][3], longest = 0;
    int at;
    s->per_metre = per_metre;
    arms(c, arm, &at);
    for (int m = 0; m < c->mics; m++)
        for (int n = 0; n < 3; n++)
            s->offset[m][n] = per_metre * arm[m][n];
    for (int i = 0; i < c->mics; i++)
        for (int j = 0; j < i; j++) {
            double d[3] = {arm[i][0] - arm[j][0], arm[i][1] - arm[j][1], arm[i][2] - arm[j][2]};
            longest = fmax(longest, sqrt(dot(d, d)));
        }
    s->reach = per_metre * longest * s->spectrum.last_bin;
    int thinning = 1;
    while (thinning < MOST_THINNING && 2 * thinning <= 2 * c->smooth_bins + 1 &&
           s->bins / (2 * thinning) >= LEAST_COARSE &&
           (2 * thinning - 1) / 2.0 * per_metre * longest < THIN_PHASE)
        thinning *= 2;

    size_t planes = (size_t)(s->mics * s->mics) * (size_t)s->stride, mics = (size_t)s->mics;
    s->bins_re = locagen_take(a, ((size_t)s->lag + 1) * mics * (size_t)s->stride);
    s->bins_im = locagen_take(a, ((size_t)s->lag + 1) * mics * (size_t)s->stride);
    s->noise = locagen_take(a, planes), s->smeared = locagen_take(a, planes);
    s->inverse = locagen_take(a, planes), s->rate = locagen_take(a, (size_t)s->stride);
    s->mask = locagen_take(a, (size_t)s->stride);
    lay_out_response(&s->fine, s, s->bins, c->smooth_bins, 1, a);
    /* As many bins in the average: 2 half + 1 blocks nearest to 2 smooth_bins + 1 bins. */
    double blocks = (2 * c->smooth_bins + 1) / (double)thinning;
    lay_out_response(&s->coarse, s, s->bins / thinning, (int)floor((blocks - 1) / 2 + 0.5), thinning, a);
    s->nulls = locagen_take(a, 2 * (mics - 1) * mics * (size_t)s->stride);
    size_t groups = (size_t)s->groups;
    s->grid = locagen_take(a, groups * (mics - 1) * 4 * DIRECTIONS);
    s->aim = locagen_take(a, (mics - 1) * 4 * DIRECTIONS);
    s->scores = locagen_take(a, groups * DIRECTIONS);
    s->careful = locagen_take(a, groups * DIRECTIONS);
    s->q = locagen_take(a, (size_t)s->bins * DIRECTIONS);
    for (int n = 0; n < s->spans; n++) {
        locagen_span *span = &s->span[n];
        span->signal = locagen_take(a, planes);
        span->scores = locagen_take(a, groups * DIRECTIONS);
        span->over = locagen_take(a, groups * DIRECTIONS * (size_t)s->coarse.bins);
        span->spread = locagen_take(a, groups * DIRECTIONS * (size_t)s->coarse.bins);
        span->calm = locagen_take(a, groups * DIRECTIONS * (size_t)s->coarse.bins);
        for (int i = 0; i < 2; i++)
            span->aside[i] = locagen_take(a, groups * DIRECTIONS * (size_t)s->coarse.bins);
    }
    s->grid_u = (double *)(void *)locagen_take(a, 2 * 3 * groups * DIRECTIONS);
}

static void fill_response(const locagen_response *r)
{
    for (int k = 0; k < r->bins; k++) {
        int first = k - r->half > 0 ? k - r->half : 0;
        int last = k + r->half < r->bins - 1 ? k + r->half : r->bins - 1;
        r->share[k] = 1.0f / (float)(last - first + 1);
    }
}

/* The phases of direction u in one lane: at bin `first`, and from bin to bin. */
static void put_phases(const steer *s, const double u[3], double first, double step, float *lane)
{
    for (int m = 1; m < s->mics; m++, lane += 4 * DIRECTIONS) {
        double phase = dot(s->offset[m], u);
        lane[0] = (float)cos(first * phase), lane[DIRECTIONS] = (float)sin(first * phase);
        lane[2 * DIRECTIONS] = (float)cos(step * phase), lane[3 * DIRECTIONS] = (float)sin(step * phase);
    }
}

static double grid_elevation(const steer *s, int row)
{
    double span = s->whole_sphere ? PI : PI / 2;
    return span * (s->whole_sphere ? 0.5 : 0) - span * (row + 0.5) / s->elevations;
}

static double grid_azimuth(const steer *s, int column)
{
    double turn = 2 * PI * column / s->azimuths;
    return turn < PI ? turn : turn - 2 * PI;
}

static void fill_grid(steer *s)
{
    int count = s->azimuths * s->elevations;
    double thinning = s->coarse.thinning;
    for (int n = 0; n < s->groups * DIRECTIONS; n++) {
        int at = n < count ? n : count - 1;
        double elevation = grid_elevation(s, at / s->azimuths), azimuth = grid_azimuth(s, at % s->azimuths);
        double *u = s->grid_u + 3 * n;
        u[0] = cos(elevation) * cos(azimuth), u[1] = cos(elevation) * sin(azimuth), u[2] = -sin(elevation);
        float *group = s->grid + (size_t)(n / DIRECTIONS) * (size_t)(s->mics - 1) * 4 * DIRECTIONS;
        put_phases(s, u, s->spectrum.first_bin + (thinning - 1) / 2, thinning, group + n % DIRECTIONS);
    }
}

/* A look is a bin of an untapered frame. Tapering makes neighbouring bins depend on each other, overlap
 * neighbouring frames (Welch 1967, "The use of fast Fourier transform for the estimation of power spectra"):
 * the variance of an average is over sum(w^2)^2 / (N sum(w^4)) looks in a frame, and the coherence of
 * windows h apart is (sum(w(n) w(n + h)) / sum(w^2))^2. */
static void count_looks(steer *s, const locagen_steer_config *c)
{
    double squares = 0, fourths = 0;
    for (int n = 0; n < c->frame; n++) {
        double w = locagen_window(n, c->frame, c->taper);
        squares += w * w, fourths += w * w * w * w;
    }
    s->looks = squares * squares / (c->frame * fourths);
    for (int hop = 1; c->hop > 0 && hop <= 8 && hop * c->hop < c->frame; hop++, s->hops++) {
        double sum = 0;
        for (int n = 0; n + hop * c->hop < c->frame; n++)
            sum += locagen_window(n, c->frame, c->taper) *
                   locagen_window(n + hop * c->hop, c->frame, c->taper);
        s->overlap[hop - 1] = sum * sum / (squares * squares);
    }
}

size_t locagen_steer_sizeof(const locagen_steer_config *config)
{
    if (check(config) != LOCAGEN_OK)
        return 0;
    steer s;
    locagen_arena count = {NULL, 0};
    locagen_take(&count, sizeof s / sizeof(float) + 1);
    lay_out(&s, config, &count);
    return count.used + LOCAGEN_LINE - 1;
}

int locagen_steer_init(locagen_steer *memory, const locagen_steer_config *config)
{
    int error = memory == NULL ? LOCAGEN_E_NULL : check(config);
    if (error != LOCAGEN_OK)
        return error;
    memset(memory, 0, locagen_steer_sizeof(config));
    steer *s = state_of(memory);
    locagen_arena room = {(char *)s, 0};
    locagen_take(&room, sizeof *s / sizeof(float) + 1);
    lay_out(s, config, &room);
    locagen_spectrum_init(&s->spectrum, config->taper);
    fill_response(&s->fine);
    fill_response(&s->coarse);
    fill_grid(s);
    count_looks(s, config);
    for (int k = 0; k < s->bins; k++)
        s->mask[k] = 1;

    s->paths = &locagen_steer_quad;
#if defined(__x86_64__)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
        s->paths = &locagen_steer_avx2;
#endif
    return LOCAGEN_OK;
}

int locagen_steer_reset(locagen_steer *memory)
{
    if (memory == NULL)
        return LOCAGEN_E_NULL;
    steer *s = state_of(memory);
    size_t row = (size_t)s->stride * sizeof(float), mics = (size_t)s->mics;
    size_t groups = (size_t)s->groups * DIRECTIONS * sizeof(float), blocks = groups * (size_t)s->coarse.bins;
    memset(s->bins_re, 0, ((size_t)s->lag + 1) * mics * row);
    memset(s->bins_im, 0, ((size_t)s->lag + 1) * mics * row);
    memset(s->noise, 0, mics * mics * row);
    memset(s->lost_noise, 0, sizeof s->lost_noise);
    memset(s->learnt_weights, 0, sizeof s->learnt_weights);
    memset(s->frame_mics, 0, sizeof s->frame_mics);
    s->learnt = s->learnt_variance = 0;
    s->slot = s->listened = s->inverse_mics = 0;
    for (int n = 0; n < s->spans; n++) {
        locagen_span *span = &s->span[n];
        memset(span->signal, 0, mics * mics * row);
        memset(span->scores, 0, groups), memset(span->over, 0, blocks), memset(span->spread, 0, blocks);
        memset(span->aside[0], 0, blocks), memset(span->aside[1], 0, blocks);
        memset(span->aside_count, 0, sizeof span->aside_count);
        memset(span->lost, 0, sizeof span->lost), memset(span->heard_weights, 0, sizeof span->heard_weights);
        span->heard = span->heard_variance = span->watched = 0;
    }
    return LOCAGEN_OK;
}

int locagen_steer_listen(locagen_steer *memory, const float *in, float *power)
{
    if (memory == NULL || in == NULL || power == NULL)
        return LOCAGEN_E_NULL;
    steer *s = state_of(memory);
    s->slot = (s->slot + 1) % (s->lag + 1);
    s->listened = s->listened <= s->lag ? s->listened + 1 : s->listened;
    int bad = s->paths->listen(s, in, power), mics = 0;
    float loudest = 0; /* not fmax of doubles: gcc 12 for aarch64 breaks down over vectors of that */
    for (int m = 0; m < s->mics; m++)
        loudest = power[m] > loudest ? power[m] : loudest;
    for (int m = 0; m < s->mics; m++)
        if (!(bad >> m & 1) && power[m] >= SILENT * loudest)
            mics |= 1 << m;
    s->frame_mics[s->slot] = mics;
    return bad;
}

/* An average of frames gets one more: its matrix, the weight that lacks each microphone, the sum of weights
 * and, for overlapping frames depend on each other, the variance of such a sum. */
static void add(const steer *s, int slot, float share, float *matrix, float *lost, double *weight,
                double *variance, double weights[8])
{
    s->paths->add(s, slot, 1.0f - share, share, matrix);
    for (int m = 0; m < s->mics; m++)
        lost[m] = (1.0f - share) * lost[m] + (s->frame_mics[slot] >> m & 1 ? 0.0f : share);
    double keep = 1.0f - share, fresh = (double)share, with_old = 0;
    *weight = keep * *weight + fresh;
    for (int hop = 0; hop < s->hops; hop++)
        with_old += s->overlap[hop] * keep * weights[hop];
    *variance = keep * keep * *variance + fresh * fresh + 2 * fresh * with_old;
    for (int hop = 7; hop > 0; hop--)
        weights[hop] = keep * weights[hop - 1];
    weights[0] = fresh;
}

int locagen_steer_learn(locagen_steer *memory, int32_t ago, float share)
{
    if (memory == NULL)
        return LOCAGEN_E_NULL;
    if (!within(share, 0, 1))
        return LOCAGEN_E_SHARE;
    steer *s = state_of(memory);
    if (ago < 0 || ago > s->lag)
        return LOCAGEN_E_LAG;
    if (s->listened <= ago)
        return LOCAGEN_OK;
    int slot = (s->slot + s->lag + 1 - ago) % (s->lag + 1);
    add(s, slot, share, s->noise, s->lost_noise, &s->learnt, &s->learnt_variance, s->learnt_weights);
    s->inverse_mics = 0;
    return LOCAGEN_OK;
}

/* The span that a caller means, or why there is none. */
static int find_span(locagen_steer *memory, int32_t span, steer **s, locagen_span **x)
{
    if (memory == NULL)
        return LOCAGEN_E_NULL;
    *s = state_of(memory);
    if (span < 0 || span >= (*s)->spans)
        return LOCAGEN_E_SPAN;
    *x = &(*s)->span[span];
    return LOCAGEN_OK;
}

int locagen_steer_hear(locagen_steer *memory, int32_t span, float share)
{
    steer *s;
    locagen_span *x;
    int error = find_span(memory, span, &s, &x);
    if (error != LOCAGEN_OK)
        return error;
    if (!within(share, 0, 1))
        return LOCAGEN_E_SHARE;
    add(s, s->slot, share, x->signal, x->lost, &x->heard, &x->heard_variance, x->heard_weights);
    return LOCAGEN_OK;
}

int locagen_steer_weigh(locagen_steer *memory, const float *weight)
{
    if (memory == NULL || weight == NULL)
        return LOCAGEN_E_NULL;
    steer *s = state_of(memory);
    for (int k = 0; k < s->bins; k++)
        if (!within((double)weight[k], 0, 1))
            return LOCAGEN_E_WEIGHT;
    memcpy(s->mask, weight, (size_t)s->bins * sizeof *weight);
    return LOCAGEN_OK;
}

/* Whether these microphones stand in a line, to a millimetre: then a bearing has a mirror image. */
static int in_a_line(const steer *s, int mics)
{
    int first = __builtin_ctz((unsigned)mics), far = first;
    double most = 0, off = 0, along[3] = {0};
    for (int m = 0; m < s->mics; m++) {
        double d[3];
        for (int n = 0; n < 3; n++)
            d[n] = s->offset[m][n] - s->offset[first][n];
        if ((mics >> m & 1) && dot(d, d) > most)
            most = dot(d, d), far = m, memcpy(along, d, sizeof d);
    }
    for (int m = 0; m < s->mics && most > 0; m++) {
        double d[3], across[3];
        for (int n = 0; n < 3; n++)
            d[n] = s->offset[m][n] - s->offset[first][n];
        cross(d, along, across);
        if (m != far && (mics >> m & 1))
            off = fmax(off, dot(across, across) / most);
    }
    return off < 1e-6 * s->per_metre * s->per_metre;
}

/* Microphones that are in both R_n and R_x, as a mask; 0 where nothing can be looked for, or an array that
 * has a plane would have lost it. */
static int usable_mics(const steer *s, const locagen_span *x)
{
    int mask = 0, count = 0, all = (1 << s->mics) - 1;
    for (int m = 0; m < s->mics; m++) {
        int lost = (double)x->lost[m] > LOST * x->heard || (double)s->lost_noise[m] > LOST * s->learnt;
        mask |= !lost << m;
        count += !lost;
    }
    int lost_plane = count >= 2 && mask != all && in_a_line(s, mask) && !in_a_line(s, all);
    return x->heard > 0 && count >= 2 && !lost_plane ? mask : 0;
}

static double looks_of(const steer *s, double weight, double variance)
{
    return s->looks * weight * weight / variance;
}

/* Independent looks in R_x, less what R_n itself does not know: the ratio of two averages varies as if it
 * held fewer (the F distribution's variance, to first order). */
static double looks(const steer *s, const locagen_span *x)
{
    double signal = looks_of(s, x->heard, x->heard_variance);
    if (s->learnt <= 0)
        return signal;
    double noise = looks_of(s, s->learnt, s->learnt_variance);
    return signal * noise / (signal + noise);
}

/* Bins that each q of the grid is an average of. */
static double averaged(const steer *s)
{
    return (2 * s->coarse.half + 1) * (double)s->coarse.thinning;
}

/* What theory is worth beside what was watched. */
static double prior_of(const steer *s, const locagen_span *x)
{
    double fresh = s->looks / looks_of(s, x->heard, x->heard_variance); /* of each hop's q, what is new */
    return PRIOR_LOOKS / fresh * WATCH_SHARE;
}

/* How far q has spread, against theory's 1 / (looks * bins averaged). */
static locagen_spread spread_of(const steer *s, locagen_span *x)
{
    locagen_spread spread = {.over = x->over, .seen = x->over, .careful = x->scores};
    if (x->watched <= 0 || s->learnt <= 0)
        return spread;
    spread.calm = x->calm;
    spread.theory = (float)(1 / (looks(s, x) * averaged(s)));
    return spread;
}

/* From (q - 1)^2 to what theory expects of it. Only deviations above 1 are counted; of an average of k looks,
 * gamma distributed, their mean square is (1 + 0.52 / sqrt(k)) / (2 k) (by simulation, k from 4 to 200). */
static float over_theory(const steer *s, const locagen_span *x)
{
    double k = looks(s, x) * averaged(s);
    return (float)(2 * k / (1 + 0.52 / sqrt(k)));
}

/* Numbers in `over` and all that is made of it. */
static long spread_count(const steer *s)
{
    return s->groups * (long)DIRECTIONS * s->coarse.bins;
}

int locagen_steer_watch(locagen_steer *memory, int32_t span)
{
    steer *s;
    locagen_span *x;
    int error = find_span(memory, span, &s, &x);
    if (error != LOCAGEN_OK)
        return error;
    if (x->heard <= 0 || s->learnt <= 0)
        return LOCAGEN_OK;
    s->paths->add_squares(spread_count(s), over_theory(s, x), MOST_OVER, x->over, x->aside[0]);
    x->aside_count[0]++;
    return LOCAGEN_OK;
}

int locagen_steer_settle(locagen_steer *memory, int32_t span, float share)
{
    steer *s;
    locagen_span *x;
    int error = find_span(memory, span, &s, &x);
    if (error != LOCAGEN_OK)
        return error;
    if (!within((double)share, 0, 1))
        return LOCAGEN_E_SHARE;
    float *done = x->aside[1];
    if (x->aside_count[1] > 0) {
        double keep = pow(1 - (double)share, x->aside_count[1]);
        s->paths->blend(spread_count(s), (float)keep, (float)((1 - keep) / x->aside_count[1]), done, x->spread);
        x->watched = keep * x->watched + 1 - keep;
        double prior = prior_of(s, x);
        s->paths->soothe(spread_count(s), (float)prior, (float)(x->watched + prior), x->spread, x->calm);
        memset(done, 0, (size_t)spread_count(s) * sizeof *done);
    }
    x->aside[1] = x->aside[0], x->aside_count[1] = x->aside_count[0];
    x->aside[0] = done, x->aside_count[0] = 0;
    return LOCAGEN_OK;
}

int locagen_steer_doubt(locagen_steer *memory, int32_t span)
{
    steer *s;
    locagen_span *x;
    int error = find_span(memory, span, &s, &x);
    if (error != LOCAGEN_OK)
        return error;
    for (int i = 0; i < 2; i++)
        if (x->aside_count[i] > 0) {
            memset(x->aside[i], 0, (size_t)spread_count(s) * sizeof *x->aside[i]);
            x->aside_count[i] = 0;
        }
    return LOCAGEN_OK;
}

int locagen_steer_gain(locagen_steer *memory, int32_t span, float *gain)
{
    steer *s;
    locagen_span *x;
    int error = find_span(memory, span, &s, &x);
    if (error != LOCAGEN_OK)
        return error;
    if (gain == NULL)
        return LOCAGEN_E_NULL;
    int mics = s->learnt > 0 ? usable_mics(s, x) : 0, half = s->fine.half;
    for (int k = 0; k < s->bins; k++)
        s->q[k] = 0, gain[k] = 1;
    if (mics == 0)
        return LOCAGEN_OK;
    float heard = (float)(1 / x->heard) / (float)__builtin_popcount((unsigned)mics), learnt = (float)(1 / s->learnt);
    for (int m = 0; m < s->mics; m++) {
        const float *signal = x->signal + m * (long)s->stride, *noise = s->noise + m * (long)s->stride;
        for (int k = 0; k < s->bins && (mics >> m & 1); k++)
            s->q[k] += heard * signal[k] / (learnt * noise[k] + s->floor);
    }
    double sum = 0; /* of those bins that the average holds */
    for (int k = 0; k < half; k++)
        sum += (double)s->q[k];
    for (int k = 0; k < s->bins; k++) {
        if (k + half < s->bins)
            sum += (double)s->q[k + half];
        if (k > half)
            sum -= (double)s->q[k - half - 1];
        double over = sum * (double)s->fine.share[k];
        gain[k] = over > 1 ? (float)(1 - 1 / over) : 0;
    }
    return LOCAGEN_OK;
}

/* What the grid's bins are worth: looks, times the weight from outside. */
static void count_coarse_bins(const steer *s, double t)
{
    for (int k = 0; k < s->coarse.bins; k++) {
        float sum = 0;
        for (int n = 0; n < s->coarse.thinning; n++)
            sum += s->mask[k * s->coarse.thinning + n];
        s->coarse.looks[k] = (float)t * sum;
    }
}

/* Where in `over` and `spread` a direction of the grid stands. */
static long place_in_spread(const steer *s, int n)
{
    int width = s->paths->width;
    return (long)(n / width) * s->coarse.bins * width + n % width;
}

/* How calm coarse bin k has been before in a direction of the grid. */
static float calmness(const steer *s, const locagen_spread *spread, int n, int k)
{
    return spread->calm ? spread->calm[place_in_spread(s, n) + (long)k * s->paths->width] : 1.0f;
}

/* What its looks count for where a source is to be placed that gave these q. */
static float trust(const steer *s, const locagen_spread *spread, int n, int k)
{
    if (spread->calm == NULL)
        return 1;
    float calm = calmness(s, spread, n, k), theory = spread->theory, reach = REACH * REACH * theory;
    float over = spread->seen[place_in_spread(s, n) + (long)k * s->paths->width], x = over * over;
    return calm * (x + reach) / (x * (calm + (1.0f - calm) * theory) + reach);
}

/* Looks of all bins, in the direction of the grid that a refinement begins with. */
static void count_fine_bins(const steer *s, const locagen_spread *spread, double t, int n)
{
    int step = s->coarse.thinning;
    for (int block = 0, k = 0; block < s->coarse.bins; block++) {
        float looks = (float)t * trust(s, spread, n, block);
        int end = block < s->coarse.bins - 1 ? k + step : s->bins; /* the last counts for what is left over */
        for (; k < end; k++)
            s->fine.looks[k] = looks * s->mask[k];
    }
}

/* Scores of the grid. Returns 0, and leaves those that place a source undone, where none would be `least`,
 * carefully: in noise alone, mostly. */
static int score_grid(const steer *s, enum locagen_measure measure, const locagen_spread *spread, float least)
{
    int later = spread->over && spread->calm && measure == MEASURE_RATIO;
    s->paths->score(s, &s->coarse, measure, spread, s->grid, s->groups, later ? NULL : s->scores, NULL);
    if (!later)
        return 1;
    float most = 0;
    for (int n = 0; n < s->azimuths * s->elevations; n++)
        most = spread->careful[n] > most ? spread->careful[n] : most;
    if (!(most > least))
        return 0;
    s->paths->place(s, spread, s->scores);
    return 1;
}

/* Whether the lobe of one direction may hold the other. */
static int same_lobe(const steer *s, const double u[3], const double v[3])
{
    double d[3] = {u[0] - v[0], u[1] - v[1], u[2] - v[2]}, across = s->flat ? dot(d, s->axes[2]) : 0;
    return s->reach * sqrt(fmax(0, dot(d, d) - across * across)) < LOBE;
}

/* Whether a direction of the grid is no lower than those beside it: each row is a circle, rows end. */
static int is_top(const steer *s, const float *scores, int n)
{
    int row = n / s->azimuths, column = n % s->azimuths;
    int left = row * s->azimuths + (column + s->azimuths - 1) % s->azimuths;
    int right = row * s->azimuths + (column + 1) % s->azimuths;
    return scores[n] >= scores[left] && scores[n] >= scores[right] &&
           (row == 0 || scores[n] >= scores[n - s->azimuths]) &&
           (row == s->elevations - 1 || scores[n] >= scores[n + s->azimuths]);
}

/* The best top of the grid outside the lobes of those before it; a low voice's are wide, and their flanks high. */
static int next_on_grid(const steer *s, const float *scores, const int *before, int count_before)
{
    int best = -1;
    for (int n = 0; n < s->azimuths * s->elevations; n++) {
        if ((best >= 0 && !(scores[n] > scores[best])) || !is_top(s, scores, n))
            continue;
        int apart = 1;
        for (int i = 0; i < count_before && apart; i++)
            apart = !same_lobe(s, s->grid_u + 3 * n, s->grid_u + 3 * before[i]);
        if (apart)
            best = n;
    }
    return best;
}

typedef struct {
    int at;              /* on the grid, where the refinement began */
    double u[3], score, mean_q;
    double careful;      /* score */
    double rival;        /* score in the best other lobe, over this */
    double moved;        /* in the last step, radians of phase */
    double along[2][3];  /* the coordinates' axes */
    double hessian[3];   /* xx, xy, yy */
} aim;

/* Arcs of the tangent plane: towards greater azimuth, towards greater elevation. Straight up or down azimuth
 * 0 is meant. */
static void arcs(const double u[3], double azimuth[3], double elevation[3])
{
    double level = hypot(u[0], u[1]);
    double c = level > 1e-9 ? u[0] / level : 1, s = level > 1e-9 ? u[1] / level : 0;
    azimuth[0] = -s, azimuth[1] = c, azimuth[2] = 0;
    elevation[0] = u[2] * c, elevation[1] = u[2] * s, elevation[2] = -level;
}

/* u moved by (x, y) of its coordinates. Off the sphere where the array is flat and the plane is left: phases
 * are linear in u, so that the score is defined there too. */
static void moved(const steer *s, const aim *a, double x, double y, double to[3])
{
    for (int n = 0; n < 3; n++)
        to[n] = a->u[n] + x * a->along[0][n] + y * a->along[1][n];
    if (!s->flat)
        normalise(to);
}

/* The best step on the parabola, no longer than `most`; returns whether it would have been. A direction that the
 * score does not depend on (an array in a line) and one that it curves upwards in are followed uphill only a
 * little. */
static int newton(const double g[2], const double h[3], double most, double step[2])
{
    double middle = -(h[0] + h[2]) / 2, apart = hypot((h[0] - h[2]) / 2, h[1]);
    double largest = fabs(middle) + apart, least = 1e-3 * largest + 1e-30;
    /* Damped until the smaller of -H's own values is positive (Levenberg). */
    double damping = middle - apart < least ? least - (middle - apart) : 0;
    double a = -h[0] + damping, b = -h[1], c = -h[2] + damping, det = a * c - b * b;
    step[0] = det > 0 ? (c * g[0] - b * g[1]) / det : 0;
    step[1] = det > 0 ? (a * g[1] - b * g[0]) / det : 0;
    double length = hypot(step[0], step[1]);
    if (length > most)
        step[0] *= most / length, step[1] *= most / length;
    return length > most;
}

/* One Newton step from scores at the corners of a hexagon of half width h and its middle. Returns whether the
 * top is farther away. */
static int refine_once(const steer *s, enum locagen_measure measure, double h, aim *a)
{
    static const double AT[DIRECTIONS][2] = {
        {0, 0}, {1, 0}, {-1, 0}, {0, 1}, {0, -1}, {1, 1}, {-1, -1}, {0, 0},
    };
    float score[DIRECTIONS], mean_q[DIRECTIONS];
    if (s->flat)
        memcpy(a->along, s->axes, sizeof a->along);
    else
        arcs(a->u, a->along[0], a->along[1]);
    for (int n = 0; n < DIRECTIONS; n++) {
        double u[3];
        moved(s, a, h * AT[n][0], h * AT[n][1], u);
        put_phases(s, u, s->spectrum.first_bin, 1, s->aim + n);
    }
    s->paths->score(s, &s->fine, measure, &PLAIN, s->aim, 1, score, mean_q);
    double f[DIRECTIONS];
    for (int n = 0; n < DIRECTIONS; n++)
        f[n] = (double)score[n];
    double g[2] = {(f[1] - f[2]) / (2 * h), (f[3] - f[4]) / (2 * h)}, step[2];
    a->hessian[0] = (f[1] + f[2] - 2 * f[0]) / (h * h);
    a->hessian[2] = (f[3] + f[4] - 2 * f[0]) / (h * h);
    a->hessian[1] = (f[5] + f[6] - f[1] - f[2] - f[3] - f[4] + 2 * f[0]) / (2 * h * h);
    const double *m = a->hessian;
    int farther = newton(g, m, 2 * h, step);
    if (s->flat) {
        double v[2] = {dot(a->u, s->axes[0]), dot(a->u, s->axes[1])};
        double r = hypot(v[0] + step[0], v[1] + step[1]);
        if (r > 1) {
            /* Beyond the rim: to the rim, and one step of Newton's along it. */
            double c = (v[0] + step[0]) / r, d = (v[1] + step[1]) / r;
            double gx = g[0] + m[0] * (c - v[0]) + m[1] * (d - v[1]);
            double gy = g[1] + m[1] * (c - v[0]) + m[2] * (d - v[1]);
            double slope = -d * gx + c * gy;
            double bend = -(m[0] * d * d - 2 * m[1] * c * d + m[2] * c * c) + c * gx + d * gy;
            double turn = bend > 0 ? fmax(-h, fmin(h, slope / bend)) : 0;
            step[0] = cos(turn) * c - sin(turn) * d - v[0];
            step[1] = sin(turn) * c + cos(turn) * d - v[1];
        }
        double to[2] = {v[0] + step[0], v[1] + step[1]};
        double across = sqrt(fmax(0, 1 - to[0] * to[0] - to[1] * to[1]));
        for (int n = 0; n < 3; n++)
            a->u[n] = to[0] * s->axes[0][n] + to[1] * s->axes[1][n] + across * s->axes[2][n];
    } else {
        moved(s, a, step[0], step[1], a->u);
    }
    a->moved = s->reach * hypot(step[0], step[1]);
    double gain = g[0] * step[0] + g[1] * step[1] +
                  0.5 * (m[0] * step[0] * step[0] + 2 * m[1] * step[0] * step[1] + m[2] * step[1] * step[1]);
    a->score = f[0] + fmax(gain, -0.5 * fabs(f[0]));
    a->mean_q = (double)mean_q[0];
    return farther;
}

static void refine(const steer *s, enum locagen_measure measure, aim *a)
{
    int left = MOST_STEPS, last = sizeof WIDTHS / sizeof *WIDTHS - 1;
    for (int n = 0; n <= last && left > 0; left--) {
        n += !refine_once(s, measure, WIDTHS[n] / s->reach, a);
        if (n == last && a->moved < STILL)
            return;
    }
}

/* The best direction of all, and what the best in another lobe scores over it. The grid may put lobes in a wrong
 * order that differ by less than it loses beside a lobe's top: then several are refined. Returns 0 where nothing
 * scores more than `least`, carefully. `t`: looks. */
static int find_best(const steer *s, enum locagen_measure measure, const locagen_spread *spread, double t,
                     float least, aim *best)
{
    const float *scores = s->scores, *careful = spread->careful ? spread->careful : scores;
    int top[MOST_LOBES], lobes = 0;
    double second = 0;
    if (!score_grid(s, measure, spread, CLOSE * least))
        return 0;
    for (; lobes < MOST_LOBES; lobes++) {
        int at = top[lobes] = next_on_grid(s, scores, top, lobes);
        if (at < 0 || !(scores[at] > 0))
            break;
        if (lobes == 0 && !(careful[at] > CLOSE * least))
            return 0;
        if (!(scores[at] > CLOSE * CLOSE * scores[top[0]])) {
            second = fmax(second, (double)scores[at]);
            break;
        }
        aim a = {.at = at};
        memcpy(a.u, s->grid_u + 3 * at, sizeof a.u);
        count_fine_bins(s, spread, t, at);
        refine(s, measure, &a);
        a.careful = a.score * (double)(careful[at] / scores[at]);
        int better = lobes == 0 || a.score > best->score;
        if (lobes > 0 && !same_lobe(s, a.u, best->u))
            second = fmax(second, better ? best->score : a.score);
        if (better)
            *best = a;
    }
    best->rival = lobes > 0 ? second / best->score : 0;
    return lobes > 0 && best->careful > (double)least;
}

/* 1 / E q of noise, whitened by a matrix from N looks at it: of such an adaptive beam the output power over
 * 1 / (a^H R_n^-1 a) (Reed, Mallett & Brennan 1974, "Rapid convergence rate in adaptive arrays", with the complex
 * Wishart distribution). Loading takes over where looks are few. */
static double unbiased(const steer *s, int mics)
{
    double n = looks_of(s, s->learnt, s->learnt_variance);
    return fmax(LEAST_UNBIASED, (n - mics + 1) * (n - mics) / (n * n));
}

/* How R_n is to be had; where it was never learnt, its level from the power across the direction of most
 * power. Leaves its inverse for whitening. */
static locagen_whitening whitening(steer *s, const locagen_span *x)
{
    locagen_whitening how = {.span = x, .mics = usable_mics(s, x), .signal_scale = (float)(1 / x->heard)};
    float count = (float)__builtin_popcount((unsigned)how.mics);
    s->fine.least = s->coarse.least = LEAST_DENOMINATOR * count;
    if (s->learnt > 0) {
        how.noise_scale = (float)(1 / s->learnt);
        how.signal_scale *= (float)unbiased(s, __builtin_popcount((unsigned)how.mics));
        if (s->inverse_mics != how.mics)
            s->paths->invert(s, &how);
        s->inverse_mics = how.mics;
        return how;
    }
    how.white = 1.0f;
    s->paths->invert(s, &how);
    s->paths->whiten(s, &how);
    double total = 0;
    for (int k = 0; k < s->bins; k++)
        total += (double)s->fine.planes[k];
    aim a;
    double along = find_best(s, MEASURE_POWER, &PLAIN, 1, 0, &a) ? a.score : 0;
    double across = (total - along) / (s->bins * ((double)count - 1));
    how.white = (float)fmax(fmax(across, WHITE_SHARE * total / s->bins), (double)s->floor);
    s->paths->invert(s, &how);
    s->inverse_mics = 0;
    return how;
}

/* Log-likelihood ratio of "one source" against "all of the noise has become louder": from the last scores of
 * the grid. What M microphones hear incoherently is M g(p) of their mean power p. */
static double contrast(const steer *s, const locagen_spread *spread, int n, int mics)
{
    const locagen_response *r = &s->coarse;
    const float *power = r->planes + (2 + 4 * (long)s->pairs) * r->stride;
    const float *over = spread->over + place_in_spread(s, n);
    double sum = 0;
    for (int k = 0; k < r->bins; k++) {
        int first = k - r->half > 0 ? k - r->half : 0;
        int last = k + r->half < r->bins - 1 ? k + r->half : r->bins - 1;
        double p = 0, q = (double)over[(long)k * s->paths->width];
        for (int i = first; i <= last; i++)
            p += (double)power[i];
        p = fmax(0, p / (r->thinning * (last - first + 1.0)) - 1);
        sum += (double)(r->looks[k] * calmness(s, spread, n, k)) * (q - log1p(q) - mics * (p - log1p(p)));
    }
    return sum;
}

/* By how much the noise turns a direction of the grid more than theory knows, as variance: where q strayed wild
 * times as far as it should have, noise beside noise, of 1 in q, pulls wild times as hard; source beside noise,
 * q - 1, as ever. Each part of the band counts by its share of the information, f^2 (q - 1)^2 / q. What counts by
 * a weight w pulls w times as hard and is known w times as well: its variance is w^2 where the score says w. */
static double unrest(const steer *s, const locagen_spread *spread, double t, int n)
{
    const locagen_response *r = &s->coarse;
    double known = 0, pulled = 0;
    for (int k = 0; k < r->bins; k++) {
        double over = (double)spread->seen[place_in_spread(s, n) + (long)k * s->paths->width];
        double f = s->spectrum.first_bin + (k + 0.5) * r->thinning, wild = 1 / (double)calmness(s, spread, n, k);
        double weight = (double)r->looks[k] / (t * r->thinning);
        double information = (double)(r->looks[k] * trust(s, spread, n, k)) * f * f * over * over / (1 + over);
        known += information;
        pulled += information * weight * (over + wild) / (over + 1);
    }
    return known > 0 ? pulled / known : 1;
}

static void add_null(steer *s, int source, const double u[3])
{
    for (int m = 0; m < s->mics; m++) {
        float *re = s->nulls + 2 * (source * (long)s->mics + m) * s->stride, *im = re + s->stride;
        double phase = dot(s->offset[m], u), r = cos(s->spectrum.first_bin * phase);
        double i = sin(s->spectrum.first_bin * phase), step_r = cos(phase), step_i = sin(phase);
        for (int k = 0; k < s->stride; k++) {
            re[k] = (float)r, im[k] = (float)i;
            double turned = r * step_r - i * step_i;
            i = r * step_i + i * step_r, r = turned;
        }
    }
}

static locagen_source told(const aim *a, int mics, double unrest)
{
    double azimuth[3], elevation[3];
    arcs(a->u, azimuth, elevation);
    /* From the coordinates of the refinement, as they were before its last step, to the arcs. */
    double x[2] = {dot(a->along[0], azimuth), dot(a->along[1], azimuth)};
    double y[2] = {dot(a->along[0], elevation), dot(a->along[1], elevation)};
    const double *h = a->hessian;
    double xx = h[0] * x[0] * x[0] + 2 * h[1] * x[0] * x[1] + h[2] * x[1] * x[1];
    double xy = h[0] * x[0] * y[0] + h[1] * (x[0] * y[1] + x[1] * y[0]) + h[2] * x[1] * y[1];
    double yy = h[0] * y[0] * y[0] + 2 * h[1] * y[0] * y[1] + h[2] * y[1] * y[1];
    double level = hypot(a->u[0], a->u[1]);
    return (locagen_source){
        .azimuth_rad = level > 1e-9 ? (float)atan2(a->u[1], a->u[0]) : 0.0f,
        .elevation_rad = (float)atan2(-a->u[2], level),
        .score = (float)a->score,
        .snr = (float)fmax(0, (a->mean_q - 1) / __builtin_popcount((unsigned)mics)),
        .information = {(float)(-xx / unrest), (float)(-xy / unrest), (float)(-yy / unrest)},
    };
}

/* Whether a further source is one that others should make room for: not noise, of which the smoothed bins
 * alone give about one each; not what an inexact null leaves of the source before. Nulling a direction that
 * holds no source would cost the others many degrees (measured: up to 16). */
static int is_sure(const steer *s, const aim *aims, const double *score, int n)
{
    int sure = score[n] > 4.0 * s->bins / (2 * s->fine.half + 1) && score[n] > FAINT * score[0];
    for (int before = 0; before < n; before++)
        sure &= !same_lobe(s, aims[n].u, aims[before].u);
    return sure;
}

/* Each direction anew with all others nulled, twice round: a source found first was found with the others in
 * the way (the relaxation of Li & Stoica 1996, "Efficient mixed-spectrum estimation"). */
static void relax(steer *s, locagen_whitening how, const locagen_spread *spread, double t, int found,
                  aim *aims)
{
    how.nulls = found - 1;
    for (int step = 0; step < 2 * found; step++) {
        aim *a = &aims[step % found];
        for (int other = 0, slot = 0; other < found; other++)
            if (&aims[other] != a)
                add_null(s, slot++, aims[other].u);
        s->paths->whiten(s, &how);
        count_fine_bins(s, spread, t, a->at);
        refine(s, MEASURE_RATIO, a);
    }
}

int locagen_steer_search(locagen_steer *memory, int32_t span, int32_t most, float least, float further,
                         locagen_source *out)
{
    if (memory == NULL || out == NULL)
        return LOCAGEN_E_NULL;
    if (most < 1)
        return LOCAGEN_E_COUNT;
    if (!within((double)least, 0, (double)FLT_MAX) || !within((double)further, 0, (double)FLT_MAX))
        return LOCAGEN_E_LEAST;
    steer *s;
    locagen_span *x;
    int error = find_span(memory, span, &s, &x);
    if (error != LOCAGEN_OK)
        return error;
    if (usable_mics(s, x) == 0) {
        memset(x->scores, 0, (size_t)s->groups * DIRECTIONS * sizeof *x->scores);
        memset(x->over, 0, (size_t)s->groups * DIRECTIONS * (size_t)s->coarse.bins * sizeof *x->over);
        return 0;
    }
    locagen_whitening how = whitening(s, x);
    locagen_spread spread = spread_of(s, x);
    int count = __builtin_popcount((unsigned)how.mics), found = 0;
    aim aims[MOST_MICS];
    double score[MOST_MICS], mean_q[MOST_MICS], t = looks(s, x), first = 0;
    count_coarse_bins(s, t);
    for (; found < most && found < count - 1; found++, how.nulls++) {
        aim *a = &aims[found];
        if (found > 0 && further > 0) {
            if (!(score[found - 1] > (double)further))
                break; /* what comes next is weaker still */
            least = (float)fmax((double)further, FAINT * score[0]);
        }
        s->paths->whiten(s, &how);
        if (!find_best(s, MEASURE_RATIO, &spread, t, least, a))
            break;
        score[found] = a->careful, mean_q[found] = a->mean_q;
        if (found == 0)
            first = contrast(s, &spread, a->at, count);
        spread.over = NULL, spread.careful = s->careful; /* with nulls they are not those of the noise */
        add_null(s, found, a->u);
        s->fine.least = s->coarse.least = LEAST_AFTER_NULL * (float)count;
    }
    int sure = found > 0;
    while (sure < found && is_sure(s, aims, score, sure))
        sure++;
    if (sure > 1)
        relax(s, how, &spread, t, sure, aims);
    for (int n = 0; n < found; n++) {
        aims[n].score = score[n], aims[n].mean_q = mean_q[n];
        out[n] = told(&aims[n], how.mics, unrest(s, &spread, t, aims[n].at));
        out[n].contrast = (float)first;
        out[n].rival = n == 0 ? (float)aims[0].rival : 0.0f;
    }
    return found;
}

int locagen_steer_bin_count(const locagen_steer *memory)
{
    return memory == NULL ? LOCAGEN_E_NULL : state_of(memory)->bins;
}

int locagen_steer_first_bin(const locagen_steer *memory)
{
    return memory == NULL ? LOCAGEN_E_NULL : state_of(memory)->spectrum.first_bin;
}

int locagen_steer_bins(const locagen_steer *memory, float *bins)
{
    if (memory == NULL || bins == NULL)
        return LOCAGEN_E_NULL;
    const steer *s = state_of(memory);
    for (int m = 0; m < s->mics; m++)
        for (int k = 0; k < s->bins; k++) {
            long at = (s->slot * (long)s->mics + m) * s->stride + k;
            *bins++ = s->bins_re[at];
            *bins++ = s->bins_im[at];
        }
    return LOCAGEN_OK;
}

int locagen_steer_noise(const locagen_steer *memory, float *noise)
{
    if (memory == NULL || noise == NULL)
        return LOCAGEN_E_NULL;
    const steer *s = state_of(memory);
    float scale = s->learnt > 0 ? (float)(1 / s->learnt) : 0.0f;
    for (int k = 0; k < s->bins; k++, noise += 2 * s->mics * s->mics) {
        const float *pair = s->noise + s->mics * (long)s->stride + k;
        for (int i = 0; i < s->mics; i++) {
            float *own = noise + 2 * (i * s->mics + i);
            own[0] = scale * s->noise[i * (long)s->stride + k], own[1] = 0.0f;
            for (int j = i + 1; j < s->mics; j++, pair += 2 * (long)s->stride) {
                float *upper = noise + 2 * (i * s->mics + j), *lower = noise + 2 * (j * s->mics + i);
                upper[0] = lower[0] = scale * pair[0];
                upper[1] = scale * pair[s->stride], lower[1] = -upper[1];
            }
        }
    }
    return LOCAGEN_OK;
}

int locagen_steer_axes(const locagen_steer *memory, float *elevation, float *azimuth)
{
    if (memory == NULL || elevation == NULL || azimuth == NULL)
        return LOCAGEN_E_NULL;
    const steer *s = state_of(memory);
    for (int row = 0; row < s->elevations; row++)
        elevation[row] = (float)grid_elevation(s, row);
    for (int column = 0; column < s->azimuths; column++)
        azimuth[column] = (float)grid_azimuth(s, column);
    return LOCAGEN_OK;
}

int locagen_steer_map(const locagen_steer *memory, int32_t span, float *map)
{
    if (memory == NULL || map == NULL)
        return LOCAGEN_E_NULL;
    const steer *s = state_of(memory);
    if (span < 0 || span >= s->spans)
        return LOCAGEN_E_SPAN;
    memcpy(map, s->span[span].scores, (size_t)(s->azimuths * s->elevations) * sizeof *map);
    return LOCAGEN_OK;
}
