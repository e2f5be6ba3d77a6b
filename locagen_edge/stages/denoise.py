"""Frame -> Frame, or Frame -> Mask: takes the rotors out of the sound and leaves caller and phases.

    wave    the paper's network: each microphone's waveform through the same weights. The sound comes out
            WAVE_DELAY samples later. Bearings from it want a correlation that does not whiten: PHAT divides
            out just what the denoiser did.
    mask    one mask for all microphones in time and frequency, from their spectra over that of the noise,
    which is learnt while nothing calls. It touches no phase: weigh cross-spectra with it, tell calls by it,
    or hear the cleaned sound, MASK_DELAY samples later.

The networks hear everything through the same high-pass, keep their state from frame to frame, and begin anew
after a gap. A sample that is not finite counts as silence inside, and is not finite again in the sound that
comes out, so that the microphone's failure is seen by those who look for it and spoils nothing later.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from locagen_edge.highpass import HighPass
from locagen_edge.models import Network, load_network
from locagen_edge.settings import Settings
from locagen_edge.types import F32, F64, Array, Frame, Mask

RATE_HZ = 10_000
HIGH_PASS_HZ = 80.0
CHUNK = 512
"""samples of one call of either network"""

WAVE_DELAY = 64
"""half of the network's first window, 6.4 ms"""

WINDOW = 256
STEP = 128
BINS = WINDOW // 2
"""of a spectrum, without 0 Hz"""
LOOKAHEAD = 3
"""spectra after the one whose mask is given"""
MASK_DELAY = STEP * (1 + LOOKAHEAD)
"""overlap-add and LOOKAHEAD: 51.2 ms, one hop"""

LOUDEST = 8.0
"""Of full scale. No converter gives more; what comes as more would overflow inside."""
DEAD = 1e-6
"""Of its own noise's power, -60 dB: a microphone as quiet as that has died."""
LEAST = 1e-17
"""Power of a spectrum, about -180 dBFS: digital silence, which has no noise to be told from."""
EARLIEST_S = 0.5
"""Noise that has to be known before a mask is given; it then still varies by 2 dB from bin to bin."""

FLOOR = 0.1
"""Of the sound as it came, -20 dB, that stays in cleaned sound: what the networks miss is not lost, and where
they find nothing the output is the input, quieter, instead of what they make of noise."""
SMOOTH_STEPS = 8
"""STEPs over which the share of power that is kept is averaged, 0.1 s"""
WAVE_CALLS_DB = (-17.5, -13.5)
"""Share of its input's power that the waveform network keeps, without and with a call. Of recorded rotors
alone it keeps -26 dB, for moments up to -12; of calls as loud as they -11 dB and more."""
MASK_CALLS_DB = (2.0, 4.0)
"""The same of the mask, over what it keeps of the noise alone: that is -11 to -20 dB, as the drone is."""


def window() -> F64:
    """(WINDOW,) square root of Hann: twice applied and overlapped by half it adds up to 1."""
    taper: F64 = np.sin(np.pi * (np.arange(WINDOW) + 0.5) / WINDOW)
    return taper


# --- what is new in a frame ---------------------------------------------------------------------------


class NewSound:
    """The samples that each frame adds to those before, high-passed and finite."""

    def __init__(self, mics: int) -> None:
        self._high_pass = HighPass(HIGH_PASS_HZ, RATE_HZ, mics)
        self._end: int | None = None

    def __call__(self, frame: Frame) -> tuple[F32, bool]:
        """(mics, CHUNK * k), and whether a new stream begins with it: all of the frame is new then."""
        end = frame.start + frame.samples.shape[1]
        new = frame.samples.shape[1] if self._end is None else end - self._end
        fresh = frame.overruns > 0 or not 0 < new < frame.samples.shape[1] or new % CHUNK != 0
        self._end = end
        if fresh:
            self._high_pass.reset()
            new = frame.samples.shape[1]
        return self._high_pass(finite(frame.samples[:, -new:])), fresh


def finite(sound: F32) -> F32:
    """The same, with silence for what is no number and no more than LOUDEST."""
    return np.clip(np.where(np.isfinite(sound), sound, np.float32(0.0)), -LOUDEST, LOUDEST)


class Presence:
    """How sure it is that something calls, 0 to 1, from the share of its power that a sound keeps: smoothed,
    in dB, between two levels (as Cohen & Berdugo, Signal Processing 81 (2001) 2403-2418, do it with the SNR
    of a frame)."""

    def __init__(self, rows: int, levels_db: tuple[float, float]) -> None:
        self._low_db, high_db = levels_db
        self._span_db = high_db - self._low_db
        self._kept: F64 = np.zeros(rows)

    def __call__(self, share: F64, noise_share: float = 1.0) -> F64:
        """Of (rows, steps), each 0 to 1: the same shape. The levels are over `noise_share`."""
        smooth = np.empty_like(share)
        for k in range(share.shape[1]):
            self._kept = self._kept + (share[:, k] - self._kept) / SMOOTH_STEPS
            smooth[:, k] = self._kept
        over_db = 10.0 * np.log10((smooth + LEAST) / (noise_share + LEAST))
        return np.clip((over_db - self._low_db) / self._span_db, 0.0, 1.0)


# --- wave ---------------------------------------------------------------------------------------------


class WaveStream:
    """The waveform network over chunks of a stream, and the floor under it."""

    def __init__(self, network: Network, mics: int) -> None:
        self._network = network
        self._mics = mics
        self.reset()

    def reset(self) -> None:
        """Silence before the next chunk."""
        self._states = self._network.zeros(mics=self._mics)
        self._late: F32 = np.zeros((self._mics, WAVE_DELAY), dtype=np.float32)
        self._presence = Presence(self._mics, WAVE_CALLS_DB)
        self._sure: F64 = np.zeros((self._mics, 1))

    def __call__(self, sound: F32) -> F32:
        """(mics, CHUNK * k) to the clean sound WAVE_DELAY earlier, (mics, CHUNK * k)."""
        clean = []
        for first in range(0, sound.shape[1], CHUNK):
            out, *self._states = self._network([sound[:, first : first + CHUNK], *self._states])
            clean.append(out)
        return self._floored(np.concatenate(clean, axis=1), sound)

    def _floored(self, clean: F32, sound: F32) -> F32:
        """What the network gave by how sure it is of a call, each microphone for itself, over the floor."""
        both = np.concatenate([self._late, sound], axis=1)
        late, self._late = both[:, : sound.shape[1]], both[:, sound.shape[1] :]
        kept, whole = (
            np.square(x.reshape(self._mics, -1, STEP), dtype=np.float64).sum(axis=2) for x in (clean, late)
        )
        sure = np.concatenate([self._sure, self._presence(np.minimum(kept / (whole + LEAST), 1.0))], axis=1)
        self._sure = sure[:, -1:]
        rising = (np.arange(STEP) + 1.0) / STEP  # from one step's to the next's: no clicks
        gain = sure[:, :-1, np.newaxis] + np.diff(sure)[:, :, np.newaxis] * rising
        gain = (1.0 - FLOOR) * gain.reshape(self._mics, -1)
        return np.asarray(FLOOR * late + gain * clean, dtype=np.float32)


class WaveDenoiser:
    """Frames of noisy sound to frames of clean sound, WAVE_DELAY samples earlier in time."""

    def __init__(self, settings: Settings) -> None:
        mics = settings.mic_array.mics
        self._new = NewSound(mics)
        self._stream = WaveStream(load_network(settings.denoise.wave, settings), mics)
        self._held: F32 = np.zeros((mics, settings.audio.frame), dtype=np.float32)
        self._failed: F32 = np.zeros((mics, settings.audio.frame + WAVE_DELAY), dtype=np.float32)

    def __call__(self, frame: Frame) -> Frame:
        sound, fresh = self._new(frame)
        if fresh:
            self._stream.reset()
            self._failed[:] = 0.0
        new = sound.shape[1]
        self._held = _shifted(self._held, self._stream(sound))
        # 0 where the input is finite, NaN where not
        failed = np.where(np.isfinite(frame.samples[:, -new:]), np.float32(0.0), np.float32(np.nan))
        self._failed = _shifted(self._failed, failed)
        samples = self._held + self._failed[:, : self._held.shape[1]]
        earlier_ns = round(WAVE_DELAY * 1e9 / frame.rate_hz)
        return replace(frame, samples=samples, start=frame.start - WAVE_DELAY, t_ns=frame.t_ns - earlier_ns)


def _shifted(held: F32, new: F32) -> F32:
    """The last of both, as many as are held."""
    return np.concatenate([held, new], axis=1)[:, -held.shape[1] :]


# --- mask ---------------------------------------------------------------------------------------------


class NoiseSpectrum:
    """Mean power spectrum of each microphone over the noise that it was told of.

    A plain mean at first, then one that forgets.
    """

    def __init__(self, mics: int, forget_spectra: float, bins: int = BINS + 1) -> None:
        self._share = 1.0 - math.exp(-1.0 / forget_spectra)
        self.mean: F64 = np.zeros((mics, bins))
        """(mics, bins)"""
        self.spectra: F64 = np.zeros(mics)
        """(mics,) learnt from"""

    def learn(self, power: F64) -> None:
        """Takes (mics, spectra, bins) as noise. Silence teaches nothing: it is a failing input."""
        alive = power.sum(axis=2) > LEAST
        for k in range(power.shape[1]):
            live = alive[:, k]
            self.spectra += live
            share = np.maximum(1.0 / np.maximum(self.spectra, 1.0), self._share) * live
            self.mean += share[:, np.newaxis] * (power[:, k] - self.mean)

    def relative(self, power: F64, earliest: float) -> tuple[F64, F64] | None:
        """Of (mics, spectra, bins): power over noise (spectra, bins), and the noise's shape (bins,), both
        means over those microphones that live and whose noise is known from `earliest` spectra or more;
        None where there is none."""
        level = self.mean.sum(axis=1)
        live = (self.spectra >= earliest) & (power.sum(axis=(1, 2)) > DEAD * level)
        if not live.any():
            return None
        known = self.mean[live] + 1e-10 * level[live, np.newaxis] / (self.mean.shape[1] - 1)
        relative = np.minimum((power[live] / known[:, np.newaxis]).mean(axis=0), 1e12)
        return relative, (known / known.sum(axis=1, keepdims=True)).mean(axis=0)


LEAST_PRIOR = 10.0 ** (-25.0 / 10.0)
"""Least a-priori SNR of Wiener's gain, against musical noise (Cappe, IEEE Trans. SAP 2 (1994) 345-349)."""
PRIOR_SMOOTHING = 0.9


def decision_directed(relative: F64, kept: F64) -> tuple[F64, F64]:
    """Wiener's gain of power over noise (spectra, bins), the SNR before each from the output before it
    (Ephraim & Malah, IEEE Trans. ASSP 32 (1984) 1109-1121). `kept` (bins,): that output's power over noise,
    zeros at first; returned again for the next call.
    """
    gains = np.empty_like(relative)
    for k, row in enumerate(relative):
        prior = PRIOR_SMOOTHING * kept + (1.0 - PRIOR_SMOOTHING) * np.maximum(row - 1.0, 0.0)
        prior = np.maximum(prior, LEAST_PRIOR)
        gains[k] = prior / (1.0 + prior)
        kept = np.square(gains[k]) * row
    return gains, kept


class Listening:
    """The gain of the sound that a person hears: where something calls, the geometric mean of the mask and of
    Wiener's gain, which is better than either; where nothing does, FLOOR.

    Two that err apart: the network knows calls but not this drone, Wiener's gain this drone but no calls.
    """

    def __init__(self, forget_spectra: float) -> None:
        self._noise_share = NoiseSpectrum(1, forget_spectra, 1)
        self._earliest = EARLIEST_S * RATE_HZ / STEP
        self.reset()

    def reset(self) -> None:
        """Silence before the next spectra; what the mask keeps of the noise stays known."""
        self._kept: F64 = np.zeros(BINS + 1)
        self._presence = Presence(1, MASK_CALLS_DB)
        self._share: F64 = np.zeros((1, 0))

    def __call__(self, power: F64, relative: F64, mask: F32) -> F64:
        """Of power, power over noise and mask, all (spectra, bins): the gain, the same shape."""
        whole = power.sum(axis=1)
        self._share = ((mask * power).sum(axis=1) / (whole + LEAST))[np.newaxis]
        wiener, self._kept = decision_directed(relative, self._kept)
        gain = np.sqrt(mask * wiener)
        if self._noise_share.spectra[0] < self._earliest:
            return gain
        sure = self._presence(self._share, float(self._noise_share.mean[0, 0]))[0][:, np.newaxis]
        return np.asarray(sure * gain + (1.0 - sure) * FLOOR)

    def learn(self) -> None:
        """The last spectra were noise."""
        self._noise_share.learn(self._share[:, :, np.newaxis])
        self._share = self._share[:, :0]


class MaskStream:
    """The mask network over chunks of a stream."""

    def __init__(self, network: Network, mics: int, forget_s: float = 4.0) -> None:
        self._network = network
        self._taper = window()
        self._mics = mics
        self.noise = NoiseSpectrum(mics, forget_s * RATE_HZ / STEP)
        self._earliest = EARLIEST_S * RATE_HZ / STEP
        self._listening = Listening(forget_s * RATE_HZ / STEP)
        self.power: F64 = np.zeros((mics, 0, BINS + 1))
        """(mics, spectra, bins) of the last chunks"""
        self.reset()

    def reset(self) -> None:
        """Silence before the next chunk; the noise stays known."""
        self._listening.reset()
        self._states = self._network.zeros()
        self._held: F32 = np.zeros((self._mics, WINDOW - STEP), dtype=np.float32)
        self._waiting = np.zeros((self._mics, LOOKAHEAD, BINS + 1), dtype=np.complex64)
        self._overlap: F64 = np.zeros((self._mics, STEP))

    def __call__(self, sound: F32) -> tuple[Array, F32]:
        """Of (mics, CHUNK * k): spectra (mics, 4 k, BINS + 1) that end with each STEP of it, and the mask
        (4 k, BINS + 1) of those that came LOOKAHEAD earlier.

        Without live microphones, or before EARLIEST_S of noise is known, the mask is 1 throughout.
        """
        long = np.concatenate([self._held, sound], axis=1)
        self._held = long[:, -(WINDOW - STEP) :]
        ends = range(WINDOW, long.shape[1] + 1, STEP)
        pieces = np.stack([long[:, end - WINDOW : end] for end in ends], axis=1)
        spectra = np.fft.rfft(pieces * self._taper, axis=2)
        self.power = power = np.square(spectra.real) + np.square(spectra.imag)
        at = range(0, power.shape[1], CHUNK // STEP)
        return spectra, np.concatenate([self._mask(power[:, k : k + CHUNK // STEP]) for k in at])

    def _mask(self, power: F64) -> F32:
        mask = np.ones((power.shape[1], BINS + 1), dtype=np.float32)
        heard = self.noise.relative(power, self._earliest)
        if heard is None:
            return mask
        relative, shape = heard
        found, *self._states = self._network(
            [
                relative[np.newaxis, :, 1:].astype(np.float32),
                shape[np.newaxis, 1:].astype(np.float32),
                *self._states,
            ]
        )
        mask[:, 1:] = found[0]
        mask[:, 0] = 0.0
        return mask

    def learn(self) -> None:
        """Takes the last chunks as noise."""
        self.noise.learn(self.power)
        # a network that has heard noise for a while: its mask of the first moments says nothing
        if self.noise.spectra.max() >= 2.0 * self._earliest:
            self._listening.learn()

    def cleaned(self, spectra: Array, mask: F32) -> F32:
        """The sound MASK_DELAY before the chunk that both came of: (mics, CHUNK * k), every microphone's with
        the same gain (`Listening`); as it came where the noise is not known."""
        waiting = np.concatenate([self._waiting, spectra], axis=1)
        self._waiting = waiting[:, spectra.shape[1] :]
        now = waiting[:, : spectra.shape[1]]
        power = np.square(now.real, dtype=np.float64) + np.square(now.imag, dtype=np.float64)
        heard = self.noise.relative(power, self._earliest)
        gain = mask if heard is None else self._listening(power.mean(axis=0), heard[0], mask)
        pieces = np.fft.irfft(now * gain, axis=2) * self._taper
        before = np.concatenate([self._overlap[:, np.newaxis], pieces[:, :-1, STEP:]], axis=1)
        self._overlap = pieces[:, -1, STEP:]
        clean: F32 = (pieces[:, :, :STEP] + before).reshape(self._mics, -1).astype(np.float32)
        return clean


class MaskDenoiser:
    """Frames to masks. `settle` tells it whether the frame was a call: if not, it is noise to learn from."""

    def __init__(self, settings: Settings) -> None:
        mics, audio = settings.mic_array.mics, settings.audio
        self._new = NewSound(mics)
        self._stream = MaskStream(
            load_network(settings.denoise.mask, settings), mics, settings.denoise.forget_s
        )
        self._frame = audio.frame
        per_frame = (audio.frame - WINDOW) // STEP + 1
        self._masks: F32 = np.ones((per_frame, BINS + 1), dtype=np.float32)
        self._power: F64 = np.zeros((per_frame, BINS + 1))
        at = np.arange(audio.frame // 2 + 1) * (WINDOW / audio.frame)
        self._low = np.minimum(at.astype(np.intp), BINS - 1)
        self._share = (at - self._low).astype(np.float32)
        low, high = settings.correlation.band_hz
        bins = np.arange(BINS + 1) * (RATE_HZ / WINDOW)
        self._band = (bins >= low) & (bins <= high)

    def __call__(self, frame: Frame) -> Mask:
        sound, fresh = self._new(frame)
        if fresh:
            self._stream.reset()
            self._masks[:] = 1.0
            self._power[:] = 0.0
        _, mask = self._stream(sound)
        power = self._stream.power
        self._masks = np.concatenate([self._masks, mask])[-len(self._masks) :]
        self._power = np.concatenate([self._power, power.mean(axis=0)])[-len(self._power) :]
        # mask k belongs to the spectrum LOOKAHEAD before: the frame's first ones have theirs
        masks, heard = self._masks[LOOKAHEAD:], self._power[:-LOOKAHEAD]
        coarse = masks.mean(axis=0)
        weight = coarse[self._low] * (1.0 - self._share) + coarse[self._low + 1] * self._share
        call = float((masks * heard)[:, self._band].sum())
        rest = float(((1.0 - masks) * heard)[:, self._band].sum())
        ready = bool((self._stream.noise.spectra * STEP >= EARLIEST_S * RATE_HZ).any())
        return Mask(
            frame.t_ns,
            weight,
            masks,
            10.0 * math.log10((call + LEAST) / (rest + LEAST)) if ready else -math.inf,
        )

    def settle(self, call: bool, /) -> None:
        """Learns the frame's new spectra as noise where it held no call."""
        if not call:
            self._stream.learn()
