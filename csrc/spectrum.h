/* spectrum.h - from samples to the bins of the band: what both ways of the kernel begin with.
 *
 * Also the arena: memory that the caller brought, dealt out in cache lines; first counted, then taken.
 */
#ifndef LOCAGEN_SPECTRUM_H
#define LOCAGEN_SPECTRUM_H
#include "fft.h"
#include "locagen.h"

enum { LOCAGEN_LINE = 64 }; /* bytes of a cache line */

typedef struct {
    char *base; /* null: only count */
    size_t used;
} locagen_arena;

float *locagen_take(locagen_arena *arena, size_t floats);
void *locagen_aligned(const void *memory);

typedef struct {
    int32_t mics, groups, samples;
    int32_t first_bin, last_bin;    /* the band */
    int32_t part_low, part_high;    /* what the real FFT is asked for */
    locagen_fft fft;
    float *tables;
    float *work_re, *work_im;       /* quads */
    float *bins_re[2], *bins_im[2]; /* quads, of each group of four microphones */
} locagen_spectrum;

int locagen_spectrum_check(int32_t mics, int32_t frame, float rate_hz, float low_hz, float high_hz);

/* Sizes and places; the tables are filled by locagen_spectrum_init. The arguments have been checked. */
void locagen_spectrum_lay_out(locagen_spectrum *s, int32_t mics, int32_t frame, float rate_hz, float low_hz,
                              float high_hz, locagen_arena *arena);
void locagen_spectrum_init(locagen_spectrum *s, double taper);

#endif
