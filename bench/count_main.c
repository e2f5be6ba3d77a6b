/* count_main.c - runs the kernel, or FFTW's bare transforms, so often as it is told; counted from outside.
 *
 * Built by bench_instructions.py together with kernel_vs_fftw.c: count_main {kernel|fftw} FRAMES
 * MICS FRAME LAGS OVERSAMPLE RATE BAND_LOW BAND_HIGH FLOOR RELATIVE_FLOOR
 */
#include "locagen.h"

#include <stdlib.h>
#include <string.h>

int bench_kernel_init(const locagen_gcc_config *config, const float *in);
double bench_kernel(int calls);
int bench_fftw_init(int mics, int frame, const float *in);
double bench_fftw(int calls);

int main(int argc, char **argv)
{
    if (argc != 12)
        return 2;
    int frames = atoi(argv[2]);
    locagen_gcc_config config = {
        .mics = atoi(argv[3]), .frame = atoi(argv[4]), .lags = atoi(argv[5]), .oversample = atoi(argv[6]),
        .rate_hz = strtof(argv[7], NULL), .band_low_hz = strtof(argv[8], NULL), .band_high_hz = strtof(argv[9], NULL),
        .floor = strtof(argv[10], NULL), .relative_floor = strtof(argv[11], NULL),
    };
    size_t samples = (size_t)config.mics * (size_t)config.frame;
    float *in = malloc(sizeof(float) * samples);
    if (in == NULL)
        return 1;
    uint32_t state = 1; /* noise: no branch of ours, and none of FFTW's, depends on what it is */
    for (size_t n = 0; n < samples; n++) {
        state = 1664525u * state + 1013904223u;
        in[n] = (float)(int32_t)state * 0x1p-34f;
    }
    if (strcmp(argv[1], "kernel") == 0)
        return bench_kernel_init(&config, in) != 0 || bench_kernel(frames) < 0.0;
    return bench_fftw_init(config.mics, config.frame, in) != 0 || bench_fftw(frames) < 0.0;
}
