/* spectrum_path.h - from the samples of up to four microphones to the bins of their band, in quads. */
#ifndef LOCAGEN_SPECTRUM_PATH_H
#define LOCAGEN_SPECTRUM_PATH_H
#include "fft_passes.h"
#include "spectrum.h"

/* Sum over the band of each lane's squared magnitudes. */
STEP quad band_power(const locagen_spectrum *s, spectrum bins)
{
    /* Four sums: one alone would wait for each addition to end. */
    vec sum[4] = {0};
    long at = 4 * (s->first_bin & ~1L), end = 4 * ((s->last_bin | 1L) + 1);
    for (; at + 2 * WIDTH <= end; at += 2 * WIDTH)
        for (int n = 0; n < 2; n++) {
            vec re = load(bins.re + at + n * WIDTH), im = load(bins.im + at + n * WIDTH);
            sum[2 * n] += re * re;
            sum[2 * n + 1] += im * im;
        }
    for (; at < end; at += WIDTH) {
        vec re = load(bins.re + at), im = load(bins.im + at);
        sum[0] += re * re;
        sum[1] += im * im;
    }
    return folded((sum[0] + sum[1]) + (sum[2] + sum[3]));
}

INLINE void clear_lane(spectrum bins, long first, long last, int lane)
{
    for (long k = first; k <= last; k++)
        bins.re[4 * k + lane] = bins.im[4 * k + lane] = 0.0f;
}

/* Bins of one group of microphones and their power in the band; returns the mask of those whose power is not
 * below `most` (NaN is not): their bins and power are zero. */
INLINE int group_bins(const locagen_spectrum *s, const float *in, int group, float most, quad *power)
{
    spectrum work = {s->work_re, s->work_im}, bins = {s->bins_re[group], s->bins_im[group]};
    int mics = s->mics - 4 * group < 4 ? s->mics - 4 * group : 4;
    /* A lane without a microphone repeats the first one, which is in memory anyhow; nobody reads it. */
    const float *rows[4];
    for (int lane = 0; lane < 4; lane++)
        rows[lane] = in + (4 * group + (lane < mics ? lane : 0)) * (long)s->samples;
    real_fft(&s->fft, rows, s->part_low, s->part_high, work, bins);

    long first = s->first_bin & ~1L, last = s->last_bin | 1L;
    for (int lane = 0; lane < 4; lane++) { /* neighbours outside the band that share a vector with it */
        if (first < s->first_bin)
            clear_lane(bins, first, first, lane);
        if (last > s->last_bin)
            clear_lane(bins, last, last, lane);
    }
    *power = band_power(s, bins);
    int bad = 0;
    for (int lane = 0; lane < mics; lane++)
        if (!((*power)[lane] < most)) {
            bad |= 1 << lane;
            (*power)[lane] = 0.0f;
            clear_lane(bins, first, last, lane);
        }
    return bad;
}

#endif
