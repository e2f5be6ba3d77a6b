"""Wires the way: Frame in, Estimate out. No clock, no I/O, no asyncio.

The same object flies in the daemon, replays recordings, is tested and is timed. Time is that of the frames.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from locagen_edge.errors import SettingsError, SourceError
from locagen_edge.geometry import tolerance_rad
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing import make_locator
from locagen_edge.stages.bearing.common import Locator
from locagen_edge.stages.correlation import Correlator
from locagen_edge.stages.denoise import MaskDenoiser, WaveDenoiser
from locagen_edge.stages.detection import Detector
from locagen_edge.stages.faults import FaultFinder
from locagen_edge.stages.position import Positioner, sighting
from locagen_edge.stages.repeats import Repeats
from locagen_edge.stages.tdoa import PeakPicker
from locagen_edge.stages.track import Tracker
from locagen_edge.types import Bearing, Estimate, Frame, Pose, Quaternion, Sighting, Track


class Pipeline:
    """From sound to bearings and places, for one stream of frames.

    Raises `ModelError` or `KernelError` where the settings ask for what cannot be made.
    """

    def __init__(self, settings: Settings):
        array, audio = settings.mic_array, settings.audio
        self._settings = settings
        self._shape = (array.mics, audio.frame)
        self._hop_s = settings.hop_s
        self._denoise, self._mask = _made_denoiser(settings)
        self._correlate, self._pick, self._locate = _made_for_array(settings)
        self._detect = Detector(settings.detection)
        self._repeats = Repeats(settings)
        self._find_faults = FaultFinder(settings)
        self._tolerance_rad = tolerance_rad(array, settings.array.tolerance_m)
        self._positioner = Positioner(settings.position)
        self._track = Tracker(
            settings.track,
            settings.pose,
            self._tolerance_rad,
            audio.frame / audio.hop,
            array.normal,
        )
        self._last_ns: int | None = None

    @property
    def channels_judged(self) -> bool:
        """Whether there has been a sound from which faults between channels can be told."""
        return self._find_faults.judged

    def apply(self, settings: Settings) -> None:
        """New settings from the next frame on: call it between two frames.

        What has been learnt stays, except that a locator for another array or another speed of sound starts
        anew with the noise; callers keep their tracks and numbers. Sound of another shape takes another
        pipeline.
        Raises as the constructor does, and nothing has changed then.
        """
        if settings.audio != self._settings.audio:
            raise SettingsError("audio: cannot be changed while sound comes in")
        denoiser = self._denoise, self._mask
        if _for_denoiser(settings) != _for_denoiser(self._settings):
            denoiser = _made_denoiser(settings)
        if _for_array(settings) != _for_array(self._settings):
            self._correlate, self._pick, self._locate = _made_for_array(settings)
            self._find_faults.apply(settings)
        self._denoise, self._mask = denoiser
        self._settings = settings
        self._locate.apply(settings)
        self._detect.apply(settings.detection)
        self._repeats.apply(settings)
        self._track.apply(settings.track, settings.pose, settings.mic_array.normal)

    def forget_noise(self) -> None:
        """Learns background and noise from nothing: call it between two frames.

        Raises as the constructor does, and nothing is forgotten then.
        """
        self._denoise, self._mask = _made_denoiser(self._settings)
        self._locate.forget()
        self._detect.forget()

    def process(self, frame: Frame, pose: Pose | None = None) -> Estimate:
        """The estimate for one frame. Frames have to come in the order of time; gaps are allowed.

        `pose`: the vehicle's at the frame's middle, if need be the frame's own; without one, callers are
        followed as the body sees them.
        """
        pose = pose or frame.pose
        if frame.samples.shape != self._shape:
            raise SourceError(f"a frame of shape {frame.samples.shape} came, settings say {self._shape}")
        elapsed_s = self._hop_s if self._last_ns is None else max(frame.t_ns - self._last_ns, 0) * 1e-9
        self._last_ns = frame.t_ns
        heard = frame
        if self._denoise is not None:
            frame = self._denoise(frame)
        mask = self._mask(frame) if self._mask is not None else None
        correlation = self._correlate(frame)
        tdoa = self._pick(correlation)
        bearings = self._locate(frame, tdoa, elapsed_s, mask)
        detection = self._detect(correlation, bearings[0], elapsed_s)
        self._locate.settle(detection.call)
        if self._mask is not None:
            self._mask.settle(detection.call)
        attitude = pose.attitude if pose else None
        again = self._again(bearings[0], elapsed_s, attitude)
        # what is learnt as noise does not hang on it: a caller who is remembered wrongly stays noise
        if again is not None and not detection.call:
            bearings, detection = (again,), replace(detection, call=True, since_s=self._hop_s)
        tracks = self._track(bearings, detection, elapsed_s, attitude)
        sightings = tuple(self._looks(tracks, pose))
        positions = (self._positioner.position(t.id, frame.middle_ns) for t in tracks if t.confirmed)
        return Estimate(
            t_ns=frame.t_ns,
            start=frame.start,
            overruns=frame.overruns,
            tdoa=tdoa,
            bearing=bearings[0],
            detection=detection,
            track=tracks[0] if tracks else None,
            faults=self._find_faults(heard, correlation, tdoa, elapsed_s),
            truth=frame.truth,
            tracks=tracks,
            pose=pose,
            positions=tuple(position for position in positions if position is not None),
            sightings=sightings,
        )

    def _again(self, bearing: Bearing, elapsed_s: float, attitude: Quaternion | None) -> Bearing | None:
        """Of somebody who has called before, by what this frame alone scores."""
        scores = self._locate.frame_scores()
        return None if scores is None else self._repeats(scores, bearing.evidence, elapsed_s, attitude)

    def _looks(self, tracks: tuple[Track, ...], pose: Pose | None) -> Iterator[Sighting]:
        """This frame's own bearings of callers, those that went into their positions."""
        s = self._settings
        if s.bearing.estimator == "two-mic":
            return  # as likely the mirror image: nobody is sent to a place on the wrong side
        for track in tracks:
            if pose is None or track.look is None or not track.confirmed:
                continue
            look = sighting(pose, track.look, track.id, s.position, s.pose, self._tolerance_rad)
            if look is not None and self._positioner.see(look):
                yield look


def _made_for_array(settings: Settings) -> tuple[Correlator, PeakPicker, Locator]:
    """The stages with tables for array and speed of sound."""
    audio = settings.audio
    shape = (
        settings.mic_array,
        settings.speed_m_s,
        float(audio.rate_hz),
        audio.frame,
        settings.correlation,
    )
    return Correlator(*shape), PeakPicker(*shape), make_locator(settings)


def _made_denoiser(settings: Settings) -> tuple[WaveDenoiser | None, MaskDenoiser | None]:
    """What `denoise.kind` names: it cleans the sound, or it weighs the bearing's bins."""
    kind = settings.denoise.kind
    return (
        WaveDenoiser(settings) if kind == "wave" else None,
        MaskDenoiser(settings) if kind == "mask" else None,
    )


def _for_denoiser(settings: Settings) -> tuple[Any, ...]:
    """What it is made of."""
    return settings.denoise, settings.array, settings.correlation.band_hz, settings.models


def _for_array(settings: Settings) -> tuple[Any, ...]:
    """What those tables are made of: all that their stages read, less what `Locator.apply` takes."""
    s = settings
    steered = replace(s.steered, span_s=1.0, forget_s=1.0, weigh=True)
    return s.array, s.environment, s.correlation, s.bearing, s.models, steered
