/* test_threads.c - states of their own in threads of their own disturb nothing. For ThreadSanitizer.
 *
 * The header promises that states are independent: what is shared is constant, or set up once. Every thread
 * makes its states itself, at the same moment as all others, of all sizes in its own order, and has to get the
 * very bytes that one thread alone gets.
 */
#include "locagen.h"

#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { THREADS = 8, ROUNDS = 3, MOST_IN = 8 * 4096, MOST_OUT = 1 << 16 };

static const struct {
    int mics, frame, lags, oversample, azimuths, elevations, spans, lag;
    float low, high;
} CASES[] = {
    {3, 1024, 63, 16, 36, 9, 2, 3, 300, 4700}, {2, 256, 1, 1, 8, 2, 1, 0, 300, 4700},
    {4, 512, 64, 16, 37, 5, 3, 1, 310, 4690},  {5, 256, 62, 3, 9, 3, 4, 7, 20, 4979},
    {7, 512, 191, 7, 11, 4, 1, 0, 2500, 4000}, {8, 1024, 63, 16, 16, 3, 2, 2, 300, 4700},
    {3, 256, 61, 1, 8, 2, 1, 0, 20, 4990},     {6, 4096, 255, 16, 10, 2, 1, 1, 300, 1200},
};
enum { CASE_COUNT = sizeof CASES / sizeof *CASES };

static float sound[MOST_IN];
static float expected[CASE_COUNT][MOST_OUT];
static pthread_barrier_t all_ready;

/* What one case gives, all of it, as numbers one after the other: how many, 0 where anything was refused. */
static size_t heard(int number, float *out)
{
    size_t count = 0;
    int mics = CASES[number].mics, frame = CASES[number].frame, columns = 2 * CASES[number].lags + 1;
    locagen_gcc_config gcc = {
        .mics = mics, .frame = frame, .lags = CASES[number].lags, .oversample = CASES[number].oversample,
        .rate_hz = 10000, .band_low_hz = CASES[number].low, .band_high_hz = CASES[number].high, .floor = 1e-12f,
        .relative_floor = 0.01f,
    };
    locagen_steer_config steer = {
        .mics = mics, .frame = frame, .hop = frame / 2, .spans = CASES[number].spans, .lag = CASES[number].lag,
        .smooth_bins = 6, .azimuths = CASES[number].azimuths, .elevations = CASES[number].elevations,
        .rate_hz = 10000, .band_low_hz = CASES[number].low, .band_high_hz = CASES[number].high, .taper = 0.1f,
        .loading = 1e-3f, .smear = 0.03f, .floor = 1e-12f, .speed_m_s = 343,
    };
    for (int m = 0; m < mics; m++) {
        steer.positions_m[3 * m] = 0.06f * cosf(6.2832f * (float)m / (float)mics);
        steer.positions_m[3 * m + 1] = 0.06f * sinf(6.2832f * (float)m / (float)mics);
    }
    locagen_gcc *correlator = malloc(locagen_gcc_sizeof(&gcc));
    locagen_steer *search = malloc(locagen_steer_sizeof(&steer));
    float power[16];
    locagen_source sources[2];
    memset(sources, 0, sizeof sources);
    if (!correlator || !search || locagen_gcc_init(correlator, &gcc) || locagen_steer_init(search, &steer))
        goto done;
    size_t values = (size_t)(mics * (mics - 1) / 2 * columns);
    if (locagen_gcc_process(correlator, sound, out, power) != 0)
        goto done;
    count = values;
    for (int n = 0; n < 2 * mics; n++)
        out[count++] = power[n];
    for (int n = 0; n < 12; n++) {
        const float *in = sound + 16 * n; /* another sound each time */
        if (n * 16 + mics * frame > MOST_IN)
            break;
        locagen_steer_listen(search, in, power);
        if (n < 9)
            locagen_steer_learn(search, 0, 1.0f / (float)(n + 1));
        for (int s = 0; s < steer.spans; s++)
            locagen_steer_hear(search, s, n < 9 ? 0.5f : 1.0f);
    }
    int found = locagen_steer_search(search, 0, 2, 0.0f, 0.0f, sources);
    out[count++] = (float)found;
    memcpy(out + count, sources, sizeof sources);
    count += sizeof sources / (sizeof(float));
done:
    free(correlator);
    free(search);
    return count;
}

static void *listen_alone(void *argument)
{
    int first = *(int *)argument, wrong = 0;
    float *out = malloc(sizeof(float) * MOST_OUT);
    pthread_barrier_wait(&all_ready);
    for (int n = 0; n < ROUNDS * CASE_COUNT; n++) {
        int number = (first + n) % CASE_COUNT;
        size_t count = heard(number, out);
        wrong += count == 0 || memcmp(out, expected[number], count * sizeof(float)) != 0;
    }
    free(out);
    *(int *)argument = wrong;
    return NULL;
}

int main(void)
{
    pthread_t threads[THREADS];
    int result[THREADS], wrong = 0;
    uint32_t seed = 1;
    for (int n = 0; n < MOST_IN; n++) {
        seed = seed * 1664525u + 1013904223u; /* Numerical Recipes, section 7.1 */
        sound[n] = (float)(seed >> 8) / 16777216.0f - 0.5f;
    }
    pthread_barrier_init(&all_ready, NULL, THREADS);
    /* the threads first: whatever is set up once is set up by all of them at the same time */
    for (int round = 0; round < 2; round++) {
        for (int t = 0; t < THREADS; t++) {
            result[t] = t;
            if (pthread_create(&threads[t], NULL, listen_alone, &result[t]))
                return 2;
        }
        for (int t = 0; t < THREADS; t++) {
            pthread_join(threads[t], NULL);
            wrong += round ? result[t] : 0; /* nothing is expected yet in the first */
        }
        for (int number = 0; number < CASE_COUNT; number++)
            if (heard(number, expected[number]) == 0) {
                printf("case %d is refused\n", number);
                return 1;
            }
    }
    pthread_barrier_destroy(&all_ready);
    printf("%d threads, %d results, %d of them not what one thread alone gets\n", THREADS,
           THREADS * ROUNDS * CASE_COUNT, wrong);
    return wrong != 0;
}
