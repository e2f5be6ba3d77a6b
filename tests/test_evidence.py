"""Laws of the evidence: what noise's scores are on average, and since when something has called."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locagen_edge.stages.bearing.evidence import (
    CLIP,
    HISTORY_S,
    LOUDEST,
    MEMORY_S,
    RISE_S,
    YOUNG,
    Onsets,
    Usual,
)

HOP_S = 0.05
DIRECTIONS = 12


def after(scores: list[float], looks: float = 1.0) -> Usual:
    usual = Usual(looks)
    for score in scores:
        usual.learn(score, HOP_S)
    return usual


def test_what_is_hardly_known_is_believed_only_where_it_is_loud() -> None:
    """The same score is worth the more the longer the noise has been known."""
    ratios = [after([10.0] * hops).ratio(300.0) for hops in (0, 20, 60, 120, 300)]
    assert ratios == sorted(ratios)
    assert ratios[0] < 0.5
    assert ratios[-1] > 5.0
    assert after([]).level >= YOUNG


def test_noise_that_hunts_is_known_within_seconds() -> None:
    """Every third second it scores ten times as much; after 6 s the next peak is no call."""
    still = [15.0] * 120
    hunting = [150.0 if n // 20 % 3 == 2 else 15.0 for n in range(120)]
    assert after(still, 8.0).ratio(150.0) > 1.5 * after(hunting, 8.0).ratio(150.0)
    assert after(hunting, 8.0).ratio(150.0) < 2.0


@pytest.mark.parametrize("looks", [1.0, 8.0])
def test_who_has_called_from_the_beginning_does_not_become_noise(looks: float) -> None:
    """Words and pauses, before anything is known: a word of some seconds later is a call."""
    words = [looks * 800.0 if n // 8 % 2 else 15.0 for n in range(60)]
    assert after(words, looks).ratio(looks * 800.0) > 5.0


@given(st.lists(st.floats(0.0, 1e9), max_size=200))
def test_one_score_moves_the_level_by_little_however_high(scores: list[float]) -> None:
    """A call that was not recognised does not make the next one noise."""
    usual = after([10.0] * 2000)
    before = usual.level
    for n, score in enumerate(scores):
        usual.learn(score, HOP_S)
        assert math.isfinite(usual.level)
        assert usual.level <= before * (1.0 + LOUDEST * HOP_S / MEMORY_S) ** (n + 1)


def heard(begun_hops_ago: int, hops: int, score: float, towards: int = 5) -> Onsets:
    """Noise of 2 in every direction, then `score` from one, in the last so many hops."""
    onsets = Onsets(HOP_S)
    for n in range(hops):
        scores = np.full((3, DIRECTIONS // 3), 2.0, np.float32)
        if n >= hops - begun_hops_ago:
            scores.flat[towards] = score
        onsets.hear(scores)
    return onsets


@pytest.mark.parametrize("hops", [39, 40, 41, 77, 200])
@pytest.mark.parametrize("begun_hops_ago", [1, 5, 20, 39])
def test_since_when_it_has_called(begun_hops_ago: int, hops: int) -> None:
    """To the hop, wherever in the ring the last frame is."""
    onsets = heard(begun_hops_ago, hops, 40.0)
    # the first frame that holds the call ended RISE_S after its begin, the last one so many hops later
    assert onsets.since_s(5) == pytest.approx((begun_hops_ago - 1) * HOP_S + RISE_S)
    assert onsets.going_on(5)
    assert not onsets.going_on(4)


def test_no_more_than_the_history_is_told() -> None:
    assert heard(500, 500, 1e6).since_s(5) == pytest.approx(HISTORY_S - HOP_S + RISE_S)


def test_a_clap_outweighs_no_second_of_voice() -> None:
    """A frame counts up to `CLIP`: as high as that or a million times as high is the same."""
    assert heard(10, 60, CLIP).since_s(5) == heard(10, 60, 1e8).since_s(5)


def test_what_was_before_a_gap_is_not_told() -> None:
    onsets = heard(30, 60, 40.0)
    onsets.forget()
    assert not onsets.going_on(5)
    assert onsets.since_s(5) == RISE_S
    onsets.hear(np.full((3, DIRECTIONS // 3), 40.0, np.float32))
    assert onsets.since_s(5) == RISE_S


def test_what_is_usual_in_a_direction_is_no_call() -> None:
    """A rotor's own side scores 20 all the time; elsewhere that is a call."""
    onsets = Onsets(HOP_S)
    scores = np.full((3, DIRECTIONS // 3), 2.0, np.float32)
    scores.flat[7] = 20.0
    for _ in range(100):
        onsets.hear(scores)
        onsets.learn(10, HOP_S)
    assert not onsets.going_on(7)
    scores.flat[3] = 20.0
    for _ in range(6):
        onsets.hear(scores)
    assert onsets.going_on(3)
    assert not onsets.going_on(7)
