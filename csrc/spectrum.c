/* spectrum.c - set-up of the way from samples to bins. */
#include "spectrum.h"

#include <float.h>
#include <math.h>

float *locagen_take(locagen_arena *a, size_t floats)
{
    float *at = a->base ? (float *)(void *)(a->base + a->used) : NULL;
    a->used += (floats * sizeof(float) + LOCAGEN_LINE - 1) / LOCAGEN_LINE * LOCAGEN_LINE;
    return at;
}

void *locagen_aligned(const void *memory)
{
    return (void *)(((uintptr_t)memory + LOCAGEN_LINE - 1) & ~(uintptr_t)(LOCAGEN_LINE - 1));
}

int locagen_spectrum_check(int32_t mics, int32_t frame, float rate_hz, float low_hz, float high_hz)
{
    if (mics < 2 || mics > 8)
        return LOCAGEN_E_MICS;
    if (frame < 256 || frame > 4096 || (frame & (frame - 1)) != 0)
        return LOCAGEN_E_FRAME;
    if (!(rate_hz > 0.0f && rate_hz <= FLT_MAX))
        return LOCAGEN_E_RATE;
    if (!(low_hz > 0.0f && low_hz < high_hz && high_hz < rate_hz / 2))
        return LOCAGEN_E_BAND;
    double bins_per_hz = frame / (double)rate_hz;
    if (floor(high_hz * bins_per_hz) - ceil(low_hz * bins_per_hz) + 1 < 8)
        return LOCAGEN_E_BAND;
    return LOCAGEN_OK;
}

void locagen_spectrum_lay_out(locagen_spectrum *s, int32_t mics, int32_t frame, float rate_hz, float low_hz,
                              float high_hz, locagen_arena *arena)
{
    double bins_per_hz = frame / (double)rate_hz;
    int32_t points = frame / 2;
    s->mics = mics;
    s->groups = (mics + 3) / 4;
    s->samples = frame;
    s->first_bin = (int32_t)ceil(low_hz * bins_per_hz);
    s->last_bin = (int32_t)floor(high_hz * bins_per_hz);
    int32_t mirror_first = points - s->last_bin, mirror_last = points - s->first_bin;
    s->part_low = (s->first_bin < mirror_first ? s->first_bin : mirror_first) & ~1;
    s->part_high = s->last_bin < mirror_last ? s->last_bin : mirror_last;
    if (s->part_high > points / 2)
        s->part_high = points / 2;

    size_t quads = 4 * (size_t)(points + 2);
    s->work_re = locagen_take(arena, quads), s->work_im = locagen_take(arena, quads);
    for (int group = 0; group < s->groups; group++)
        s->bins_re[group] = locagen_take(arena, quads), s->bins_im[group] = locagen_take(arena, quads);
    s->tables = locagen_take(arena, locagen_fft_floats(frame));
}

void locagen_spectrum_init(locagen_spectrum *s, double taper)
{
    locagen_fft_init(&s->fft, s->samples, taper, s->tables);
}
