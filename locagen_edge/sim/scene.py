"""The synthetic scene of the settings: a caller round a hovering drone, rotors, sensor noise.

Everything is made in blocks of one fixed length and dealt out in the lengths asked for, each part with a
random generator of its own: the same seed gives the same bytes however they are read, and a caller sounds the
same whatever flies.

Delays follow the distance at the moment of hearing: exact for a drone that turns or moves past a person who
stands, which is the case to be simulated, and which the microphones see as a caller on the move.
"""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, Generator, Iterator
from dataclasses import dataclass, replace
from itertools import count, repeat

import numpy as np

from locagen_edge.framing import Framer, Tap, as_captured, in_real_time
from locagen_edge.geometry import angles
from locagen_edge.settings import Settings
from locagen_edge.sim.calls import CALLS
from locagen_edge.sim.levels import band_power, from_db, in_band
from locagen_edge.sim.propagation import REACH, interpolate, interpolate_steadily, paths
from locagen_edge.sim.rotors import hubs_m, rotor
from locagen_edge.sim.synth import joined
from locagen_edge.types import F32, F64, Array, Frame, Truth

OVERSAMPLE = 2  # sounds are made at twice the rate, so that short kernels delay them exactly
BLOCK = 2048  # samples made at once: 2 ms of work, so that the event loop keeps breathing
TOP_HZ = 8000.0  # sounds end here, or at 0.48 of the processing rate
FADE_S = 0.010  # a call begins and ends within this
UTTERANCE_S = 5.0  # longer calls are made of several

PARTS = ("call", "rotors", "sensor")


class Scene:
    """Renders the scene, sample after sample from 0."""

    def __init__(self, settings: Settings) -> None:
        sim = settings.sim
        self._sim = sim
        self._rate_hz = float(settings.audio.rate_hz)
        self._speed_m_s = settings.speed_m_s
        self._positions_m = settings.mic_array.positions_m
        self._timeline = Timeline.of(sim.call_s, sim.pause_s, OVERSAMPLE * self._rate_hz)

        call_rng, sensor_rng, *rotor_rngs = (
            np.random.default_rng(seed) for seed in np.random.SeedSequence(sim.seed).spawn(2 + sim.rotors)
        )
        self._sensor_rng = sensor_rng
        made_hz = OVERSAMPLE * self._rate_hz
        top_hz = min(TOP_HZ, 0.48 * self._rate_hz)
        self._call = Tape(voice(sim.call, self._timeline, made_hz, top_hz, call_rng))
        self._rotors = [Tape(rotor(sim.throttle, made_hz, top_hz, rng)) for rng in rotor_rngs]
        self._hubs_m = hubs_m(sim.rotors, sim.rotor_arm_m)
        self._call_gain, self._rotor_gain, self._sensor_gain = self._gains()

        self._made = 0
        self._ready: F32 = np.empty((len(PARTS), len(self._positions_m), 0), dtype=np.float32)

    def _gains(self) -> tuple[float, float, float]:
        """Of call (in-band power 1 at the origin), rotors (1 at 1 m each) and sensor noise (variance 1)."""
        sim = self._sim
        noise = from_db(sim.noise_dbfs)
        sensor = noise
        rotor_gain = 0.0
        if self._rotors:
            ratio = from_db(sim.sensor_db)
            sensor = noise * ratio / (1.0 + ratio)
            _, spreading = paths(self._positions_m, self._hubs_m, self._speed_m_s)
            at_mics = np.mean(np.sum(spreading**2, axis=0))  # rotors do not know of each other: powers add
            rotor_gain = math.sqrt((noise - sensor) / at_mics)
        frequency = np.linspace(0.0, self._rate_hz / 2, 10001)
        share = float(np.mean(in_band(frequency, self._rate_hz)))  # of white noise
        return math.sqrt(noise * from_db(sim.snr_db)), rotor_gain, math.sqrt(sensor / share)

    def render(self, n: int) -> F32:
        """The next n samples: (mics, n)."""
        mixed: F32 = self.parts(n).sum(axis=0)
        return mixed

    def parts(self, n: int) -> F32:
        """The same before the sum: (call, rotors and sensor; mics; n)."""
        ready = [self._ready]
        while sum(block.shape[2] for block in ready) < n:
            ready.append(self._block())
        whole = np.concatenate(ready, axis=2)
        self._ready = whole[:, :, n:].copy()
        return whole[:, :, :n]

    def truth(self, sample: float) -> Truth:
        """What is true at the time of this sample, whole or not, as the origin hears it."""
        time_s = sample / self._rate_hz
        source_m = self.source_m(np.array(time_s))
        azimuth_rad, elevation_rad = angles(source_m)
        range_m = float(np.linalg.norm(source_m))
        left_s = time_s - range_m / self._speed_m_s
        return Truth(azimuth_rad, elevation_rad, range_m, self._timeline.calling(left_s))

    def source_m(self, time_s: F64) -> F64:
        """Where the caller is at these times (...): (..., 3) in body axes."""
        sim = self._sim
        azimuth = np.radians(sim.azimuth_deg + sim.turn_deg_s * time_s)
        x, y = sim.distance_m * np.cos(azimuth), sim.distance_m * np.sin(azimuth)
        return np.stack([x, y, np.full_like(x, sim.height_m)], axis=-1)

    def _block(self) -> F32:
        mics = len(self._positions_m)
        block = np.zeros((len(PARTS), mics, BLOCK), dtype=np.float32)
        time_s = (self._made + np.arange(BLOCK)) / self._rate_hz
        self._made += BLOCK

        source_m = self.source_m(time_s)
        delay_s, gain = paths(self._positions_m, source_m, self._speed_m_s)
        gain = gain * np.linalg.norm(source_m, axis=1, keepdims=True)
        block[0] = self._heard(self._call, time_s, delay_s.T, self._call_gain * gain.T)
        for tape, hub_m in zip(self._rotors, self._hubs_m, strict=True):
            delay_s, gain = paths(self._positions_m, hub_m, self._speed_m_s)
            block[1] += self._heard(
                tape, time_s, delay_s[:, np.newaxis], self._rotor_gain * gain[:, np.newaxis]
            )
        # drawn sample by sample, microphone by microphone
        noise = self._sensor_rng.standard_normal((BLOCK, mics), dtype=np.float32).T
        block[2] = np.float32(self._sensor_gain) * noise
        return block

    def _heard(self, tape: Tape, time_s: F64, delay_s: F64, gain: F64) -> Array:
        """(mics, n): a sound with these delays and gains (mics, n or 1)."""
        at = (time_s - delay_s) * (OVERSAMPLE * self._rate_hz)
        first = math.floor(at.min()) - REACH
        signal = tape.read(first, math.floor(at.max()) + REACH + 2)
        if delay_s.shape[1] == 1:
            return gain * interpolate_steadily(signal, at[:, 0] - first, OVERSAMPLE, len(time_s))
        return gain * interpolate(signal, at - first)


@dataclass(frozen=True)
class Timeline:
    """Calls and pauses, for ever."""

    rate_hz: float
    call: int
    """samples of one call"""
    pause: int
    """samples between two calls; 0: one call without an end"""

    @classmethod
    def of(cls, call_s: float, pause_s: float, rate_hz: float) -> Timeline:
        return cls(rate_hz, round(call_s * rate_hz), round(pause_s * rate_hz))

    def calling(self, time_s: float) -> bool:
        """Whether the caller, not the listener, sounds at this time."""
        sample = time_s * self.rate_hz
        return sample >= 0 and (self.pause == 0 or sample % (self.call + self.pause) < self.call)


def voice(
    kind: str, timeline: Timeline, rate_hz: float, top_hz: float, rng: np.random.Generator
) -> Iterator[F64]:
    """All that the caller utters from time 0, in pieces (any,): in-band power 1 in a call, else silence."""
    fade = round(FADE_S * rate_hz)
    longest = round(UTTERANCE_S * rate_hz)
    pieces = max(1, math.ceil((timeline.call - fade) / longest))
    # all pieces but the last are of one length; joined, they are as long as the call
    step = math.ceil((timeline.call - fade) / pieces)
    lengths = [step + fade] * (pieces - 1) + [timeline.call - step * (pieces - 1)]

    def utterance(n: int) -> F64:
        sound = CALLS[kind](n, rate_hz, top_hz, rng)
        return sound / math.sqrt(band_power(sound, rate_hz))

    if timeline.pause == 0:
        yield from joined((utterance(lengths[0]) for _ in count()), fade)
    for silence in repeat(np.zeros(timeline.pause)):
        yield from joined((utterance(n) for n in lengths), fade)
        yield silence


class Tape:
    """Random access to an endless sound, forwards: what lies before the last read is forgotten."""

    def __init__(self, pieces: Iterator[F64]) -> None:
        self._pieces = pieces
        self._held: F32 = np.zeros(0, dtype=np.float32)
        self._first = 0  # number of the first sample held

    def read(self, start: int, stop: int) -> F32:
        """Samples start to stop (left out); there is silence before sample 0. `start` never goes back."""
        held = [self._held]
        end = self._first + len(self._held)
        while end < stop:
            held.append(next(self._pieces).astype(np.float32))
            end += len(held[-1])
        forget = max(start, 0) - self._first
        self._held = np.concatenate(held)[forget:]
        self._first += forget
        sound = self._held[: max(stop - self._first, 0)]
        before = np.zeros(max(min(0, stop) - start, 0), dtype=np.float32)
        return np.concatenate([before, sound])


def frames(settings: Settings, tap: Tap | None = None, origin_ns: int = 0) -> Generator[Frame, None, None]:
    """Frames of the scene without an end, each with its truth, as fast as taken; time counts from
    `origin_ns`."""
    audio = settings.audio
    scene = Scene(settings)
    framer = Framer(audio.frame, audio.hop, settings.mic_array.mics, audio.rate_hz, origin_ns)
    while True:
        block = scene.render(audio.hop)
        if tap is not None:
            tap.block(as_captured(block, audio.channel_map), audio.rate_hz, framer.origin_ns)
        for frame in framer.push(block):
            yield replace(frame, truth=scene.truth(frame.start + audio.frame / 2))


def sim(settings: Settings, tap: Tap | None = None) -> AsyncGenerator[Frame, None]:
    """The same in real time."""
    return in_real_time(lambda origin_ns: frames(settings, tap, origin_ns))
