/* fft.c - the tables of the real FFT, computed once in double precision. */
#include "fft.h"

#include <math.h>

static const double TWO_PI = 6.283185307179586476925;

/* Largest radix first: fewer passes mean fewer trips through the cache. 128 = 8*4*4, 256 = 8*8*4,
 * 512 = 8*8*8, 1024 = 8*8*4*4, 2048 = 8*8*8*4: the passes of radix 4 come last. */
static int32_t radices(int32_t points, int32_t radix[LOCAGEN_FFT_PASSES])
{
    int32_t passes = 0;
    int32_t eights = 0;
    int32_t bits = 0;
    while ((INT32_C(1) << bits) < points)
        bits++;
    while ((bits - 3 * eights) % 2 != 0 || bits - 3 * eights > 4)
        eights++;
    for (; passes < eights; passes++)
        radix[passes] = 8;
    for (int32_t left = bits - 3 * eights; left > 0; left -= 2)
        radix[passes++] = 4;
    return passes;
}

static void put(float *re, float *im, double turns, int copies)
{
    for (int i = 0; i < copies; i++) {
        re[i] = (float)cos(TWO_PI * turns);
        im[i] = (float)sin(TWO_PI * turns);
    }
}

size_t locagen_fft_floats(int32_t frame)
{
    size_t points = (size_t)frame / 2;
    int32_t radix[LOCAGEN_FFT_PASSES];
    int32_t passes = radices(frame / 2, radix);
    size_t floats = (size_t)frame + points / 8 * 7 * 8; /* window, first */
    size_t left = points / 8;
    for (int32_t pass = 1; pass < passes - 1; pass++) {
        left /= (size_t)radix[pass];
        floats += left * (size_t)(radix[pass] - 1) * 2;
    }
    return floats + (points / 2 + 2) * 8; /* parting */
}

double locagen_window(int32_t n, int32_t frame, double taper)
{
    double flank = taper * frame / 2, from_edge = n < frame - n ? n : frame - n;
    return from_edge < flank ? 0.5 - 0.5 * cos(TWO_PI / 2 * from_edge / flank) : 1;
}

void locagen_fft_init(locagen_fft *fft, int32_t frame, double taper, float *memory)
{
    /* 2 / (N sum(w^2)) |X|^2, and a half for the parting of the real bins. */
    double squares = 0;
    for (int32_t n = 0; n < frame; n++)
        squares += pow(locagen_window(n, frame, taper), 2);
    double gain = 0.5 * sqrt(2 / (frame * squares));

    fft->points = frame / 2;
    fft->passes = radices(fft->points, fft->radix);
    float *next = memory;

    fft->window = next;
    for (int32_t n = 0; n < frame; n++)
        *next++ = (float)(gain * locagen_window(n, frame, taper));

    /* Points come from the samples in the order 0, 2, 1, 3 of each four (see fetch in fft_passes.h);
     * the twiddles stand in that order, two points side by side, every one four times. */
    fft->first = next;
    for (int32_t place = 0; place < fft->points / 8; place++) {
        int32_t p = (place & ~3) + ((place & 1) << 1) + ((place >> 1) & 1);
        for (int32_t j = 1; j < 8; j++) {
            float *twiddle = next + (place >> 1) * 7 * 16 + (j - 1) * 16 + (place & 1) * 4;
            put(twiddle, twiddle + 8, -(double)(p * j) / fft->points, 4);
        }
    }
    next += fft->points / 8 * 7 * 8;

    int32_t length = fft->points / 8;
    for (int32_t pass = 1; pass < fft->passes - 1; pass++) {
        int32_t radix = fft->radix[pass];
        fft->middle[pass] = next;
        for (int32_t p = 0; p < length / radix; p++)
            for (int32_t j = 1; j < radix; j++, next += 2)
                put(next, next + 1, -(double)(p * j) / length, 1);
        length /= radix;
    }

    fft->parting = next;
    for (int32_t k = 0; k < fft->points / 2 + 2; k++) {
        float *quads = next + (k >> 1) * 16 + (k & 1) * 4;
        put(quads, quads + 8, 0.25 - (double)k / frame, 4);
    }
}
