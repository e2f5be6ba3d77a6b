"""Frame, Correlation and Tdoa -> what is wrong with the microphones, in words for the operator.

Each symptom is one line of a table: a test that says, per frame, for which microphones it holds. A symptom
becomes a fault once it has held for most of a second, and is forgotten as slowly.

What signals cannot show: two swapped microphones of an equilateral triangle mirror every bearing, and
each mirrored bearing fits as well as the true one. Only a sound from a known direction tells them apart.
Arrays without that symmetry do show a swap: the delays then fit no direction.
"""

from __future__ import annotations

import math

import numpy as np

from locagen_edge.geometry import FLAT_M
from locagen_edge.settings import Settings
from locagen_edge.types import F64, Correlation, Frame, Tdoa

MEMORY_S = 0.5
RAISE, CLEAR = 0.7, 0.2

DEAD_DB = -40.0
"""Below the loudest microphone. Beside its own rotor one hears 12 to 28 dB more than the others."""
SILENCE = 1e-11
"""-110 dBFS mean square in the band."""
CLIPPED_SHARE = 0.01
FULL_SCALE = 0.999
OFFSET = 0.1
SAME = 1e-3
"""Largest difference, relative to the loudest sample, of two channels that carry one signal."""
STRONG_PEAK = 0.5
"""Median peak from which delays are certain enough to accuse the array of not fitting them; a single
pair may have none, where its delay is longer than its microphones' places allow."""
MISFIT = 10.0
"""Sigmas. One far source with strong peaks gives about 1; microphones of a square swapped, 17 to 110."""


class DelayFit:
    """How well delays fit any direction at all, as the array is believed to be."""

    def __init__(self, settings: Settings):
        baselines = settings.mic_array.baselines_m
        _, thickness, axes = np.linalg.svd(baselines)
        flat = len(thickness) < 3 or thickness[2] < FLAT_M
        self._slope: F64 = baselines @ axes[: 2 if flat else 3].T / settings.speed_m_s
        self._inverse: F64 = np.linalg.pinv(self._slope)
        self._tolerance_s = math.sqrt(2.0) * settings.array.tolerance_m / settings.speed_m_s

    def misfit(self, tdoa: Tdoa) -> float:
        """rms of (measured - fitted) delay over its sigma, by least squares for u with |u| at most 1; 0
        where there are no more delays than unknowns."""
        heard = np.isfinite(tdoa.delay_s)
        slope, delay = self._slope[heard], tdoa.delay_s[heard]
        spare = len(delay) - slope.shape[1]
        if spare < 1:
            return 0.0
        u = (self._inverse if heard.all() else np.linalg.pinv(slope)) @ delay
        u /= max(1.0, float(np.linalg.norm(u)))
        off = (delay - slope @ u) / np.hypot(tdoa.sigma_s[heard], self._tolerance_s)
        return math.sqrt(float(off @ off) / spare)


def strong(tdoa: Tdoa) -> bool:
    """Whether the delays are certain enough to accuse the array."""
    return bool(sorted(tdoa.peak.tolist())[len(tdoa.peak) // 2] > STRONG_PEAK)


def symptoms(frame: Frame, correlation: Correlation, tdoa: Tdoa, misfit: float) -> set[str]:
    """What is wrong in this frame alone, in words; microphones counted from 0 as in the settings."""
    samples = frame.samples
    mics = range(len(samples))
    broken = {m for m in mics if correlation.bad_mics >> m & 1}
    found = {f"microphone {m}: samples that are not numbers" for m in broken}
    power = correlation.power
    loudest = float(power.max())
    if loudest <= SILENCE:
        return found | {"no microphone hears anything"} if not broken else found
    quiet = max(loudest * 10 ** (DEAD_DB / 10), SILENCE)
    dead = {m for m in mics if power[m] < quiet} - broken
    found |= {f"microphone {m}: dead, hears nothing" for m in dead}
    magnitude = np.abs(samples)
    at = magnitude.argmax(axis=1).tolist()
    peak = [float(magnitude[m, at[m]]) for m in mics]
    for m in mics:
        if m in broken:
            continue
        if peak[m] >= FULL_SCALE and np.mean(magnitude[m] >= FULL_SCALE) > CLIPPED_SHARE:
            found.add(f"microphone {m}: clipped, the gain is too high")
        if peak[m] > OFFSET and abs(samples[m].mean()) > OFFSET:
            found.add(f"microphone {m}: a constant offset, over a tenth of full scale")
    live = [m for m in mics if m not in dead | broken]
    for k, i in enumerate(live):
        for j in live[k + 1 :]:
            limit = SAME * peak[i]
            # where one is loudest the other differs, unless they are one signal: the rest is seldom looked at
            if abs(samples[i, at[i]] - samples[j, at[i]]) > limit:
                continue
            if np.abs(samples[i] - samples[j]).max() <= limit:
                found.add(f"microphones {i} and {j}: the same signal twice, check audio.channel_map")
    if not dead and not broken and misfit > MISFIT and strong(tdoa):
        found.add("the delays fit no direction: channels swapped, or array.positions_m is wrong")
    return found


class FaultFinder:
    """Turns symptoms of single frames into lasting faults. One per stream."""

    def __init__(self, settings: Settings) -> None:
        self._fit = DelayFit(settings)
        self._share: dict[str, float] = {}
        self._raised: set[str] = set()

    def apply(self, settings: Settings) -> None:
        """Another array or speed of sound from the next frame on; faults that last go on."""
        self._fit = DelayFit(settings)

    def __call__(
        self, frame: Frame, correlation: Correlation, tdoa: Tdoa, elapsed_s: float
    ) -> tuple[str, ...]:
        """`elapsed_s`: since the previous frame."""
        now = symptoms(frame, correlation, tdoa, self._fit.misfit(tdoa) if strong(tdoa) else 0.0)
        keep = math.exp(-elapsed_s / MEMORY_S)
        for text in now | self._share.keys():
            share = keep * self._share.get(text, 0.0) + (1.0 - keep) * (text in now)
            self._share[text] = share
            if share > RAISE:
                self._raised.add(text)
            elif share < CLEAR:
                self._raised.discard(text)
                if share < 1e-3:
                    del self._share[text]
        return tuple(sorted(self._raised))
