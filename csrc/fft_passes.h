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

INLINE void dft8(vec re[8], vec im[8])
{
    const float half_root = 0.70710678118654752f;
    vec ar[4], ai[4], dr[4], di[4];
    for (int j = 0; j < 4; j++) {
        ar[j] = re[j] + re[j + 4], ai[j] = im[j] + im[j + 4];
        dr[j] = re[j] - re[j + 4], di[j] = im[j] - im[j + 4];
    }
    dft4(ar, ai);
    /* The differences turn by 0, 1/8, 2/8, 3/8; the root of one half is left to the last additions,
     * where it joins a fused multiply-add. */
    vec ur = dr[1] + di[1], ui = di[1] - dr[1], vr = di[3] - dr[3], vi = dr[3] + di[3];
    vec pr = dr[0] + di[2], pi = di[0] - dr[2], qr = dr[0] - di[2], qi = di[0] + dr[2];
    vec sr = ur + vr, si = ui - vi, tr = ui + vi, ti = vr - ur;
    for (int j = 0; j < 4; j++)
        re[2 * j] = ar[j], im[2 * j] = ai[j];
    re[1] = pr + half_root * sr, im[1] = pi + half_root * si;
    re[5] = pr - half_root * sr, im[5] = pi - half_root * si;
    re[3] = qr + half_root * tr, im[3] = qi + half_root * ti;
    re[7] = qr - half_root * tr, im[7] = qi - half_root * ti;
}

INLINE void times(vec *re, vec *im, vec wr, vec wi)
{
    vec r = *re * wr - *im * wi;
    *im = *re * wi + *im * wr;
    *re = r;
}

/* WIDTH samples of four rows, times the window, as two vectors of complex points: with samples s, s + 1 ..
 * the first holds (s, s + 1) and, eight lanes wide, (s + 4, s + 5); the second (s + 2, s + 3), (s + 6, s + 7). */
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

INLINE void first_pass(const locagen_fft *fft, const float *const rows[4], spectrum to)
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
            dft8(re[e], im[e]);
            for (int j = 1; j < 8; j++)
                times(&re[e][j], &im[e][j], load(w + 16 * (j - 1)), load(w + 16 * (j - 1) + 8));
            for (int j = 0; j < 8; j++) {
                store_apart(to.re + 4 * (8 * (p + e) + j), 4 * 8 * 2, re[e][j]);
                store_apart(to.im + 4 * (8 * (p + e) + j), 4 * 8 * 2, im[e][j]);
            }
        }
    }
}

/* A pass of radix R over transforms of `length` points, `stride` of them side by side. */
INLINE void pass(const int R, const int last, long length, long stride, const float *twiddles, spectrum from, spectrum to)
{
    long part = length / R;
    for (long p = 0; p < part; p++, twiddles += 2 * (R - 1))
        for (long q = 0; q < stride; q += QUADS) {
            vec re[8], im[8];
            for (int j = 0; j < R; j++) {
                long at = 4 * (q + stride * (p + part * j));
                re[j] = load(from.re + at), im[j] = load(from.im + at);
            }
            if (R == 8)
                dft8(re, im);
            else
                dft4(re, im);
            for (int j = 0; j < R; j++) {
                long at = 4 * (q + stride * (R * p + j));
                if (j > 0 && !last)
                    times(&re[j], &im[j], all(twiddles[2 * j - 2]), all(twiddles[2 * j - 1]));
                store(to.re + at, re[j]), store(to.im + at, im[j]);
            }
        }
}

/* Parts the complex transform into the bins low..high of the real signals, and their mirror images
 * points - low..points - high: X(k) = E - t, X(points - k) = conj(E + t), with E = Z(k) + conj Z(points - k),
 * t = i w^k (Z(k) - conj Z(points - k)); the missing half is the window's. low is even. */
INLINE void part(const locagen_fft *fft, long low, long high, spectrum from, spectrum to)
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

/* From rows of samples to bins low..high and their mirror images, in `to`; `work` is lost. Both hold
 * points + 2 quads. */
INLINE void real_fft(const locagen_fft *fft, const float *const rows[4], long low, long high, spectrum work, spectrum to)
{
    spectrum a = fft->passes % 2 ? work : to, b = fft->passes % 2 ? to : work;
    first_pass(fft, rows, a);
    long length = fft->points / 8, stride = 8;
    for (int n = 1; n < fft->passes; n++) {
        int radix = fft->radix[n];
        if (n == fft->passes - 1) {
            if (radix == 8)
                pass(8, 1, length, stride, NULL, a, b);
            else
                pass(4, 1, length, stride, NULL, a, b);
        } else if (radix == 8)
            pass(8, 0, length, stride, fft->middle[n], a, b);
        else
            pass(4, 0, length, stride, fft->middle[n], a, b);
        length /= radix, stride *= radix;
        spectrum swap = a;
        a = b, b = swap;
    }
    part(fft, low, high, work, to);
}

#endif
