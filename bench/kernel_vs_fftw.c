/* kernel_vs_fftw.c - times the kernel, called from C, and FFTW's bare transforms of the same frame.
 *
 * Built by bench_kernel.py as a shared library, with the product's own flags, and called from there, so that
 * all peers take turns in one process. FFTW is GPL: it is compared with, never linked into the product. Its
 * share is only what any FFT-based GCC-PHAT needs at least: one forward transform for each microphone and one
 * inverse for each pair, of the frame's own length, without window, whitening or a finer grid.
 */
#include "locagen.h"

#include <stdlib.h>
#include <time.h>

#ifdef WITH_FFTW
#include <fftw3.h>
#ifndef PLANNING /* another where no time can be measured (bench_instructions.py) */
#define PLANNING FFTW_MEASURE
#endif
#endif

enum { MOST_MICS = 8, MOST_PAIRS = 28 };

static double seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static locagen_gcc *kernel;
static const float *samples;
static float *correlation;
static float power[2 * MOST_MICS];

/* Sets up the kernel for frames that all hold `in`, which must stay where it is. Returns 0 or an error. */
int bench_kernel_init(const locagen_gcc_config *config, const float *in)
{
    size_t values = (size_t)(config->mics * (config->mics - 1) / 2) * (size_t)(2 * config->lags + 1);
    free(kernel);
    free(correlation);
    kernel = malloc(locagen_gcc_sizeof(config) + 1);
    correlation = malloc(sizeof(float) * values);
    samples = in;
    return kernel == NULL || correlation == NULL ? LOCAGEN_E_NULL : locagen_gcc_init(kernel, config);
}

/* Seconds for one frame, the mean of `calls`. */
double bench_kernel(int calls)
{
    double start = seconds();
    for (int n = 0; n < calls; n++)
        locagen_gcc_process(kernel, samples, correlation, power);
    return (seconds() - start) / calls;
}

#ifdef WITH_FFTW
static fftwf_plan plans[MOST_MICS + MOST_PAIRS];
static int plan_count;

/* Samples, bins and correlations of each microphone or pair are three arrays; where there are more pairs than
 * microphones they take turns with the arrays. Returns 0, or -1 without memory. */
int bench_fftw_init(int mics, int frame, const float *in)
{
    float *time[MOST_MICS], *lags[MOST_MICS];
    fftwf_complex *bins[MOST_MICS];
    while (plan_count > 0)
        fftwf_destroy_plan(plans[--plan_count]);
    for (int m = 0; m < mics; m++) {
        time[m] = fftwf_alloc_real((size_t)frame);
        lags[m] = fftwf_alloc_real((size_t)frame);
        bins[m] = fftwf_alloc_complex((size_t)frame / 2 + 1);
        if (time[m] == NULL || lags[m] == NULL || bins[m] == NULL)
            return -1;
        plans[plan_count++] = fftwf_plan_dft_r2c_1d(frame, time[m], bins[m], PLANNING);
        for (int n = 0; n < frame; n++) /* after planning, which overwrites */
            time[m][n] = in[m * frame + n];
    }
    for (int pair = 0; pair < mics * (mics - 1) / 2; pair++)
        plans[plan_count++] = fftwf_plan_dft_c2r_1d(frame, bins[pair % mics], lags[pair % mics], PLANNING);
    return 0;
}

double bench_fftw(int calls)
{
    double start = seconds();
    for (int n = 0; n < calls; n++)
        for (int plan = 0; plan < plan_count; plan++)
            fftwf_execute(plans[plan]);
    return (seconds() - start) / calls;
}
#endif
