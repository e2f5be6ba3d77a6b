/* fft_passes.h - the real FFT of four microphones at once, one per lane.
 *
 * Spectra are kept as quads: float re[4 * k + lane], and im likewise. The window and the turn from
 * rows of samples to lanes happen while the first pass loads. Twiddle tables hold every number four
 * times where a vector spans two points, once where it does not.
 */
#ifndef LOCAGEN_FFT_PASSES_H
#define LOCAGEN_FFT_PASSES_H
#include "fft.h"
#include "lanes.h"

typedef struct {
    float *re;
    float *im;
} spectrum;

INLINE void dft4(vec re[4], vec im[4])
{
    vec sr = re[0] + re[2], si = im[0] + im[2], dr = re[0] - re[2], di = im[0] - im[2];
    vec tr = re[1] + re[3], ti = im[1] + im[3], er = re[1] - re[3], ei = im[1] - im[3];
    re[0] = sr + tr, im[0] = si + ti;
    re[1] = dr + ei, im[1] = di - er;
    re[2] = sr - tr, im[2] = si - ti;
    re[3] = dr - ei, im[3] = di + er;
}

/* The even outputs of radix 8, 0 2 4 6, in a[0..3]. Odd and even ones are made one after the other, each
 * from the eight inputs: sixteen registers hold one half, not both. */
INLINE void dft8_even(const vec re[8], const vec im[8], vec ar[4], vec ai[4])
{
    for (int j = 0; j < 4; j++)
        ar[j] = re[j] + re[j + 4], ai[j] = im[j] + im[j + 4];
    dft4(ar, ai);
}

/* The odd outputs, 1 3 5 7: the differences turn by 0, 1/8, 2/8, 3/8; the root of one half is left to the last
 * additions, where it joins a fused multiply-add. */
INLINE void dft8_odd(const vec re[8], const vec im[8], vec ar[4], vec ai[4])
{
    const float half_root = 0.70710678118654752f;
    vec dr[4], di[4];
    for (int j = 0; j < 4; j++)
        dr[j] = re[j] - re[j + 4], di[j] = im[j] - im[j + 4];
    vec ur = dr[1] + di[1], ui = di[1] - dr[1], vr = di[3] - dr[3], vi = dr[3] + di[3];
    vec pr = dr[0] + di[2], pi = di[0] - dr[2], qr = dr[0] - di[2], qi = di[0] + dr[2];
    vec sr = ur + vr, si = ui - vi, tr = ui + vi, ti = vr - ur;
    ar[0] = pr + half_root * sr, ai[0] = pi + half_root * si;
    ar[1] = qr + half_root * tr, ai[1] = qi + half_root * ti;
    ar[2] = pr - half_root * sr, ai[2] = pi - half_root * si;
    ar[3] = qr - half_root * tr, ai[3] = qi - half_root * ti;
}

INLINE void times(vec *re, vec *im, vec wr, vec wi)
{
    vec r = *re * wr - *im * wi;
    *im = *re * wi + *im * wr;
    *re = r;
}

/* WIDTH samples of four rows, times the window, as two vectors of complex points: from sample s on, the
 * first holds the point (s, s + 1), the second (s + 2, s + 3); eight wide, (s + 4, s + 5) and (s + 6, s + 7)
 * follow in the upper halves. */
INLINE void fetch(const float *const rows[4], const float *window, long s, vec re[2], vec im[2])
{
    vec w = load(window + s);
    vec a = load(rows[0] + s) * w, b = load(rows[1] + s) * w;
    vec c = load(rows[2] + s) * w, d = load(rows[3] + s) * w;
    vec ab = SHUFFLED(a, b, 0, 4, 1, 5), cd = SHUFFLED(c, d, 0, 4, 1, 5);
    re[0] = SHUFFLED(ab, cd, 0, 1, 4, 5);
    im[0] = SHUFFLED(ab, cd, 2, 3, 6, 7);
    ab = SHUFFLED(a, b, 2, 6, 3, 7), cd = SHUFFLED(c, d, 2, 6, 3, 7);
    re[1] = SHUFFLED(ab, cd, 0, 1, 4, 5);
    im[1] = SHUFFLED(ab, cd, 2, 3, 6, 7);
}

/* The even or odd outputs of a butterfly of the first pass, turned by their twiddles. */
INLINE void first_half(const int odd, const float *w, vec ar[4], vec ai[4], spectrum to, long at)
{
    for (int n = 0; n < 4; n++) {
        int j = 2 * n + odd;
        if (j > 0)
            times(&ar[n], &ai[n], load(w + 16 * (j - 1)), load(w + 16 * (j - 1) + 8));
        store_apart(to.re + 4 * (at + j), 4 * 8 * 2, ar[n]);
        store_apart(to.im + 4 * (at + j), 4 * 8 * 2, ai[n]);
    }
}

STEP void first_pass(const locagen_fft *fft, const float *const rows[4], spectrum to)
{
    long eighth = fft->points / 8;
    for (long p = 0; p < eighth; p += WIDTH / 2) {
        vec re[2][8], im[2][8];
        for (int j = 0; j < 8; j++) {
            vec r[2], i[2];
            fetch(rows, fft->window, 2 * (p + j * eighth), r, i);
            re[0][j] = r[0], im[0][j] = i[0];
            re[1][j] = r[1], im[1][j] = i[1];
        }
        for (int e = 0; e < 2; e++) {
            long place = (p & ~3L) + 2 * e + ((p >> 1) & 1);
            const float *w = fft->first + (place >> 1) * 7 * 16 + (place & 1) * 4;
            vec ar[4], ai[4];
            dft8_even(re[e], im[e], ar, ai);
            first_half(0, w, ar, ai, to, 8 * (p + e));
            dft8_odd(re[e], im[e], ar, ai);
            first_half(1, w, ar, ai, to, 8 * (p + e));
        }
    }
}

/* The inputs of a butterfly, `apart` points from each other. */
INLINE void gather(const int R, spectrum from, long at, long apart, vec re[8], vec im[8])
{
    for (int j = 0; j < R; j++) {
        re[j] = load(from.re + 4 * (at + apart * j));
        im[j] = load(from.im + 4 * (at + apart * j));
    }
}

/* Four of its outputs, every `step`-th from `first` on. */
INLINE void scatter(const int first, const int step, const float *twiddles, vec ar[4], vec ai[4],
                    spectrum to, long at, long apart)
{
    for (int n = 0; n < 4; n++) {
        int j = first + step * n;
        if (j > 0 && twiddles != NULL)
            times(&ar[n], &ai[n], all(twiddles[2 * j - 2]), all(twiddles[2 * j - 1]));
        store(to.re + 4 * (at + apart * j), ar[n]);
        store(to.im + 4 * (at + apart * j), ai[n]);
    }
}

/* A pass of radix R over transforms of `length` points, `stride` of them side by side. The last one has no
 * twiddles. */
INLINE void pass(const int R, long length, long stride, const float *twiddles, spectrum from, spectrum to)
{
    long part = length / R;
    for (long p = 0; p < part; p++) {
        for (long q = 0; q < stride; q += QUADS) {
            vec re[8], im[8], ar[4], ai[4];
            gather(R, from, q + stride * p, stride * part, re, im);
            if (R == 4) {
                dft4(re, im);
                scatter(0, 1, twiddles, re, im, to, q + stride * R * p, stride);
            } else {
                dft8_even(re, im, ar, ai);
                scatter(0, 2, twiddles, ar, ai, to, q + stride * R * p, stride);
                dft8_odd(re, im, ar, ai);
                scatter(1, 2, twiddles, ar, ai, to, q + stride * R * p, stride);
            }
        }
        if (twiddles != NULL)
            twiddles += 2 * (R - 1);
    }
}

/* Parts the complex transform into the bins low..high of the real signals, and their mirror images
 * points - low..points - high: X(k) = E - t, X(points - k) = conj(E + t), with E = Z(k) + conj Z(points - k),
 * t = i w^k (Z(k) - conj Z(points - k)); the missing half is the window's. low is even. */
STEP void part(const locagen_fft *fft, long low, long high, spectrum from, spectrum to)
{
    for (long k = low; k <= high; k += QUADS) {
        long up = 4 * k, down = 4 * (fft->points - k);
        const float *w = fft->parting + (k >> 1) * 16 + (k & 1) * 4;
        vec zr = load(from.re + up), zi = load(from.im + up);
        vec mr = load_down(from.re + down), mi = load_down(from.im + down);
        vec er = zr + mr, ei = zi - mi, tr = zr - mr, ti = zi + mi;
        times(&tr, &ti, load(w), load(w + 8));
        store(to.re + up, er - tr), store(to.im + up, ei - ti);
        store_down(to.re + down, er + tr), store_down(to.im + down, -(ei + ti));
    }
}

STEP void middle8(long length, long stride, const float *twiddles, spectrum from, spectrum to)
{
    if (stride == 8)
        pass(8, length, 8, twiddles, from, to);
    else
        pass(8, length, stride, twiddles, from, to);
}

STEP void middle4(long length, long stride, const float *twiddles, spectrum from, spectrum to)
{
    pass(4, length, stride, twiddles, from, to);
}

STEP void last8(long stride, spectrum from, spectrum to)
{
    pass(8, 8, stride, NULL, from, to);
}

STEP void last4(long stride, spectrum from, spectrum to)
{
    pass(4, 4, stride, NULL, from, to);
}

/* From rows of samples to bins low..high and their mirror images, in `to`; `work` is lost. Both hold
 * points + 2 quads. */
INLINE void real_fft(const locagen_fft *fft, const float *const rows[4], long low, long high, spectrum work,
                     spectrum to)
{
    spectrum a = fft->passes % 2 ? work : to, b = fft->passes % 2 ? to : work;
    first_pass(fft, rows, a);
    long length = fft->points / 8, stride = 8;
    for (int n = 1; n < fft->passes; n++) {
        int radix = fft->radix[n];
        if (n == fft->passes - 1)
            (radix == 8 ? last8 : last4)(stride, a, b);
        else
            (radix == 8 ? middle8 : middle4)(length, stride, fft->middle[n], a, b);
        length /= radix, stride *= radix;
        spectrum swap = a;
        a = b, b = swap;
    }
    part(fft, low, high, work, to);
}

#endif
