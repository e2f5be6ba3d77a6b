/* covariance_path.h - cross-spectra over time, and the matrices of the search from them; lanes are bins.
 *
 * Whitening with R_n = L D L^H (Cholesky without roots) never moves a bin: what the search needs is
 * G = R_n^-1 = L^-H D^-1 L^-1 and B = G R_x G, for |a~^H x~|^2 / (a~^H a~) of the whitened a~ and x~ is
 * a^H B a / (a^H G a). A source with whitened phases a~ is nulled by the projection I - a~ a~^H / (a~^H a~); that is
 * G - G a a^H G / (a^H G a) in the place of G, before and after R_x.
 */
#ifndef LOCAGEN_COVARIANCE_PATH_H
#define LOCAGEN_COVARIANCE_PATH_H
#include "lanes.h"
#include "steering.h"

/* From quads, lanes microphones, to planes, lanes bins. */
STEP void to_planes(const steer *s)
{
    for (int m = 0; m < s->mics; m++) {
        const float *re = s->spectrum.bins_re[m / 4] + 4 * s->spectrum.first_bin + m % 4;
        const float *im = s->spectrum.bins_im[m / 4] + 4 * s->spectrum.first_bin + m % 4;
        long at = (s->slot * (long)s->mics + m) * s->stride;
        float *to_re = s->bins_re + at, *to_im = s->bins_im + at;
        for (long k = 0; k < s->bins; k++)
            to_re[k] = re[4 * k], to_im[k] = im[4 * k];
    }
}

/* R <- keep R + share x x^H, of the microphones in the frame; the others' numbers fade as if they were
 * silent. */
STEP void add_frame(const steer *s, int32_t slot, float keep, float share, float *matrix)
{
    long stride = s->stride, frame = slot * (long)s->mics * stride;
    int mics = s->frame_mics[slot];
    float *pair = matrix + s->mics * stride;
    for (int i = 0; i < s->mics; i++) {
        const float *ir = s->bins_re + frame + i * stride, *ii = s->bins_im + frame + i * stride;
        float own = mics >> i & 1 ? share : 0.0f;
        for (long k = 0; k < stride; k += WIDTH) {
            vec re = load(ir + k), im = load(ii + k);
            store(matrix + i * stride + k, keep * load(matrix + i * stride + k) + own * (re * re + im * im));
        }
        for (int j = i + 1; j < s->mics; j++, pair += 2 * stride) {
            const float *jr = s->bins_re + frame + j * stride, *ji = s->bins_im + frame + j * stride;
            float both_of = mics >> j & 1 ? own : 0.0f;
            for (long k = 0; k < stride; k += WIDTH) {
                vec xr = load(ir + k), xi = load(ii + k), yr = load(jr + k), yi = load(ji + k);
                store(pair + k, keep * load(pair + k) + both_of * (xr * yr + xi * yi));
                store(pair + stride + k, keep * load(pair + stride + k) + both_of * (xi * yr - xr * yi));
            }
        }
    }
}

typedef struct {
    vec re, im;
} cvec;

INLINE cvec product_of(cvec a, cvec b)
{
    return (cvec){a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re};
}

/* conj(a) b */
INLINE cvec conj_product(cvec a, cvec b)
{
    return (cvec){a.re * b.re + a.im * b.im, a.re * b.im - a.im * b.re};
}

INLINE vec larger(vec a, vec b)
{
    ivec mask = a > b;
    return (vec)((mask & (ivec)a) | (~mask & (ivec)b));
}

/* A full Hermitian matrix of one vector of bins, without the rows and columns of microphones that do not
 * count. */
INLINE void fetch_matrix(const int M, const steer *s, const float *planes, float scale, int mics, long k,
                         cvec a[MOST_MICS][MOST_MICS])
{
    const float *pair = planes + s->mics * (long)s->stride + k;
    for (int i = 0; i < M; i++) {
        float own = mics >> i & 1 ? scale : 0.0f;
        a[i][i] = (cvec){own * load(planes + i * (long)s->stride + k), all(0.0f)};
        for (int j = i + 1; j < M; j++, pair += 2 * (long)s->stride) {
            float both_of = mics >> j & 1 ? own : 0.0f;
            a[i][j] = (cvec){both_of * load(pair), both_of * load(pair + s->stride)};
            a[j][i] = (cvec){a[i][j].re, -a[i][j].im};
        }
    }
}

/* a <- its inverse; a is positive definite, each pivot at least `least` but for rounding. */
INLINE void invert(const int M, float least, cvec a[MOST_MICS][MOST_MICS])
{
    cvec l[MOST_MICS][MOST_MICS]; /* below the diagonal: L, then its inverse */
    vec d[MOST_MICS], rate[MOST_MICS]; /* D, 1 / D */
    for (int j = 0; j < M; j++) {
        d[j] = a[j][j].re;
        for (int k = 0; k < j; k++)
            d[j] -= (l[j][k].re * l[j][k].re + l[j][k].im * l[j][k].im) * d[k];
        d[j] = larger(d[j], all(least));
        rate[j] = 1.0f / d[j];
        for (int i = j + 1; i < M; i++) {
            cvec sum = a[i][j];
            for (int k = 0; k < j; k++) {
                cvec t = conj_product(l[j][k], l[i][k]);
                sum.re -= t.re * d[k], sum.im -= t.im * d[k];
            }
            l[i][j] = (cvec){sum.re * rate[j], sum.im * rate[j]};
        }
    }
    for (int j = 0; j < M; j++)
        for (int i = j + 1; i < M; i++) {
            cvec sum = {-l[i][j].re, -l[i][j].im};
            for (int k = j + 1; k < i; k++) {
                cvec t = product_of(l[i][k], l[k][j]);
                sum.re -= t.re, sum.im -= t.im;
            }
            l[i][j] = sum;
        }
    for (int i = 0; i < M; i++)
        for (int j = i; j < M; j++) {
            cvec sum = {all(0.0f), all(0.0f)};
            for (int k = j; k < M; k++) {
                cvec left = k == i ? (cvec){all(1.0f), all(0.0f)} : l[k][i];
                cvec right = k == j ? (cvec){all(1.0f), all(0.0f)} : l[k][j];
                cvec t = conj_product(left, right);
                sum.re += t.re * rate[k], sum.im += t.im * rate[k];
            }
            a[i][j] = sum;
            a[j][i] = (cvec){sum.re, -sum.im};
        }
    for (int i = 0; i < M; i++)
        a[i][i].im = all(0.0f);
}

/* g <- g - g a a^H g / (a^H g a): this direction no longer counts. */
INLINE void null_source(const int M, const steer *s, int source, long k, cvec g[MOST_MICS][MOST_MICS])
{
    cvec v[MOST_MICS];
    vec den = all(0.0f);
    for (int i = 0; i < M; i++) {
        v[i] = (cvec){all(0.0f), all(0.0f)};
        for (int j = 0; j < M; j++) {
            const float *phase = s->nulls + (2 * (source * (long)s->mics + j)) * s->stride + k;
            cvec t = product_of(g[i][j], (cvec){load(phase), load(phase + s->stride)});
            v[i].re += t.re, v[i].im += t.im;
        }
        const float *phase = s->nulls + (2 * (source * (long)s->mics + i)) * s->stride + k;
        den += load(phase) * v[i].re + load(phase + s->stride) * v[i].im;
    }
    vec rate = 1.0f / larger(den, all(1e-6f));
    for (int i = 0; i < M; i++)
        for (int j = 0; j < M; j++) {
            cvec t = conj_product(v[j], v[i]);
            g[i][j].re -= t.re * rate, g[i][j].im -= t.im * rate;
        }
}

/* Of every plane of R_n the mean over smear_half bins each side, as running sums. */
STEP void smear(const steer *s)
{
    long half = s->smear_half, bins = s->bins;
    for (long plane = 0; plane < s->mics * s->mics; plane++) {
        const float *from = s->noise + plane * s->stride;
        float *to = s->smeared + plane * s->stride;
        double sum = 0;
        for (long k = 0; k < half && k < bins; k++)
            sum += (double)from[k];
        for (long k = 0; k < bins; k++) {
            long first = k - half > 0 ? k - half : 0, last = k + half < bins - 1 ? k + half : bins - 1;
            if (k + half < bins)
                sum += (double)from[k + half];
            if (k > half)
                sum -= (double)from[k - half - 1];
            to[k] = (float)(sum / (double)(last - first + 1));
        }
    }
}

/* G = R_n^-1 over the level of R_n, and 1 / level, for all searches until R_n changes. */
INLINE void invert_bins(const int M, const steer *s, const locagen_whitening *how)
{
    long stride = s->stride;
    float count = (float)__builtin_popcount((unsigned)how->mics);
    int smeared = s->smear > 0.0f && how->white == 0.0f;
    if (smeared)
        smear(s);
    for (long k = 0; k < stride; k += WIDTH) {
        cvec g[MOST_MICS][MOST_MICS], around[MOST_MICS][MOST_MICS];
        fetch_matrix(M, s, s->noise, how->noise_scale, how->mics, k, g);
        if (smeared) {
            fetch_matrix(M, s, s->smeared, s->smear * how->noise_scale, how->mics, k, around);
            for (int i = 0; i < M; i++)
                for (int j = 0; j < M; j++)
                    g[i][j].re += around[i][j].re, g[i][j].im += around[i][j].im;
        }
        vec level = all(0.0f);
        for (int i = 0; i < M; i++)
            level += g[i][i].re;
        level = how->white > 0.0f ? all(how->white) : level * (1.0f / count) + s->floor;
        vec rate = 1.0f / level;
        vec added = how->white > 0.0f ? all(1.0f) : s->loading + s->floor * rate;
        float noise = how->white > 0.0f ? 0.0f : 1.0f;
        for (int i = 0; i < M; i++)
            for (int j = 0; j < M; j++)
                g[i][j].re *= rate * noise, g[i][j].im *= rate * noise;
        for (int i = 0; i < M; i++)
            g[i][i].re = how->mics >> i & 1 ? g[i][i].re + added : all(1.0f);
        invert(M, 0.5f * s->loading, g);
        float *pair = s->inverse + M * stride + k;
        for (int i = 0; i < M; i++) {
            store(s->inverse + i * stride + k, g[i][i].re);
            for (int j = i + 1; j < M; j++, pair += 2 * stride)
                store(pair, g[i][j].re), store(pair + stride, g[i][j].im);
        }
        store(s->rate + k, rate);
    }
}

/* Fills the fine response: numerator and denominator of q, both over the mean diagonal of G, so that
 * neighbouring bins may be added up. */
INLINE void whiten_bins(const int M, const steer *s, const locagen_whitening *how)
{
    long stride = s->stride;
    float *out = s->fine.planes;
    float count = (float)__builtin_popcount((unsigned)how->mics);
    for (long k = 0; k < stride; k += WIDTH) {
        cvec g[MOST_MICS][MOST_MICS], x[MOST_MICS][MOST_MICS], h[MOST_MICS][MOST_MICS];
        fetch_matrix(M, s, s->inverse, 1.0f, how->mics, k, g);
        fetch_matrix(M, s, how->span->signal, how->signal_scale, how->mics, k, x);
        vec rate = load(s->rate + k);
        for (int i = 0; i < M; i++)
            for (int j = 0; j < M; j++)
                x[i][j].re *= rate, x[i][j].im *= rate;
        for (int source = 0; source < how->nulls; source++)
            null_source(M, s, source, k, g);

        for (int i = 0; i < M; i++)
            for (int j = 0; j < M; j++) {
                h[i][j] = (cvec){all(0.0f), all(0.0f)};
                for (int n = 0; n < M; n++) {
                    cvec t = product_of(g[i][n], x[n][j]);
                    h[i][j].re += t.re, h[i][j].im += t.im;
                }
            }
        vec trace = all(0.0f), power = all(0.0f);
        for (int i = 0; i < M; i++)
            trace += g[i][i].re, power += h[i][i].re;
        vec unit = count / larger(trace, all(1e-6f));
        vec sum = all(0.0f);
        float *pair = out + 2 * stride + k;
        for (int i = 0; i < M; i++) {
            for (int n = 0; n < M; n++)
                sum += h[i][n].re * g[n][i].re - h[i][n].im * g[n][i].im;
            for (int j = i + 1; j < M; j++, pair += 4 * stride) {
                cvec b = {all(0.0f), all(0.0f)};
                for (int n = 0; n < M; n++) {
                    cvec t = product_of(h[i][n], g[n][j]);
                    b.re += t.re, b.im += t.im;
                }
                /* 2 Re(B e^(i phase)) = 2 Re B cos - 2 Im B sin */
                store(pair, 2.0f * unit * b.re), store(pair + stride, -2.0f * unit * b.im);
                store(pair + 2 * stride, 2.0f * unit * g[i][j].re);
                store(pair + 3 * stride, -2.0f * unit * g[i][j].im);
            }
        }
        store(out + k, unit * sum);
        store(out + stride + k, unit * trace);
        store(pair, power * (1.0f / count));
    }
}

#define FOR_MICS(name, M)                                                                                    \
    STEP void name##_##M(const steer *s, const locagen_whitening *how) { name##_bins(M, s, how); }
FOR_MICS(invert, 2)
FOR_MICS(invert, 3)
FOR_MICS(invert, 4)
STEP void invert_many(const steer *s, const locagen_whitening *how) { invert_bins(s->mics, s, how); }
FOR_MICS(whiten, 2)
FOR_MICS(whiten, 3)
FOR_MICS(whiten, 4)
STEP void whiten_many(const steer *s, const locagen_whitening *how) { whiten_bins(s->mics, s, how); }

/* Neighbouring bins of the fine response, added up. */
STEP void thin(const steer *s)
{
    const locagen_response *fine = &s->fine, *coarse = &s->coarse;
    long step = coarse->thinning;
    for (long plane = 0; plane < 3 + 4 * s->pairs; plane++) {
        const float *from = fine->planes + plane * fine->stride;
        float *to = coarse->planes + plane * coarse->stride;
        for (long k = 0; k < coarse->bins; k++) {
            float sum = 0.0f;
            for (long n = 0; n < step; n++)
                sum += from[k * step + n];
            to[k] = sum;
        }
    }
}

static void invert_band(const steer *s, const locagen_whitening *how)
{
    (s->mics == 2 ? invert_2 : s->mics == 3 ? invert_3 : s->mics == 4 ? invert_4 : invert_many)(s, how);
}

static void whiten_band(const steer *s, const locagen_whitening *how)
{
    (s->mics == 2 ? whiten_2 : s->mics == 3 ? whiten_3 : s->mics == 4 ? whiten_4 : whiten_many)(s, how);
    thin(s);
}

#endif
