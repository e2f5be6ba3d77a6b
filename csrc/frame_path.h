/* frame_path.h - the way of one frame: samples, bins, unit bins, products, coarse bins, lags.
 *
 * Included once for each vector width by a file that defines WIDTH. Lanes are microphones up to the
 * products and pairs behind them; in the last step, where a few pairs meet many lags, lanes are lags.
 */
#include "gcc_phat.h"
#include "spectrum_path.h"

#include <float.h>

/* 1 / sqrt(x) for x >= 0, finite: the first guess from the exponent's bits (Lomont 2003, "Fast inverse
 * square root"), good to 3.4 %, times the cubic in h = x guess^2 that is nearest to 1 / sqrt(h) for the h
 * that occur (0.932 to 1.069): 7.5e-7. At zero the answer is finite. */
INLINE vec inverse_root(vec x)
{
    vec guess = (vec)(0x5f3759df - ((ivec)x >> 1));
    vec h = x * guess * guess;
    return guess * (2.18936135f + h * (-2.19180671f + h * (1.31552748f - 0.31308287f * h)));
}

/* X -> X / sqrt(|X|^2 + floor). Returns the sums of what is left of the squared magnitudes, at most 1 a bin. */
STEP quad whiten(const state *s, quad floor, spectrum bins)
{
    vec floors = both(floor), left = {0};
    long end = 4 * ((s->spectrum.last_bin | 1L) + 1);
    for (long at = 4 * (s->spectrum.first_bin & ~1L); at < end; at += WIDTH) {
        vec re = load(bins.re + at), im = load(bins.im + at);
        vec power = re * re + im * im;
        vec scale = inverse_root(power + floors);
        left += power * scale * scale;
        store(bins.re + at, re * scale);
        store(bins.im + at, im * scale);
    }
    return folded(left);
}

/* Unit bins of one group of up to four microphones; returns the mask of those that are not finite. */
INLINE int unit_bins(const state *s, const float *in, int group, float *power)
{
    /* Half of the range is left for the floor. */
    quad sum;
    int bad = group_bins(&s->spectrum, in, group, FLT_MAX / 2, &sum);
    quad floor = sum * (s->relative_floor * s->bin_share);
    for (int lane = 0; lane < 4; lane++)
        floor[lane] = floor[lane] > s->floor ? floor[lane] : s->floor;
    quad left = whiten(s, floor, (spectrum){s->spectrum.bins_re[group], s->spectrum.bins_im[group]});
    for (int lane = 0; lane < 4 && 4 * group + lane < s->spectrum.mics; lane++) {
        power[4 * group + lane] = sum[lane];
        power[s->spectrum.mics + 4 * group + lane] = left[lane] * s->bin_share;
    }
    return bad;
}

INLINE vec turned(vec v, const enum turn turn)
{
    switch (turn) {
    case TURN_RING3:
        return SHUFFLED(v, v, 1, 2, 0, 3);
    case TURN_1:
        return SHUFFLED(v, v, 1, 2, 3, 0);
    case TURN_2:
        return SHUFFLED(v, v, 2, 3, 0, 1);
    case TURN_3:
        return SHUFFLED(v, v, 3, 0, 1, 2);
    default:
        return v;
    }
}

/* U_j conj(U_i) of up to four pairs: a delay of j turns it by exp(-i omega tau). */
INLINE void product(spectrum i, spectrum j, long at, const enum turn turn, vec *re, vec *im)
{
    vec ir = load(i.re + at), ii = load(i.im + at);
    vec jr = turned(load(j.re + at), turn), ji = turned(load(j.im + at), turn);
    *re = jr * ir + ji * ii;
    *im = ji * ir - jr * ii;
}

/* The product of two groups, thinned out to coarse bins. */
INLINE void coarse_bins(const state *s, spectrum i, spectrum j, const enum turn turn, quad direction,
                        spectrum coarse)
{
    long first = s->spectrum.first_bin & ~1L, end = (s->spectrum.last_bin | 1L) + 1;
    if (s->decimation == 1) {
        for (long k = first; k < end; k += QUADS) {
            vec re, im;
            product(i, j, 4 * k, turn, &re, &im);
            store(coarse.re + 4 * (k - first), re);
            store(coarse.im + 4 * (k - first), im * both(direction));
        }
        return;
    }
    long decimation = s->decimation;
    vec sum_re[TAPS] = {0}, sum_im[TAPS] = {0};
    float *to_re = coarse.re, *to_im = coarse.im;
    for (long block = first & -decimation; block < end; block += decimation, to_re += 4, to_im += 4) {
        long from = block > first ? block : first, till = block + decimation < end ? block + decimation : end;
#pragma GCC unroll 2 /* a step is 23 instructions, 3 of them the loop's: measured 3 % of the whole frame */
        for (long k = from; k < till; k += QUADS) {
            const float *weight = s->weights + 4 * (k - block);
            vec re, im;
            product(i, j, 4 * k, turn, &re, &im);
            for (int tap = 0; tap < TAPS; tap++, weight += 4 * decimation) {
                sum_re[tap] += load(weight) * re;
                sum_im[tap] += load(weight) * im;
            }
        }
        /* The blocks to come no longer reach the first of the coarse bins; the others move up. */
        store_quad(to_re, folded(sum_re[0]));
        store_quad(to_im, folded(sum_im[0]) * direction);
        for (int tap = 1; tap < TAPS; tap++)
            sum_re[tap - 1] = sum_re[tap], sum_im[tap - 1] = sum_im[tap];
        sum_re[TAPS - 1] = sum_im[TAPS - 1] = all(0.0f);
    }
    for (int tap = 0; tap < TAPS - 1; tap++, to_re += 4, to_im += 4) {
        store_quad(to_re, folded(sum_re[tap]));
        store_quad(to_im, folded(sum_im[tap]) * direction);
    }
}

#define COARSE_BINS(name, turn)                                                                              \
    STEP void name(const state *s, spectrum i, spectrum j, quad direction, spectrum coarse)                  \
    {                                                                                                        \
        coarse_bins(s, i, j, turn, direction, coarse);                                                       \
    }
COARSE_BINS(coarse_bins_ring3, TURN_RING3)
COARSE_BINS(coarse_bins_0, TURN_0)
COARSE_BINS(coarse_bins_1, TURN_1)
COARSE_BINS(coarse_bins_2, TURN_2)
COARSE_BINS(coarse_bins_3, TURN_3)
static void (*const COARSE_BINS_OF[TURNS])(const state *, spectrum, spectrum, quad, spectrum) = {
    [TURN_RING3] = coarse_bins_ring3, [TURN_0] = coarse_bins_0, [TURN_1] = coarse_bins_1,
    [TURN_2] = coarse_bins_2,         [TURN_3] = coarse_bins_3,
};

STEP void turn_coarse(const state *s, const float *phasors, spectrum coarse)
{
    for (long c = 0; c < s->coarse; c++) {
        quad re = load_quad(coarse.re + 4 * c), im = load_quad(coarse.im + 4 * c);
        store_quad(coarse.re + 4 * c, re * phasors[2 * c] - im * phasors[2 * c + 1]);
        store_quad(coarse.im + 4 * c, re * phasors[2 * c + 1] + im * phasors[2 * c]);
    }
}

/* One block of lags of PAIRS pairs. Lags +l and -l share the even part E = sum Re(S) cos and the odd part
 * O = sum Im(S) sin: r(+l) = E - O, r(-l) = E + O. */
INLINE void lags_of(const int PAIRS, const state *s, long centre, const int32_t *lane, const int32_t *row,
                    spectrum coarse, float *out)
{
    enum { MIDDLE = BLOCK_HALF + 1 };
    float both_sides[3][2 * MIDDLE];
    for (long l = 0; l < s->table_lags; l += 2 * WIDTH) {
        vec even[3][2] = {0}, odd[3][2] = {0};
        const float *table = s->table + l;
        for (long c = 0; c < s->coarse; c++, table += 2 * s->table_lags) {
            vec cos0 = load(table), cos1 = load(table + WIDTH);
            vec sin0 = load(table + s->table_lags), sin1 = load(table + s->table_lags + WIDTH);
            for (int n = 0; n < PAIRS; n++) {
                float re = coarse.re[4 * c + lane[n]], im = coarse.im[4 * c + lane[n]];
                even[n][0] += re * cos0, even[n][1] += re * cos1;
                odd[n][0] += im * sin0, odd[n][1] += im * sin1;
            }
        }
        for (int n = 0; n < PAIRS; n++)
            for (int v = 0; v < 2; v++) {
                long lag = l + v * WIDTH;
                store(&both_sides[n][MIDDLE + lag], even[n][v] - odd[n][v]);
                store(&both_sides[n][MIDDLE - lag - (WIDTH - 1)], reversed(even[n][v] + odd[n][v]));
            }
    }
    long count = 2 * (long)s->lags + 1, middle = s->lags + centre;
    long from = middle - s->half > 0 ? middle - s->half : 0;
    long till = middle + s->half + 1 < count ? middle + s->half + 1 : count;
    for (int n = 0; n < PAIRS; n++) {
        float *to = out + row[n] * count;
        for (long l = from; l < till; l++)
            to[l] = both_sides[n][MIDDLE + l - middle] * s->gain[l];
    }
}

#define LAGS_OF(name, PAIRS)                                                                                 \
    STEP void name(const state *s, long centre, const int32_t *lane, const int32_t *row, spectrum coarse,    \
                   float *out)                                                                               \
    {                                                                                                        \
        lags_of(PAIRS, s, centre, lane, row, coarse, out);                                                   \
    }
LAGS_OF(lags_of_1, 1)
LAGS_OF(lags_of_2, 2)
LAGS_OF(lags_of_3, 3)

INLINE void lags(const state *s, const locagen_product *p, spectrum coarse, float *out)
{
    if (s->blocks > 1)
        turn_coarse(s, s->start, coarse);
    for (long block = 0; block < s->blocks; block++) {
        long centre = (block - s->blocks / 2) * (2 * BLOCK_HALF + 1);
        if (block > 0)
            turn_coarse(s, s->step, coarse);
        /* Three pairs fill sixteen registers with sums; four go two by two. */
        if (p->pairs == 1)
            lags_of_1(s, centre, p->lane, p->row, coarse, out);
        else if (p->pairs == 3)
            lags_of_3(s, centre, p->lane, p->row, coarse, out);
        else
            for (int n = 0; n < p->pairs; n += 2)
                lags_of_2(s, centre, p->lane + n, p->row + n, coarse, out);
    }
}

INLINE int frame_path(const state *s, const float *in, float *correlation, float *power)
{
    spectrum coarse = {s->coarse_re, s->coarse_im};
    int bad = 0;
    for (int group = 0; group < s->spectrum.groups; group++)
        bad |= unit_bins(s, in, group, power) << 4 * group;
    for (int n = 0; n < s->products; n++) {
        const locagen_product *p = &s->product[n];
        spectrum i = {s->spectrum.bins_re[p->group_i], s->spectrum.bins_im[p->group_i]};
        spectrum j = {s->spectrum.bins_re[p->group_j], s->spectrum.bins_im[p->group_j]};
        quad direction = load_quad(p->direction);
        COARSE_BINS_OF[p->turn](s, i, j, direction, coarse);
        lags(s, p, coarse, correlation);
    }
    return bad;
}
