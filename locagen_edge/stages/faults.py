"""Frame, Correlation and Tdoa -> what is wrong with the microphones, in words for the operator.

A symptom becomes a fault once it has held for most of a second, and is forgotten as slowly. Those of single
channels (level, clipping) show in any sound. Those between channels (sign, delay, coherence) show only in
a sound that is common to all and wide enough to have one delay; frames without one say nothing either way, so
that claps are as good as an engine.

Between channels it is the phase correlation that tells (PHAT; Knapp & Carter, IEEE Trans. ASSP 24, 1976),
over lags far beyond what the array allows: no sound, from wherever, near or far, takes longer from one
microphone to another than along the straight line between them. A peak beyond that line, or one upside down,
is the channel's own doing.

What signals cannot show. Two swapped microphones of an equilateral triangle mirror every bearing, and each
mirrored bearing fits as well as the true one: only a sound from a known direction tells them apart; arrays
without that symmetry show a swap by delays that fit no direction. And a flat array that is smaller than
array.positions_m says hears all from too far above or below, as it might well be: `calibrate` measures that.
"""

from __future__ import annotations

import math
from collections.abc import Set as AbstractSet

import numpy as np

from locagen_edge.framing import CLIPPED_SHARE, FULL_SCALE
from locagen_edge.geometry import FLAT_M, LAG_MARGIN_SAMPLES
from locagen_edge.settings import Settings
from locagen_edge.types import F32, F64, Correlation, Frame, Tdoa

MEMORY_S = 0.5
RAISE, CLEAR = 0.7, 0.2

DEAD_DB = -40.0
"""Below the loudest microphone. Beside its own rotor one hears 12 to 28 dB more than the others."""
SILENCE = 1e-11
"""-110 dBFS mean square in the band."""
OFFSET = 0.1
SAME = 1e-5
"""Share of a channel's power that another leaves unexplained, at most, where both carry one signal; sound in
air leaves more, by the microphones' own noise alone."""
STRONG_PEAK = 0.5
"""Median peak from which delays are certain enough to accuse the array of not fitting them; a single
pair may have none, where its delay is longer than its microphones' places allow."""
MISFIT = 10.0
"""Sigmas. One far source with strong peaks gives about 1; microphones of a square swapped, 17 to 110."""

AUDIT_S = 0.2
"""How often microphones are looked at: symptoms last."""
WIDE = 8
"""Parts of a frame that the widest lag is one of: 13 ms by default."""
FINE = 4
"""Points a sample of lag: between two of them a peak loses 3 % at most."""
COMMON = 0.5
"""Peak of the phase correlation from which a sound is common to a pair."""
STRANGER = 0.2
"""And below which it is not; chance reaches 0.2 over so many lags."""
CLEARER = 1.4
"""How many times higher than all others a peak has to be to be believed. Sounds of an octave ring: the lobes
beside their peak, upside down, reach 0.7 of it."""
FULL = 0.2
"""Share of the band that a sound has to fill: narrower ones repeat themselves along the lags."""
FLOOR = 0.01
"""Of a channel's mean bin: weaker bins fade out, they are noise."""
OUT_OF_STEP = 3.0
"""Times the longest delay of a pair, from which no wrong place explains it."""

INSIDE, UPSIDE_DOWN, BEYOND, FAR_BEYOND = "inside", "upside down", "beyond", "far beyond"


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


class Wide:
    """Where, over wide lags, the sound of each pair has its one peak, and which way up."""

    def __init__(self, settings: Settings) -> None:
        array, audio = settings.mic_array, settings.audio
        low, high = settings.correlation.band_hz
        self.pairs = array.pairs
        self._first, self._second = np.array(array.pairs).T
        self._size = audio.frame
        self._window: F64 = np.hanning(audio.frame)
        hz = np.fft.rfftfreq(audio.frame, 1.0 / audio.rate_hz)
        self._band = (hz >= low) & (hz <= high)
        reach = FINE * audio.frame // WIDE
        self._lags = np.arange(-reach, reach + 1)
        samples = np.abs(self._lags) / FINE
        limit = array.spacing_m / settings.speed_m_s * audio.rate_hz + LAG_MARGIN_SAMPLES
        tolerance = settings.array.tolerance_m * 3.0 / settings.speed_m_s * audio.rate_hz
        self._inside = samples <= limit[:, None]
        self._beyond = samples > limit[:, None] + tolerance + 1.0  # the peak's own flank is a sample wide
        self._far = samples > OUT_OF_STEP * limit[:, None] + 1.0

    def __call__(self, samples: F32) -> list[str | None]:
        """Per pair INSIDE, UPSIDE_DOWN, BEYOND, FAR_BEYOND, "" where the two have nothing in common, None
        where nothing can be said."""
        spectra = np.fft.rfft(samples * self._window, axis=1)[:, self._band]
        power = np.abs(spectra) ** 2
        floor = FLOOR * power.mean(axis=1, keepdims=True) + 1e-20
        weight = power / (power + floor)
        phase = spectra / np.sqrt(power + 1e-30)
        i, j = self._first, self._second
        both = weight[i] * weight[j]
        whole = np.zeros((len(i), self._size // 2 + 1), dtype=np.complex128)
        whole[:, self._band] = both * phase[j] * phase[i].conj()
        wide = np.fft.irfft(whole, FINE * self._size, axis=1)[:, self._lags]
        wide *= 0.5 * FINE * self._size / np.maximum(both.sum(axis=1, keepdims=True), 1e-9)
        wanting = both.mean(axis=1) < FULL
        return [
            None if w else self._verdict(k, r) for k, (w, r) in enumerate(zip(wanting, wide, strict=True))
        ]

    def _verdict(self, pair: int, r: F64) -> str | None:
        inside, beyond, far = self._inside[pair], self._beyond[pair], self._far[pair]
        up, down = float(r[inside].max()), float(-r[inside].min())
        heights = {
            INSIDE: up,
            UPSIDE_DOWN: down,
            BEYOND: float(r[beyond & ~far].max(initial=0.0)),
            FAR_BEYOND: float(np.abs(r[far]).max(initial=0.0)),
        }
        best = max(heights, key=heights.__getitem__)
        height = heights.pop(best)
        if height < STRANGER:
            return ""
        return best if height > COMMON and height > CLEARER * max(heights.values()) else None


def between(pairs: tuple[tuple[int, int], ...], verdicts: list[str | None], mics: int) -> set[str]:
    """What is wrong between channels, in words."""
    of: list[list[str | None]] = [[] for _ in range(mics)]
    for (i, j), verdict in zip(pairs, verdicts, strict=True):
        of[i].append(verdict)
        of[j].append(verdict)
    found = set()
    for m in range(mics):
        others = [v for (i, j), v in zip(pairs, verdicts, strict=True) if m not in (i, j)]
        fine = bool(others) and all(v == INSIDE for v in others)
        if fine and all(v == UPSIDE_DOWN for v in of[m]):
            found.add(f"microphone {m}: inverted, its two wires are swapped")
        elif fine and all(v == FAR_BEYOND for v in of[m]):
            found.add(f"microphone {m}: out of step, far too early or too late for its place")
        elif fine and all(v == "" for v in of[m]):
            found.add(f"microphone {m}: hears nothing of what the others hear")
    if not found and BEYOND in verdicts:
        found.add("delays longer than array.positions_m allows: channels swapped, wrong places or rate")
    if not found and UPSIDE_DOWN in verdicts:
        i, j = pairs[verdicts.index(UPSIDE_DOWN)]
        found.add(f"microphones {i} and {j}: one is inverted, its two wires are swapped")
    if not found and FAR_BEYOND in verdicts:
        i, j = pairs[verdicts.index(FAR_BEYOND)]
        found.add(f"microphones {i} and {j}: out of step, their delays are far too long")
    return found


def alone(frame: Frame, correlation: Correlation, clipped: int) -> tuple[set[str], set[int]]:
    """What is wrong with channels by themselves, in words, and which of them hear; microphones counted from 0
    as in the settings. `clipped`: bit m says that the converter has cut microphone m off."""
    samples = frame.samples
    mics = range(len(samples))
    broken = {m for m in mics if correlation.bad_mics >> m & 1}
    found = {f"microphone {m}: samples that are not numbers" for m in broken}
    power = correlation.power
    loudest = float(power.max())
    if loudest <= SILENCE:
        return (found, set()) if broken else ({"no microphone hears anything"}, set())
    quiet = max(loudest * 10 ** (DEAD_DB / 10), SILENCE)
    dead = {m for m in mics if power[m] < quiet} - broken
    found |= {f"microphone {m}: dead, hears nothing" for m in dead}
    magnitude = np.abs(samples)
    peak = magnitude.max(axis=1).tolist()
    for m in mics:
        if m in broken:
            continue
        at_the_end = peak[m] >= FULL_SCALE and np.mean(magnitude[m] >= FULL_SCALE) > CLIPPED_SHARE
        if at_the_end or clipped >> m & 1:
            found.add(f"microphone {m}: clipped, the gain is too high")
        if peak[m] > OFFSET and abs(samples[m].mean()) > OFFSET:
            found.add(f"microphone {m}: a constant offset, over a tenth of full scale")
    live = sorted(set(mics) - dead - broken)
    for k, i in enumerate(live):
        for j in live[k + 1 :]:
            if _same(samples[i], samples[j]):
                found.add(f"microphones {i} and {j}: the same signal twice, check audio.channel_map")
    return found, set(live)


def _mostly(masks: list[int]) -> int:
    """The bits that are set in more than half of them."""
    every = max(mask.bit_length() for mask in masks)
    return sum(1 << m for m in range(every) if 2 * sum(mask >> m & 1 for mask in masks) > len(masks))


def _same(a: F32, b: F32) -> bool:
    """Whether one is the other, but for its level and sign."""
    aa, bb, ab = float(a @ a), float(b @ b), float(a @ b)
    return aa * bb > 0.0 and 1.0 - ab * ab / (aa * bb) < SAME


class FaultFinder:
    """Turns symptoms of single frames into lasting faults. One per stream."""

    def __init__(self, settings: Settings) -> None:
        self._fit, self._wide = DelayFit(settings), Wide(settings)
        self._share: dict[str, float] = {}
        self._raised: set[str] = set()
        self._between: set[str] = set()
        """texts of faults between channels that have been seen"""
        self._audit_s = AUDIT_S
        self._clipped: list[int] = []
        """of the frames since the last audit"""
        self._verdicts: list[str | None] = [None] * len(self._wide.pairs)
        """the latest of each pair: a frame may tell of some pairs only"""

    @property
    def judged(self) -> bool:
        """Whether some sound has told of every pair, and no fault between channels means that all is well."""
        return all(self._verdicts)

    def apply(self, settings: Settings) -> None:
        """Another array or speed of sound from the next frame on; faults that last go on."""
        self._fit, self._wide = DelayFit(settings), Wide(settings)
        self._verdicts = [None] * len(self._wide.pairs)

    def __call__(
        self, frame: Frame, correlation: Correlation, tdoa: Tdoa, elapsed_s: float
    ) -> tuple[str, ...]:
        """`elapsed_s`: since the previous frame."""
        self._audit_s += elapsed_s
        self._clipped.append(frame.clipped)
        if self._audit_s >= AUDIT_S:
            found, live = alone(frame, correlation, _mostly(self._clipped))
            self._clipped.clear()
            self._follow(found, self._share.keys() - self._between, self._audit_s)
            elapsed_s, self._audit_s = min(self._audit_s, 2 * AUDIT_S), 0.0
            if (common := self._common(frame, tdoa, live, found)) is not None:
                self._between |= common
                self._follow(common, self._share.keys() & self._between, elapsed_s)
        return tuple(sorted(self._raised))

    def _common(self, frame: Frame, tdoa: Tdoa, live: set[int], alone: set[str]) -> set[str] | None:
        """What is wrong between channels; None where that cannot be told."""
        if len(live) < len(frame.samples) or any("the same signal" in text for text in alone):
            return None
        verdicts = self._wide(frame.samples)
        if not any(verdicts):  # no sound that is common to any two
            return None
        self._verdicts = [
            old if new is None else new for old, new in zip(self._verdicts, verdicts, strict=True)
        ]
        found = between(self._wide.pairs, self._verdicts, len(frame.samples))
        strong = np.sort(tdoa.peak)[len(tdoa.peak) // 2] > STRONG_PEAK
        if not found and strong and self._fit.misfit(tdoa) > MISFIT:
            found.add("the delays fit no direction: channels swapped, or array.positions_m is wrong")
        return found

    def _follow(self, found: set[str], known: AbstractSet[str], elapsed_s: float) -> None:
        keep = math.exp(-elapsed_s / MEMORY_S)
        for text in found | known:
            share = keep * self._share.get(text, 0.0) + (1.0 - keep) * (text in found)
            self._share[text] = share
            if share > RAISE:
                self._raised.add(text)
            elif share < CLEAR:
                self._raised.discard(text)
                if share < 1e-3:
                    del self._share[text]
