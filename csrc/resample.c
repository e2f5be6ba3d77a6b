/* resample.c - from one sample rate to another: a polyphase filter, a scalar product for each sample. */
#include "locagen.h"

#define WIDTH 4
#include "lanes.h"

enum { SUMS = LOCAGEN_TAPS / WIDTH }; /* side by side, so that none waits for the one before */

static float product(const float *a, const float *b, int32_t count)
{
    vec sum[SUMS] = {{0}};
    for (int32_t n = 0; n < count; n += LOCAGEN_TAPS)
        for (int k = 0; k < SUMS; k++)
            sum[k] += load(a + n + k * WIDTH) * load(b + n + k * WIDTH);
    for (int step = SUMS / 2; step > 0; step /= 2)
        for (int k = 0; k < step; k++)
            sum[k] += sum[k + step];
    return (sum[0][0] + sum[0][1]) + (sum[0][2] + sum[0][3]);
}

int locagen_resample(const float *table, int32_t taps, int32_t up, int32_t down, int32_t at, const float *in,
                     int32_t mics, int32_t samples, float *out, int32_t count)
{
    if (table == NULL || in == NULL || out == NULL)
        return LOCAGEN_E_NULL;
    if (taps < LOCAGEN_TAPS || taps % LOCAGEN_TAPS != 0 || up < 1 || down < 1 || at < 0 || mics < 1 ||
        count < 0)
        return LOCAGEN_E_RESAMPLE;
    int64_t last = (at + (int64_t)down * (count - 1)) / up;
    if (count > 0 && last + taps > samples)
        return LOCAGEN_E_RESAMPLE;
    int64_t place = at;
    for (int32_t n = 0; n < count; n++, place += down)
        for (int32_t m = 0; m < mics; m++)
            out[(int64_t)n * mics + m] = product(table + place % up * taps,
                                                 in + (int64_t)m * samples + place / up, taps);
    return LOCAGEN_OK;
}
