"""The clock of a sound card: followed, measured, and never mistaken for a loss."""

import asyncio

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from locagen_edge import check
from locagen_edge.framing import Losses
from locagen_edge.sampleclock import CERTAIN_S, LOSS_POLLS, SampleClock
from locagen_edge.settings import from_table
from locagen_edge.types import Detection, Drift, Estimate, Frame

RATE = 48_000
POLL_NS = 20_000_000


def polled(clock, seconds, ppm=0.0, jitter_s=0.0, start_ns=0, seed=0):
    """Whether every poll of a card that is fast by `ppm` was fine; its pointer lags by up to `jitter_s`."""
    rng = np.random.default_rng(seed)
    fine = True
    for now in range(start_ns, start_ns + round(seconds * 1e9), POLL_NS):
        behind_s = rng.uniform(0, jitter_s)
        samples = ((now - start_ns) * 1e-9 - behind_s) * RATE * (1 + ppm * 1e-6)
        fine &= clock.update(max(round(samples), 0), now)
    return fine


@pytest.mark.parametrize("ppm", [-100.0, 0.0, 30.0, 100.0])
@pytest.mark.parametrize("jitter_s", [0.0, 0.004, 0.02])
def test_drift_is_measured_within_its_sigma(ppm, jitter_s):
    clock = SampleClock(RATE)
    assert polled(clock, 120, ppm, jitter_s)
    # rounding to whole samples alone is 6 us rms
    assert abs(clock.drift.ppm - ppm) < 4 * clock.drift.sigma_ppm + 0.1
    assert clock.drift.sigma_ppm < 10


def test_what_is_known_grows_with_time():
    sigmas = []
    for seconds in (2, 8, 60, 240):
        clock = SampleClock(RATE)
        polled(clock, seconds, 50.0, 0.01)
        sigmas.append(clock.drift.sigma_ppm)
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[-1] < 1.0


def test_drift_outlives_a_gap_until_more_is_known():
    clock = SampleClock(RATE)
    polled(clock, 60, 80.0, 0.005)
    after = SampleClock(RATE, clock.drift)
    polled(after, 10, 80.0, 0.005, start_ns=10**12, seed=1)
    assert after.drift is clock.drift


def test_nothing_is_told_of_a_moment():
    clock = SampleClock(RATE)
    polled(clock, 1.0)
    assert clock.drift is None


@examples(max_examples=30)
@given(
    lost_s=st.floats(CERTAIN_S + 0.02, 100.0),
    at_s=st.floats(0.5, 20.0),
    jitter_s=st.floats(0.0, 0.02),
)
def test_more_than_a_cards_buffer_is_missed_at_once(lost_s, at_s, jitter_s):
    clock = SampleClock(RATE)
    assert polled(clock, at_s, 0.0, jitter_s)
    now = round((at_s + lost_s) * 1e9)
    assert not clock.update(round(at_s * RATE), now)


def test_less_is_missed_once_it_lasts():
    clock = SampleClock(RATE)
    assert polled(clock, 3)
    fine = [clock.update(round((k * 0.02 + 3 - 0.1) * RATE), 3 * 10**9 + k * POLL_NS) for k in range(20)]
    assert fine.index(False) in (LOSS_POLLS - 1, LOSS_POLLS)


# --- what is missing


def frame(t_s, overruns=0, drift=None):
    return Frame(np.zeros((3, 1000), np.float32), 10_000.0, round(t_s * 1e9), 0, overruns, drift=drift)


def test_lost_sound_is_counted_by_the_clock():
    losses = Losses()
    for t_s, overruns in ((0.0, 0), (0.05, 0), (2.15, 1), (2.2, 0)):
        losses.count(frame(t_s, overruns))
    assert losses.overruns == 1
    assert losses.lost_s == pytest.approx(2.0)
    losses.reopened()
    losses.count(frame(12.3, drift=Drift(12.4, 0.3)))
    losses.count(frame(12.35))
    assert losses.lost_s == pytest.approx(12.0)
    assert str(losses) == "1 overrun, 12.0 s of sound lost, clock +12 ±1 ppm"


def test_a_source_that_begins_has_lost_nothing():
    losses = Losses()
    losses.reopened()
    losses.count(frame(1e6))
    assert str(losses) == "0 overruns, 0.0 s of sound lost"


@pytest.mark.parametrize(("ppm", "good"), [(80.0, True), (-88_435.0, False)])
def test_check_knows_a_clock_that_is_no_crystals(monkeypatch, ppm, good):
    """A device that says 48 kHz and gives 44.1."""

    async def frames(_):
        for k in range(100):
            yield frame(k * 0.05, drift=Drift(ppm, 20.0))
            await asyncio.sleep(0.01)

    monkeypatch.setattr("locagen_edge.check.open_source", frames)
    settings = from_table({"audio": {"source": "alsa", "frame": 1024}, "bearing": {"estimator": "far-field"}})
    found = asyncio.run(check._listen(settings, Processed(), 0.2))
    (told,) = [(fine, text) for fine, what, text in found if what == "clock"]
    assert told[0] == good
    assert ("no crystal errs so much" in told[1]) != good


class Processed:
    """Stands for a pipeline."""

    channels_judged = True

    def process(self, frame):
        return Estimate(
            frame.t_ns, 0, 0, None, None, Detection(False, 0.0, -60.0), None, (), None, (), None, (), ()
        )
