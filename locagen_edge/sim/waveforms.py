"""The twin at the level of waveforms: what the microphones would record, with the truth beside.

The same array, air, places and imperfections as at the level of arrivals (`TwinSettings`), and above them
what only sound has (`SceneSettings`): a source spectrum, a ground, rotors, wind, a converter. A scene is
made in the frequency domain, where a delay is a factor and therefore exact:

    heard(f) = sum over ways (direct, ground, each rotor) of signal(f) * gain * exp(-2 pi i f delay)

Periodic noise, cut shorter than its period, is as good as endless noise; all other sounds are longer than
what is cut out of them, by more than the longest delay, and faded at their ends.

Samples come in blocks, each from a generator of its own that is seeded by (seed, level, number of the
block): sample k of a seed is the same whoever draws it and however many are asked for. The arrays of a block
stay in the cache, and single precision holds: delays are turned into phases in double precision, relative to
the array's middle, and float32's own rounding is -140 dB.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from locagen_edge.geometry import MicArray
from locagen_edge.settings import setting
from locagen_edge.sim.arrivals import TwinSettings
from locagen_edge.sim.calls import CALLS
from locagen_edge.sim.converter import convert, drifted
from locagen_edge.sim.ground import image_m
from locagen_edge.sim.levels import from_db, in_band
from locagen_edge.sim.propagation import REACH, paths
from locagen_edge.sim.rotors import OVERLAP, hubs_m, rotor
from locagen_edge.sim.wind import C64, wind
from locagen_edge.types import F32, F64, Array

BLOCK_SAMPLES = 32768
"""Samples of one microphone per generator: 32 frames of 1024, whose arrays fill a second-level cache."""

LEVEL = 1  # beside the block's number in the seed, so that arrivals and waveforms are independent draws
FADE = 64  # samples over which a sound begins and ends outside of what is kept
ONSET_S = 0.010  # how fast a call begins that is not there from the start
UTTERANCE_S = 0.6  # what is heard is cut from an utterance of at least this: two or three syllables
LOUD = 0.1  # ... where its energy is at least this share of the loudest place's
NEAREST_M = 0.5  # no source comes nearer to the array's middle
WHITE_LOW_HZ = 100.0

RECORDED = "recorded"
SOUNDS = (*CALLS, RECORDED)

SILENCE: C64 = np.zeros((1, 1, 1), dtype=np.complex64)
"""spectra (samples, mics, bins) of nothing"""

Sounds = Sequence[tuple[str, F32]]
"""recorded sounds: (name, (n,) at the scene's rate)"""


@dataclass(frozen=True)
class SceneSettings:
    """The twin's waveforms: what sounds, under what noise, into what converter."""

    sounds: tuple[str, ...] = setting(
        ("white",), "What may sound; each sample draws one of them.", choices=SOUNDS
    )
    recordings: str = setting(
        "",
        "Folder of recorded sounds (WAV, FLAC, OGG; any rate; folders below it too), for `recorded`. No "
        "quotation marks or backslashes.",
        pattern=r'[^"\\\n]*',
    )
    frames: int = setting(
        1, "Length of a sample, in frames every audio.hop.", unit="frames", least=1, most=100_000
    )
    lead_s: float = setting(0.0, "Noise alone before the call.", unit="s", least=0, most=3600)
    top_hz: float = setting(
        8000.0, "No sound goes above this, or above 0.48 of audio.rate_hz.", unit="Hz", least=1000, most=48000
    )
    slope: float = setting(
        0.0, "The power of `white` falls as frequency ** -slope above 1 kHz.", least=-6, most=6
    )
    level_dbfs: float = setting(
        -30.0, "In-band level of the call where twin.snr_db holds.", unit="dBFS", least=-120, most=20
    )
    snr_span_db: float = setting(
        0.0,
        "The SNR is drawn from twin.snr_db to this much above, uniform in dB.",
        unit="dB",
        least=0,
        most=140,
    )
    snr_at_m: float = setting(
        0.0,
        "The SNR is that at this range and follows the range, by 6 dB each time it doubles; 0: at any range.",
        unit="m",
        least=0,
        most=10000,
    )
    ground: float = setting(0.0, "Reflection coefficient of flat ground; 0: none.", least=-1, most=1)
    mouth_m: float = setting(1.5, "Height of the source above that ground.", unit="m", least=0, most=100)
    rotors: int = setting(0, "Number of rotors.", unit="rotors", least=0, most=8)
    rotor_arm_m: float = setting(
        0.30,
        "Distance of each hub from the middle of the array, seen from above.",
        unit="m",
        least=0.02,
        most=5,
    )
    rotor_z_m: float = setting(0.0, "How far the hubs are below the array.", unit="m", least=-5, most=5)
    rotor_snr_db: float = setting(
        0.0,
        "In-band level of the call, where twin.snr_db holds, over all rotors, mean of the microphones.",
        unit="dB",
        least=-80,
        most=80,
    )
    throttle: tuple[float, ...] = setting(
        (0.3, 0.7), "Lowest and highest throttle; each sample draws one.", least=0, most=1
    )
    wind_m_s: float = setting(0.0, "Speed of the wind past the array; 0: none.", unit="m/s", least=0, most=40)
    wind_dbfs: float = setting(
        -40.0, "Level of the wind's noise, all frequencies.", unit="dBFS", least=-120, most=20
    )
    gain_db: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "Gain of each microphone's channel.", unit="dB", least=-60, most=60
    )
    gain_error_db: float = setting(
        0.0,
        "Each gain is off by up to this, uniform in dB, anew for every sample.",
        unit="dB",
        least=0,
        most=60,
    )
    bits: int = setting(
        16, "Word length of the converter, which clips at 0 dBFS; 0: neither.", unit="bits", least=0, most=24
    )


@dataclass(frozen=True, slots=True, eq=False)
class Waveforms:
    """What the array recorded and what was true; one row per sample."""

    sound: F32
    """(samples, mics, n) full scale 1.0"""
    call: F32
    """(samples, mics, n) the call in it, as it enters the converter"""
    onset: Array
    """(samples,) int32: number of the first sample of the call"""
    kind: Array
    """(samples,) names of the sounds; a recorded one's is `recorded:` and its file"""
    snr_db: F32
    """(samples,) in-band, call at the array's middle over sensor noise and rotors; infinite without either"""
    position_m: F32
    """(samples, 3) of the source, from the array's middle, body axes"""
    azimuth_rad: F32
    """(samples,) -pi to pi"""
    elevation_rad: F32
    """(samples,) positive up"""
    true_delay_s: F32
    """(samples, pairs) t_j - t_i on the direct way, at the microphones' displaced places"""


def draw(
    array: MicArray,
    speed_m_s: float,
    rate_hz: float,
    n: int,
    twin: TwinSettings,
    scene: SceneSettings,
    count: int,
    seed: int,
    first: int = 0,
    recorded: Sounds = (),
) -> Waveforms:
    """Samples `first` to `first + count` of a seed's endless row: n samples long, at `rate_hz`.

    Same arguments, same bytes (with the same numpy on the same kind of processor). `twin.rounding` means
    nothing here, nor does `twin.noise_us`; with `twin.noise` none there is no sensor noise.
    """
    studio = Studio(array, speed_m_s, rate_hz, n, twin, scene, recorded)
    length = max(1, BLOCK_SAMPLES // n)
    pieces = []
    for number in range(first // length, -(-(first + count) // length)):
        rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(number, LEVEL))))
        start = number * length
        block = studio.block(start, length, rng)
        inside = slice(max(first - start, 0), min(first + count - start, length))
        pieces.append({f.name: getattr(block, f.name)[inside] for f in fields(block)})
    return Waveforms(**{f.name: np.concatenate([p[f.name] for p in pieces]) for f in fields(Waveforms)})


@dataclass(frozen=True, eq=False)
class Studio:
    """One setting of everything, and what follows from it alone."""

    array: MicArray
    speed_m_s: float
    rate_hz: float
    n: int
    twin: TwinSettings
    scene: SceneSettings
    recorded: Sounds

    @cached_property
    def places_m(self) -> F64:
        """(mics, 3) from the array's middle."""
        places: F64 = self.array.positions_m - self.array.positions_m.mean(axis=0)
        return places

    @cached_property
    def margin(self) -> int:
        """Samples before and after what is kept: the longest delay, all clocks' drift, and the fade."""
        twin, scene = self.twin, self.scene
        radius = float(np.linalg.norm(self.places_m, axis=1).max()) + 2.0 * twin.position_error_m
        detour_m = 2.0 * scene.mouth_m if scene.ground else 0.0
        delay = (radius + detour_m) / self.speed_m_s * self.rate_hz
        skew = max(map(abs, twin.offset_samples), default=0.0) + 1.0
        longest_m = math.hypot(max(twin.range_m, NEAREST_M), twin.height_m + twin.height_span_m)
        drift = 2e-6 * twin.clock_ppm * (self.n + longest_m / self.speed_m_s * self.rate_hz)
        return math.ceil(delay + skew + drift) + REACH + FADE

    @cached_property
    def size(self) -> int:
        return fast_size(self.n + 2 * self.margin)

    @cached_property
    def top_hz(self) -> float:
        return min(self.scene.top_hz, 0.48 * self.rate_hz)

    @cached_property
    def frequency_hz(self) -> F64:
        """(bins,) as far as anything sounds."""
        bins = math.floor(self.top_hz * self.size / self.rate_hz) + 1
        return np.arange(bins, dtype=np.float64) * (self.rate_hz / self.size)

    @cached_property
    def onset(self) -> int:
        return min(round(self.scene.lead_s * self.rate_hz), self.n)

    @cached_property
    def kept(self) -> slice:
        return slice(self.margin, self.margin + self.n)

    @cached_property
    def called(self) -> slice:
        """What is kept of the call."""
        return slice(min(self.margin + self.onset, self.margin + self.n - 1), self.margin + self.n)

    @cached_property
    def fade(self) -> F32:
        """(size,) that brings a sound to zero at both ends."""
        rise = rising(FADE)
        gain = np.ones(self.size, dtype=np.float32)
        gain[:FADE] = rise
        gain[-FADE:] = rise[::-1]
        return gain

    def block(self, start: int, count: int, rng: np.random.Generator) -> Waveforms:
        """Samples `start` to `start + count`."""
        twin, scene, mics = self.twin, self.scene, self.array.mics
        source_m = self._sources(start, count, rng)
        error = rng.uniform(-twin.position_error_m, twin.position_error_m, (count, mics, 2))
        mics_m = np.broadcast_to(self.places_m, (count, mics, 3)).copy()
        mics_m[..., :2] += error
        range_m: F64 = np.linalg.norm(source_m, axis=1)

        kinds, signal = self._calls(count, rng)
        call_power, sensor_power, rotor_power = self._powers(range_m, rng)
        signal *= np.sqrt(call_power).astype(np.float32)[:, np.newaxis]
        delay_s, gain = paths(mics_m, source_m, self.speed_m_s)
        way = self._ways(delay_s, gain, range_m)
        if scene.ground:
            image = paths(mics_m, image_m(source_m, source_m[:, 2] + scene.mouth_m), self.speed_m_s)
            way += np.float32(scene.ground) * self._ways(*image, range_m)
        call = signal[:, np.newaxis] * way

        skew, clock, channel = self._channels(count, range_m, rng)
        extra = self._rotors(mics_m, rotor_power, rng) + self._wind(mics_m, rng)
        heard = np.stack([call, call + extra]) if np.any(extra) else call[np.newaxis]
        if skew is not None:
            heard *= turns(skew, self.size, len(self.frequency_hz))
        sounds = self._sampled(heard, clock) * channel[:, :, np.newaxis]
        noisy = sounds[-1]
        if np.any(sensor_power):
            noise = rng.standard_normal(noisy.shape, dtype=np.float32)
            noise *= (np.sqrt(sensor_power)[:, np.newaxis] * channel)[:, :, np.newaxis].astype(np.float32)
            noisy = noisy + noise
        with np.errstate(divide="ignore"):
            snr_db = 10.0 * np.log10(call_power / (sensor_power * self._share + rotor_power))
        first, second = np.array(self.array.pairs).T
        return Waveforms(
            sound=convert(noisy, scene.bits),
            call=sounds[0],
            onset=np.full(count, self.onset, np.int32),
            kind=kinds,
            snr_db=snr_db.astype(np.float32),
            position_m=source_m.astype(np.float32),
            azimuth_rad=np.arctan2(source_m[:, 1], source_m[:, 0]).astype(np.float32),
            elevation_rad=np.arcsin(-source_m[:, 2] / range_m).astype(np.float32),
            true_delay_s=(delay_s[:, second] - delay_s[:, first]).astype(np.float32),
        )

    # --- where, how loud ------------------------------------------------------------------------------

    def _sources(self, start: int, count: int, rng: np.random.Generator) -> F64:
        """(count, 3) metres."""
        twin = self.twin
        if twin.source == "sweep":
            steps = max(round(360.0 / twin.step_deg), 1)
            angle = np.arange(start, start + count) % steps * (2.0 * np.pi / steps)
            radius = np.full(count, twin.range_m)
        else:
            angle = rng.uniform(-np.pi, np.pi, count)
            # the area between the nearest place and r grows with r^2
            radius = np.sqrt(rng.uniform(NEAREST_M**2, max(twin.range_m, NEAREST_M) ** 2, count))
        height = np.full(count, twin.height_m)
        if twin.height_span_m:
            height += rng.uniform(0.0, twin.height_span_m, count)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)

    @cached_property
    def _share(self) -> float:
        """Of white noise's power that counts as in-band."""
        return float(np.mean(in_band(np.linspace(0.0, self.rate_hz / 2.0, 10001), self.rate_hz)))

    def _powers(self, range_m: F64, rng: np.random.Generator) -> tuple[F64, F64, F64]:
        """(count,) of the call in the band, the sensor noise as a whole, and the rotors in the band."""
        twin, scene = self.twin, self.scene
        reference = np.full(len(range_m), from_db(scene.level_dbfs))
        snr_db = twin.snr_db + rng.uniform(0.0, 1.0, len(range_m)) * scene.snr_span_db
        nearer = (scene.snr_at_m / range_m) ** 2 if scene.snr_at_m else np.ones(len(range_m))
        sensor = reference * 10.0 ** (-snr_db / 10.0) / self._share * (twin.noise == "snr")
        rotors = reference * (from_db(-scene.rotor_snr_db) if scene.rotors else 0.0)
        return reference * nearer, sensor, rotors

    def _ways(self, delay_s: F64, gain: F64, range_m: F64) -> C64:
        """Transfer functions (count, mics, bins), 1 at the array's middle on the direct way."""
        later = (delay_s - range_m[:, np.newaxis] / self.speed_m_s) * self.rate_hz
        spread = (gain * range_m[:, np.newaxis]).astype(np.float32)
        way = turns(later, self.size, len(self.frequency_hz))
        way *= spread[:, :, np.newaxis]
        return way

    # --- what sounds ----------------------------------------------------------------------------------

    def _calls(self, count: int, rng: np.random.Generator) -> tuple[Array, C64]:
        """Names (count,) and spectra (count, bins) of in-band power 1 where they are kept."""
        sounds = self.scene.sounds
        drawn = rng.integers(len(sounds), size=count)
        names = [sounds[k] for k in drawn]
        spectra = np.zeros((count, len(self.frequency_hz)), dtype=np.complex64)
        white = np.array([name == "white" for name in names])
        if white.any():
            spectra[white] = self._white(int(white.sum()), rng)
        timed = np.flatnonzero(~white)
        if len(timed):
            tape = np.empty((len(timed), self.size), dtype=np.float32)
            for row, k in enumerate(timed):
                names[k], tape[row] = self._utterance(names[k], rng)
            spectra[timed] = np.fft.rfft(tape * self.fade, axis=1)[:, : spectra.shape[1]]
        if white.all() and self.onset == 0:  # steady: its power over the period is that over any part
            inside = in_band(self.frequency_hz, self.rate_hz)
            within = np.abs(spectra[:, inside])
            power = 2.0 / self.size**2 * np.einsum("kf,kf->k", within, within)
        else:
            tape = np.fft.irfft(spectra, self.size, axis=1).astype(np.float32, copy=False)
            if self.onset:
                tape[:, : self.called.start] = 0.0
                rise = rising(min(round(ONSET_S * self.rate_hz), self.size - self.called.start))
                tape[:, self.called.start : self.called.start + len(rise)] *= rise
                spectra = np.fft.rfft(tape, axis=1)[:, : spectra.shape[1]].astype(np.complex64)
            power = band_powers(tape[:, self.called], self.rate_hz)
        spectra /= np.sqrt(np.maximum(power, 1e-20)).astype(np.float32)[:, np.newaxis]
        return np.array(names), spectra

    def _white(self, count: int, rng: np.random.Generator) -> C64:
        """Gaussian noise (count, bins) from WHITE_LOW_HZ up, sloping above 1 kHz, of any level."""
        low = math.ceil(WHITE_LOW_HZ * self.size / self.rate_hz)
        shape = np.maximum(self.frequency_hz[low:] / 1000.0, 1.0) ** (-0.5 * self.scene.slope)
        spectra = np.zeros((count, len(self.frequency_hz)), dtype=np.complex64)
        noise = rng.standard_normal((count, 2 * len(shape)), dtype=np.float32).view(np.complex64)
        np.multiply(noise, shape.astype(np.float32), out=spectra[:, low:])
        return spectra

    def _utterance(self, kind: str, rng: np.random.Generator) -> tuple[str, F32]:
        """Its name, and (size,) cut from where it is loud."""
        if kind == RECORDED:
            file, sound = self.recorded[int(rng.integers(len(self.recorded)))]
            name, whole = f"{RECORDED}:{file}", np.pad(sound, max(self.size - self.n // 4, 0))
        else:
            length = max(self.size, round(UTTERANCE_S * self.rate_hz))
            name, whole = kind, CALLS[kind](length, self.rate_hz, self.top_hz, rng).astype(np.float32)
        energy = np.concatenate([[0.0], np.cumsum(whole.astype(np.float64) ** 2)])
        starts = np.arange(len(whole) - self.size + 1)
        kept = energy[starts + self.called.stop] - energy[starts + self.called.start]
        start = rng.choice(np.flatnonzero(kept >= LOUD * kept.max()))
        return name, whole[start : start + self.size]

    def _rotors(self, mics_m: F64, power: F64, rng: np.random.Generator) -> C64:
        """Spectra (count, mics, bins) of all rotors, with near-field delays and gains."""
        scene, count = self.scene, len(mics_m)
        if not scene.rotors:
            return SILENCE
        total = np.zeros((count, mics_m.shape[1], len(self.frequency_hz)), dtype=np.complex64)
        throttle = rng.uniform(scene.throttle[0], scene.throttle[1], count)
        hubs = hubs_m(scene.rotors, scene.rotor_arm_m, scene.rotor_z_m)
        away_s = float(np.linalg.norm(hubs[0])) / self.speed_m_s  # all hubs are as far
        loudness = np.zeros(mics_m.shape[:2])
        for hub in hubs:
            delay_s, gain = paths(mics_m, np.broadcast_to(hub, (count, 3)), self.speed_m_s)
            tape = np.stack([self._rotor(t, rng) for t in throttle]) * self.fade
            spectra = np.fft.rfft(tape, axis=1)[:, np.newaxis, : total.shape[2]]
            way = turns((delay_s - away_s) * self.rate_hz, self.size, total.shape[2])
            total += spectra * way * gain[:, :, np.newaxis].astype(np.float32)
            loudness += gain**2  # rotors do not know of each other: powers add
        total *= np.sqrt(power / loudness.mean(axis=1)).astype(np.float32)[:, np.newaxis, np.newaxis]
        return total

    def _rotor(self, throttle: float, rng: np.random.Generator) -> F32:
        """(size,)"""
        piece = next(rotor(throttle, self.rate_hz, self.top_hz, rng, self.size + 2 * OVERLAP))
        return piece[OVERLAP:].astype(np.float32)

    def _wind(self, mics_m: F64, rng: np.random.Generator) -> C64:
        """Spectra (count, mics, bins)."""
        scene = self.scene
        if not scene.wind_m_s:
            return SILENCE
        spectra = wind(mics_m, self.frequency_hz, self.size, scene.wind_m_s, rng)
        spectra *= np.float32(math.sqrt(from_db(scene.wind_dbfs)))
        return spectra

    # --- the channels ---------------------------------------------------------------------------------

    def _channels(
        self, count: int, range_m: F64, rng: np.random.Generator
    ) -> tuple[F64 | None, F64 | None, F32]:
        """Delays in samples (count, mics), moments of sampling (count, mics, n), gains (count, mics).

        None: no delay, or clocks that are right.
        """
        twin, scene, shape = self.twin, self.scene, (count, self.array.mics)
        skew = np.broadcast_to(np.array(twin.offset_samples, dtype=np.float64), shape)
        if twin.phase == "each":
            skew = skew + rng.random(shape)
        gain_db = np.array(scene.gain_db) + rng.uniform(-1.0, 1.0, shape) * scene.gain_error_db
        moments = None
        if twin.clock_ppm:
            fast = rng.uniform(-1e-6, 1e-6, (*shape, 1)) * twin.clock_ppm
            # a clock that is fast by 1e-6 has counted 1e-6 more samples than there were since the call began
            since = (range_m / self.speed_m_s * self.rate_hz)[:, np.newaxis, np.newaxis]
            moments = (since + np.arange(self.n)) / (1.0 + fast) - since
        return (
            skew if np.any(skew) else None,
            moments,
            (10.0 ** (gain_db / 20.0)).astype(np.float32),
        )

    def _sampled(self, heard: Array, moments: F64 | None) -> F32:
        """Spectra (..., count, mics, bins) as sound (..., count, mics, n)."""
        if moments is not None:
            return np.stack([drifted(part, self.size, self.margin + moments) for part in heard])
        sound: F32 = np.fft.irfft(heard, self.size, axis=-1)[..., self.kept].astype(np.float32, copy=False)
        return sound


def rising(n: int) -> F32:
    """(n,) from 0 to 1 with no corner, so that little is heard above the band."""
    rise: F64 = 0.5 - 0.5 * np.cos(np.pi * (np.arange(n) + 0.5) / n)
    return rise.astype(np.float32)


# --- frequency domain ---------------------------------------------------------------------------------


def turns(delay: F64, size: int, bins: int) -> C64:
    """exp(-2 pi i k delay / size), k = 0 ... bins - 1: the factor (..., bins) that delays by (...,) samples.

    Bin k is the product of bin k % 32 and bin k - k % 32, so that few exponentials are needed.
    """
    fine = 32
    angle = delay[..., np.newaxis] * (-2.0 * np.pi / size)
    step = np.exp(1j * (angle * np.arange(fine))).astype(np.complex64)
    leap = np.exp(1j * (angle * np.arange(0, bins, fine))).astype(np.complex64)
    table = leap[..., :, np.newaxis] * step[..., np.newaxis, :]
    turned: C64 = table.reshape(*delay.shape, -1)[..., :bins]
    return turned


def fast_size(least: int) -> int:
    """The smallest even number from `least` on with no factor above 5: what an FFT does fast."""
    best = 1 << max(least - 1, 1).bit_length()
    for fives in range(math.ceil(math.log(least, 5)) + 1):
        for threes in range(math.ceil(math.log(least, 3)) + 1):
            odd = 5**fives * 3**threes
            twos = max(math.ceil(math.log2(least / odd)), 1)
            if odd << twos >= least:
                best = min(best, odd << twos)
    return best


def band_powers(sound: Array, rate_hz: float) -> F64:
    """In-band mean square (rows,) of (rows, n)."""
    n = sound.shape[1]
    spectrum = np.abs(np.fft.rfft(sound.astype(np.float64), axis=1)) ** 2
    inside = in_band(np.fft.rfftfreq(n, 1.0 / rate_hz), rate_hz)
    power: F64 = 2.0 * spectrum[:, inside].sum(axis=1) / n**2
    return power
