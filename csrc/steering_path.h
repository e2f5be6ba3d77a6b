/* steering_path.h - the score of directions; lanes are directions.
 *
 * The phases of a direction go from bin to bin by one complex product: no table but each direction's first
 * phase and step. Over 451 bins the product's rounding grows to about 1e-5, of a phase of several radians.
 */
#ifndef LOCAGEN_STEERING_PATH_H
#define LOCAGEN_STEERING_PATH_H
#include "covariance_path.h"

#include <float.h>

static int listen(steer *s, const float *in, float *power)
{
    /* 1e8: far over any full scale, and far enough under float's range for the squares to come. */
    int bad = 0;
    for (int group = 0; group < s->spectrum.groups; group++) {
        quad sum;
        bad |= group_bins(&s->spectrum, in, group, 1e8f, &sum) << 4 * group;
        for (int lane = 0; lane < 4 && 4 * group + lane < s->mics; lane++)
            power[4 * group + lane] = sum[lane];
    }
    to_planes(s);
    return bad;
}

/* q of WIDTH directions at every bin. */
INLINE void responses(const int M, const locagen_response *r, const float *phases, float *q)
{
    vec re[MOST_MICS], im[MOST_MICS], step_re[MOST_MICS], step_im[MOST_MICS];
    for (int m = 1; m < M; m++, phases += 4 * DIRECTIONS) {
        re[m] = load(phases), im[m] = load(phases + DIRECTIONS);
        step_re[m] = load(phases + 2 * DIRECTIONS), step_im[m] = load(phases + 3 * DIRECTIONS);
    }
    long stride = r->stride;
    for (long k = 0; k < r->bins; k++, q += WIDTH) {
        const float *at = r->planes + k;
        vec num = all(at[0]), den = all(at[stride]);
        at += 2 * stride;
        for (int j = 1; j < M; j++, at += 4 * stride) {
            num += at[0] * re[j] + at[stride] * im[j];
            den += at[2 * stride] * re[j] + at[3 * stride] * im[j];
        }
        for (int i = 1; i < M; i++)
            for (int j = i + 1; j < M; j++, at += 4 * stride) {
                vec c = re[i] * re[j] + im[i] * im[j], d = re[i] * im[j] - im[i] * re[j];
                num += at[0] * c + at[stride] * d;
                den += at[2 * stride] * c + at[3 * stride] * d;
            }
        store(q, num / larger(den, all(r->least)));
        for (int m = 1; m < M; m++) {
            vec turned_re = re[m] * step_re[m] - im[m] * step_im[m];
            im[m] = re[m] * step_im[m] + im[m] * step_re[m];
            re[m] = turned_re;
        }
    }
}

#define RESPONSES(M)                                                                                         \
    STEP void responses_##M(const locagen_response *r, const float *phases, float *q)          \
    {                                                                                                        \
        responses(M, r, phases, q);                                                                   \
    }
RESPONSES(2)
RESPONSES(3)
RESPONSES(4)
RESPONSES(5)
RESPONSES(6)
RESPONSES(7)
RESPONSES(8)
static void (*const RESPONSES_OF[MOST_MICS + 1])(const locagen_response *, const float *, float *) = {
    [2] = responses_2, [3] = responses_3, [4] = responses_4, [5] = responses_5,
    [6] = responses_6, [7] = responses_7, [8] = responses_8,
};

/* log x for 1 <= x < FLT_MAX: exponent and mantissa m within sqrt(1/2) to sqrt(2), log m = 2 artanh t with
 * t = (m - 1) / (m + 1), |t| < 0.172: the first term left out is 2 t^9 / 9, under 3e-8; the whole, with
 * float's rounding, is good to 2e-7 of the logarithm (measured over all exponents). */
INLINE vec logarithm(vec x)
{
    ivec bits = (ivec)x - 0x3f3504f3; /* sqrt(1/2) */
    vec exponent = __builtin_convertvector(bits >> 23, vec);
    vec m = (vec)((bits & 0x7fffff) + 0x3f3504f3);
    vec t = (m - 1.0f) / (m + 1.0f), s = t * t;
    return exponent * 0.69314718f + 2.0f * t * (1.0f + s * (1.0f / 3 + s * (1.0f / 5 + s * (1.0f / 7))));
}

/* The share of a part's looks that tells where a source is. */
INLINE vec trusted(vec over, vec calm, float theory)
{
    vec x = over * over, reach = all(REACH * REACH * theory);
    return calm * (x + reach) / (x * (calm + (1.0f - calm) * theory) + reach);
}

/* From q at every bin to the scores: the average over neighbours as a running sum, g, the sum over bins.
 * `at`: where in the spread the directions' own begins. Without `score` only the careful ones are made. */
STEP void sum_up(const locagen_response *r, enum locagen_measure measure, const locagen_spread *spread,
                 long at, const float *q, float *score, float *mean_q)
{
    const vec one = all(1.0f), most = all(1e9f); /* 90 dB: its square is finite */
    long bins = r->bins, half = r->half;
    vec plain = all(0.0f), sum = all(0.0f), careful = all(0.0f), window = all(0.0f);
    for (long k = 0; k < half; k++)
        window += load(q + k * WIDTH);
    for (long k = 0; k < bins; k++) {
        plain += load(q + k * WIDTH);
        if (measure == MEASURE_POWER)
            continue;
        if (k + half < bins)
            window += load(q + (k + half) * WIDTH);
        if (k > half)
            window -= load(q + (k - half - 1) * WIDTH);
        vec over = larger(window * r->share[k] - one, all(0.0f));
        if (spread->over)
            store(spread->over + at + k * WIDTH, -larger(-over, -most));
        vec gain = r->looks[k] * (over - logarithm(one + over));
        if (spread->calm) {
            vec calm = load(spread->calm + at + k * WIDTH);
            careful += gain * calm;
            if (score)
                gain *= trusted(over, calm, spread->theory);
        }
        sum += gain;
    }
    if (score)
        store(score, measure == MEASURE_POWER ? plain : sum);
    if (spread->careful)
        store(spread->careful + at / bins, spread->calm ? careful : sum);
    if (mean_q)
        store(mean_q, plain * (1.0f / (float)bins));
}

/* The scores that sum_up was spared, from the q that it left. */
STEP void sum_up_later(const locagen_response *r, const locagen_spread *spread, long at, float *score)
{
    vec sum = all(0.0f);
    for (long k = 0; k < r->bins; k++, at += WIDTH) {
        vec over = load(spread->seen + at);
        vec gain = r->looks[k] * (over - logarithm(all(1.0f) + over));
        sum += gain * trusted(over, load(spread->calm + at), spread->theory);
    }
    store(score, sum);
}

/* to <- keep to + share from */
STEP void blend(long count, float keep, float share, const float *from, float *to)
{
    for (long n = 0; n < count; n += WIDTH)
        store(to + n, keep * load(to + n) + share * load(from + n));
}

/* calm <- 1 / max(1, (spread + prior) / total) */
STEP void soothe(long count, float prior, float total, const float *spread, float *calm)
{
    for (long n = 0; n < count; n += WIDTH)
        store(calm + n, total / larger(load(spread + n) + prior, all(total)));
}

STEP void add_squares(long count, float scale, float most, const float *over, float *sum)
{
    for (long n = 0; n < count; n += WIDTH) {
        vec x = -larger(-load(over + n), all(-most));
        store(sum + n, load(sum + n) + scale * x * x);
    }
}

static void score_groups(const steer *s, const locagen_response *r, enum locagen_measure measure,
                         const locagen_spread *spread, const float *phases, int32_t groups, float *score,
                         float *mean_q)
{
    long at = 0;
    for (int32_t group = 0; group < groups; group++, phases += 4 * DIRECTIONS * (s->mics - 1))
        for (int lane = 0; lane < DIRECTIONS; lane += WIDTH) {
            RESPONSES_OF[s->mics](r, phases + lane, s->q);
            sum_up(r, measure, spread, at, s->q, score, mean_q);
            at += (long)r->bins * WIDTH;
            score = score ? score + WIDTH : score;
            mean_q = mean_q ? mean_q + WIDTH : mean_q;
        }
}

static void place_groups(const steer *s, const locagen_spread *spread, float *score)
{
    long step = (long)s->coarse.bins * WIDTH, all = s->groups * (long)DIRECTIONS / WIDTH;
    for (long n = 0; n < all; n++)
        sum_up_later(&s->coarse, spread, n * step, score + n * WIDTH);
}

#endif
