"""Calls for training and evaluation: those of the simulator, in more voices and with pauses.

The simulator's screams lie round 1 kHz and its whistles round 3 kHz, which a network would learn by heart.
Here each has its own pitch, colour and rhythm; whistles come with a pea, and blown through fingers.
"""

from __future__ import annotations

import numpy as np

from locagen_edge.sim import calls
from locagen_edge.sim.calls import Call
from locagen_edge.sim.synth import glide, turns_of
from locagen_edge.types import F64


def scream(n: int, rate_hz: float, top_hz: float, rng: np.random.Generator) -> F64:
    """The simulator's, from a man's (0.6 of its pitch) to a child's (1.5)."""
    return _in_bursts(_at_pitch(calls.scream, n, rate_hz, top_hz, rng, (0.6, 1.5)), rate_hz, rng)


def whistle(n: int, rate_hz: float, top_hz: float, rng: np.random.Generator) -> F64:
    """With a pea at 2.2 to 4 kHz, or through fingers: a tone that glides by up to an octave."""
    if rng.random() < 0.5:
        return _in_bursts(_at_pitch(calls.whistle, n, rate_hz, top_hz, rng, (0.75, 1.35)), rate_hz, rng)
    middle = np.exp(rng.uniform(np.log(1000.0), np.log(0.6 * top_hz)))
    pitch = middle * 2.0 ** glide(rng.uniform(-0.5, 0.5, 6), n)
    turns = 2.0 * np.pi * turns_of(pitch, rate_hz)
    sound: F64 = np.sin(turns) + rng.uniform(0.0, 0.1) * np.sin(2.0 * turns) * (2.0 * pitch < top_hz)
    return _in_bursts(sound, rate_hz, rng)


def _at_pitch(
    make: Call, n: int, rate_hz: float, top_hz: float, rng: np.random.Generator, factors: tuple[float, float]
) -> F64:
    """The same call played faster or slower."""
    factor = np.exp(rng.uniform(*np.log(factors)))
    length = int(n * factor) + 2
    sound = make(length, rate_hz, min(top_hz / factor, 0.49 * rate_hz), rng)
    played: F64 = np.interp(np.arange(n) * factor, np.arange(length), sound)
    return played


def _in_bursts(sound: F64, rate_hz: float, rng: np.random.Generator) -> F64:
    """Breath is short: 0.4 to 1.6 s of sound, then 0.1 to 0.5 s of nothing."""
    n, start = len(sound), int(0.2 * rate_hz * rng.random())
    loudness = np.zeros(n)
    while start < n:
        length = int(rate_hz * rng.uniform(0.4, 1.6))
        rise = np.minimum(np.arange(length) / (0.03 * rate_hz), 1.0)
        envelope = np.minimum(rise, rise[::-1]) * np.interp(
            np.arange(length), [0, length], rng.uniform(0.4, 1.0, 2)
        )
        loudness[start : start + length] = envelope[: n - start]
        start += length + int(rate_hz * rng.uniform(0.1, 0.5))
    return sound * loudness


CALLERS: dict[str, Call] = {
    "scream": scream,
    "whistle": whistle,
    "speech": calls.speech,
    "door_knock": calls.knock,
    "instrument": calls.instrument,
}
"""Classes that are synthesised where the folder of calls has none, by the name that a folder would have."""
