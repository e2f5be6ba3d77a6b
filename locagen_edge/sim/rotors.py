"""Rotor noise: tones at the multiples of the blade rate, and broadband noise from the blades' wakes.

The tones follow the throttle with a slow wander, each rotor its own, as an autopilot trims them against
wind; they fall by 6 dB an octave. The broadband part falls by 3 dB an octave above 1 kHz, so it carries most
at high frequencies. The mixture follows what is measured on small propellers (Sinibaldi & Marino, Applied
Acoustics 74 (2013) 79-88) in shape, not in numbers.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from locagen_edge.sim.levels import from_db, in_band
from locagen_edge.sim.synth import band_noise, joined, wave, wavetable
from locagen_edge.types import F64, Array

BLADES = 2
IDLE_REV_S = 40.0  # revolutions per second without throttle, ...
FULL_REV_S = 160.0  # ... and at full throttle: propellers of 10 inches
TRIM = 0.03  # how far apart hovering rotors run
WANDER = ((0.17, 0.010), (0.71, 0.005))  # Hz, relative swing of the blade rate
BROADBAND_DB = -6.0  # against the tones, in the band
LOW_HZ = 100.0
PIECE = 8192  # samples of noise made at once
OVERLAP = 256


def blade_rate_hz(throttle: float) -> float:
    """Blades per second that pass a place, at throttle 0 to 1."""
    return BLADES * (IDLE_REV_S + throttle * (FULL_REV_S - IDLE_REV_S))


def hubs_m(rotors: int, arm_m: float, z_m: float = 0.0) -> F64:
    """(rotors, 3): hubs evenly around the origin, `z_m` below it, none straight ahead (an X frame)."""
    azimuth = np.pi / max(rotors, 1) * (2.0 * np.arange(rotors) + 1.0)
    return arm_m * np.stack([np.cos(azimuth), np.sin(azimuth), np.full(rotors, z_m / arm_m)], axis=1)


class BladeRate:
    """The wandering rate of one rotor, as a function of time: no state, so any moment can be asked for."""

    def __init__(self, throttle: float, rng: np.random.Generator) -> None:
        self.mean_hz = blade_rate_hz(throttle) * (1.0 + rng.uniform(-TRIM, TRIM))
        self.most_hz = self.mean_hz * (1.0 + sum(swing for _, swing in WANDER))
        self._phases = rng.uniform(0.0, 2.0 * np.pi, len(WANDER))

    def turns(self, time_s: F64) -> F64:
        """Phase at these times, in blade passages: the integral of the rate."""
        turns = time_s * self.mean_hz
        for (wander_hz, swing), phase in zip(WANDER, self._phases, strict=True):
            depth = self.mean_hz * swing / (2.0 * np.pi * wander_hz)
            turns = turns - depth * np.cos(2.0 * np.pi * wander_hz * time_s + phase)
        return turns


def rotor(
    throttle: float, rate_hz: float, top_hz: float, rng: np.random.Generator, piece: int = PIECE
) -> Iterator[F64]:
    """The endless sound of one rotor in pieces (any,): in-band power 1 on average, nothing above `top_hz`.

    `piece` samples of noise are made at once; the first piece yielded is `piece - OVERLAP` long, and its
    broadband part fades in over OVERLAP samples.
    """
    blades = BladeRate(throttle, rng)
    amplitudes = _amplitudes(blades, rate_hz, top_hz)
    table = wavetable(amplitudes, rng)
    noise_gain = np.sqrt(from_db(BROADBAND_DB) / _share_in_band(rate_hz, top_hz))
    scale = np.sqrt(1.0 / (1.0 + from_db(BROADBAND_DB)))

    def noise() -> Iterator[F64]:
        while True:
            yield band_noise(piece, rate_hz, LOW_HZ, top_hz, rng, slope=1.0)

    start = 0
    for broadband in joined(noise(), OVERLAP):
        time_s = (start + np.arange(len(broadband))) / rate_hz
        yield scale * (wave(table, blades.turns(time_s)) + noise_gain * broadband)
        start += len(broadband)


def _amplitudes(blades: BladeRate, rate_hz: float, top_hz: float) -> Array:
    """Of the harmonics, falling as 1 / k, with power 1 in the band."""
    order = np.arange(1, int(top_hz / blades.most_hz) + 1)
    amplitude = 1.0 / order
    counted = in_band(order * blades.mean_hz, rate_hz)
    scaled: Array = amplitude / np.sqrt(0.5 * np.sum(amplitude[counted] ** 2))
    return scaled


def _share_in_band(rate_hz: float, top_hz: float) -> float:
    """Of the broadband noise's power."""
    frequency = np.arange(LOW_HZ, top_hz)
    power = np.maximum(frequency / 1000.0, 1.0) ** -1.0
    return float(np.sum(power[in_band(frequency, rate_hz)]) / np.sum(power))
