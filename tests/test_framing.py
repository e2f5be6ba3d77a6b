"""Frames and rates: how the sound was cut never shows, no frame spans a gap, time is that of the samples."""

import asyncio
import itertools
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locagen_edge import kernel
from locagen_edge.alignment import Aligner
from locagen_edge.errors import KernelError, SourceError
from locagen_edge.framing import Framer, in_real_time
from locagen_edge.resampling import Resampler
from locagen_edge.types import Frame

RATE = 10_000.0


def numbered(start, stop, mics=2):
    """Samples that tell their own number."""
    return np.arange(start, stop, dtype=np.float32) + np.arange(mics, dtype=np.float32)[:, np.newaxis] * 0.25


@st.composite
def streams(draw):
    frame = draw(st.sampled_from([4, 8, 16]))
    hop = draw(st.integers(1, frame))
    blocks = draw(st.lists(st.integers(0, 40), max_size=12))
    gaps = draw(st.sets(st.integers(0, 11)))  # a gap before these blocks
    return frame, hop, blocks, gaps


@settings(deadline=None)
@given(streams())
def test_any_cutting_gives_the_frames_of_a_plain_reference(stream):
    frame, hop, blocks, gaps = stream
    framer = Framer(frame, hop, 2, RATE, origin_ns=500)
    got = []
    edges = [0, *itertools.accumulate(blocks)]
    for k, (start, stop) in enumerate(itertools.pairwise(edges)):
        if k in gaps:
            framer.gap()
        got += framer.push(numbered(start, stop))

    segments = [0, *(edges[k] for k in sorted(gaps) if k < len(blocks)), edges[-1]]
    expected = []
    waiting = -1  # the first segment begins without a gap
    for begin, end in itertools.pairwise(segments):
        waiting += 1
        for start in range(begin, end - frame + 1, hop):
            expected.append((start, waiting))
            waiting = 0
    assert [(f.start, f.overruns) for f in got] == expected
    for f in got:
        np.testing.assert_array_equal(f.samples, numbered(f.start, f.start + frame))
        assert f.samples.dtype == np.float32
        assert f.rate_hz == RATE
        assert f.t_ns == 500 + f.start * 100_000  # 10 kHz: one sample lasts 100 us


def test_time_starts_anew_after_a_gap():
    framer = Framer(4, 2, 1, RATE)
    framer.push(numbered(0, 7, 1))
    framer.gap(3)
    framer.origin_ns = 9_000_000
    (first, second) = framer.push(numbered(7, 13, 1))
    assert (first.start, first.t_ns, first.overruns) == (7, 9_000_000, 3)
    assert (second.start, second.t_ns, second.overruns) == (9, 9_200_000, 0)


def test_frames_own_their_samples():
    framer = Framer(4, 2, 1, RATE)
    block = numbered(0, 6, 1)
    first, second = framer.push(block)
    first.samples[:] = -1
    block[:] = -2
    (third,) = framer.push(numbered(6, 8, 1))
    np.testing.assert_array_equal(second.samples, numbered(2, 6, 1))
    np.testing.assert_array_equal(third.samples, numbered(4, 8, 1))


def test_real_time_is_not_before_the_sound_and_closes_what_it_reads():
    closed = []

    def endless(origin_ns):
        try:
            for k in itertools.count():
                yield Frame(numbered(0, 100), RATE, origin_ns + k * 10_000_000, 100 * k)
        finally:
            closed.append(True)

    async def listen():
        source = in_real_time(endless)
        before = time.monotonic_ns()
        for k in range(3):
            frame = await anext(source)
            assert frame.t_ns >= before + k * 10_000_000
            assert time.monotonic_ns() >= frame.t_ns + 10_000_000  # heard to its end, and no earlier
        await source.aclose()

    asyncio.run(listen())
    assert closed == [True]


# --- resampling ---------------------------------------------------------------------------------------

RATES = [8_000, 16_000, 44_100, 48_000, 96_000]


def resample(rows, rate, cuts):
    resampler = Resampler(rate, RATE, rows.shape[1])
    parts = [resampler.push(part) for part in np.split(rows, cuts)]
    return np.concatenate([*parts, resampler.flush(rows[:0])])


@pytest.mark.parametrize("rate", RATES)
def test_resampled_in_chunks_is_resampled_whole(rate):
    rows = np.random.default_rng(rate).standard_normal((rate // 2, 3)).astype(np.float32)
    whole = resample(rows, rate, [])
    assert len(whole) == RATE // 2
    for seed in range(3):
        cuts = np.sort(np.random.default_rng(seed).integers(0, len(rows), 40))
        np.testing.assert_array_equal(resample(rows, rate, cuts), whole)


@pytest.mark.parametrize("rate", RATES)
def test_a_resampled_sine_is_that_sine_at_its_own_time(rate):
    hz = np.array([300.0, 1234.5, 3000.0])
    rows = np.sin(2 * np.pi * hz * np.arange(rate)[:, np.newaxis] / rate).astype(np.float32)
    got = resample(rows, rate, range(0, rate, 960))
    expected = np.sin(2 * np.pi * hz * np.arange(len(got))[:, np.newaxis] / RATE)
    inside = slice(1000, -1000)  # at the ends the filter sees half a sine
    assert np.abs(got - expected)[inside].max() < 1e-4  # -80 dB, phase and so time included


def test_the_same_rate_passes_through():
    rows = numbered(0, 5).T
    np.testing.assert_array_equal(resample(rows, RATE, [2]), rows)


@pytest.mark.parametrize("rate", RATES)
def test_sound_does_not_wait_for_long(rate):
    resampler = Resampler(rate, RATE, 3)
    given = got = 0
    waits = []
    for _ in range(rate // 40):
        got += len(resampler.push(np.zeros((40, 3), dtype=np.float32)))
        given += 40
        waits.append(given / rate - got / RATE)
    assert max(waits) < 0.0075  # half of the filter


@given(
    rate=st.sampled_from([8_000, 11_025, 16_000, 44_100, 48_000, 192_000]),
    first=st.integers(0, 3000),
    wanted=st.integers(1, 600),
)
def test_what_is_missing_is_just_enough(rate, first, wanted):
    resampler = Resampler(rate, RATE, 2)
    resampler.push(np.zeros((first, 2), dtype=np.float32))
    missing = resampler.missing(wanted)
    assert missing > 0
    assert len(resampler.push(np.zeros((missing - 1, 2), dtype=np.float32))) < wanted
    assert len(resampler.push(np.zeros((1, 2), dtype=np.float32))) >= 1


@given(cards=st.sampled_from([16_000, 44_100, 48_000]), late_us=st.sampled_from([0.0, 40.0]))
def test_frames_are_whole_when_the_rows_that_were_missing_have_come(cards, late_us):
    """Through resampler, aligner and framer: as the source that waits for them asks."""
    resampler, aligner = Resampler(cards, RATE, 3), Aligner([0.0, late_us * 1e-6, 0.0], [], RATE, 3)
    framer = Framer(1024, 512, 3, RATE)
    for _ in range(5):
        missing = resampler.missing(aligner.missing(framer.missing))
        parts = [np.zeros((missing - 1, 3), dtype=np.float32), np.zeros((1, 3), dtype=np.float32)]
        assert [len(framer.push(aligner.push(resampler.push(part)).T)) for part in parts] == [0, 1]


@given(data=st.data(), seed=st.integers(0, 2**32 - 1))
def test_the_kernels_filter_is_its_definition(data, seed):
    rng = np.random.default_rng(seed)
    up, down, mics = (data.draw(st.integers(1, most)) for most in (7, 50, 8))
    taps = kernel.TAPS * data.draw(st.integers(1, 4))
    at, count = data.draw(st.integers(0, 3 * up)), data.draw(st.integers(0, 9))
    length = (at + max(count - 1, 0) * down) // up + taps
    table = rng.standard_normal((up, taps)).astype(np.float32)
    samples = rng.standard_normal((mics, length)).astype(np.float32)
    rows = kernel.resample(table, up, down, at, samples, count)
    assert rows.shape == (count, mics)
    for n, row in enumerate(rows):
        start, phase = divmod(at + n * down, up)
        np.testing.assert_allclose(row, samples[:, start : start + taps] @ table[phase], atol=1e-4)
    if count:
        with pytest.raises(KernelError, match="samples enough"):
            kernel.resample(table, up, down, at, np.ascontiguousarray(samples[:, :-1]), count)


def test_rates_that_have_nothing_in_common_are_refused_by_name():
    with pytest.raises(SourceError, match="191999 Hz cannot be made 10007 Hz"):
        Resampler(191_999, 10_007.0, 3)


@pytest.mark.parametrize("wrong", [{"count": -1}, {"at": 2**40}, {"samples": np.zeros(32, np.float32)}])
def test_what_the_kernel_cannot_filter_is_refused(wrong):
    table, samples = np.ones((1, 16), np.float32), np.zeros((2, 32), np.float32)
    asked = {"table": table, "up": 1, "down": 1, "at": 0, "samples": samples, "count": 1} | wrong
    with pytest.raises(KernelError):
        kernel.resample(**asked)


def test_clear_forgets():
    rows = np.random.default_rng(0).standard_normal((9600, 2)).astype(np.float32)
    used = Resampler(48_000, RATE, 2)
    used.push(np.ones((5000, 2), dtype=np.float32))
    used.clear()
    np.testing.assert_array_equal(used.flush(rows), Resampler(48_000, RATE, 2).flush(rows))


def test_a_nan_stays_with_its_microphone_and_passes():
    rows = np.random.default_rng(0).standard_normal((48_000, 3)).astype(np.float32)
    rows[20_000, 1] = np.nan
    bad = ~np.isfinite(resample(rows, 48_000, range(0, 48_000, 960)))
    assert not bad[:, [0, 2]].any()
    assert 0 < bad[:, 1].sum() < 100  # the filter's length, 9.6 ms
