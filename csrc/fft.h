/* fft.h - the plan of the real FFT: sizes and tables, the same for every vector width.
 *
 * N real samples are N / 2 complex points, transformed by Stockham's self-sorting FFT (decimation in
 * frequency; Van Loan 1992, "Computational Frameworks for the Fast Fourier Transform", 1.7) in passes
 * of radix 8 and 4, and then parted into the bins of the real signal, only those of the band.
 */
#ifndef LOCAGEN_FFT_H
#define LOCAGEN_FFT_H
#include <stddef.h>
#include <stdint.h>

enum { LOCAGEN_FFT_PASSES = 4 };

typedef struct {
    int32_t points;                    /* complex points: half the frame */
    int32_t passes;
    int32_t radix[LOCAGEN_FFT_PASSES]; /* 8 first; 8 or 4 after it */
    float *window;                     /* one factor per sample */
    float *first;                      /* twiddles of the first pass: see fft_passes.h */
    float *middle[LOCAGEN_FFT_PASSES]; /* of the passes between: points * (radix - 1) complex numbers */
    float *parting;                    /* i exp(-2 pi i k / N), in quads: 4 equal floats, re and im apart */
} locagen_fft;

/* Floats of table for a frame of this many samples. */
size_t locagen_fft_floats(int32_t frame);

/* Tukey's window, periodic: a share `taper` of it are cosine flanks; 1 is Hann's. */
double locagen_window(int32_t n, int32_t frame, double taper);

/* Lays the tables into `memory`. The window is locagen_window, scaled so that the squared magnitude of a bin
 * is its power: those of a full-scale sine add up to a half. */
void locagen_fft_init(locagen_fft *fft, int32_t frame, double taper, float *memory);

#endif
