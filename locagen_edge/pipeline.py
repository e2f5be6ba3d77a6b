"""Wires the way: Frame in, Estimate out. No clock, no I/O, no asyncio.

The same object flies in the daemon, replays recordings, is tested and is timed. Time is that of the frames.
"""

from __future__ import annotations

from collections.abc import Iterator

from locagen_edge.errors import SourceError
from locagen_edge.geometry import tolerance_rad
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing import make_locator
from locagen_edge.stages.correlation import Correlator
from locagen_edge.stages.denoise import MASKERS, WaveDenoiser
from locagen_edge.stages.detection import Detector
from locagen_edge.stages.faults import FaultFinder
from locagen_edge.stages.position import Positioner, sighting
from locagen_edge.stages.tdoa import PeakPicker
from locagen_edge.stages.track import Tracker
from locagen_edge.types import Estimate, Frame, Pose, Sighting, Track


class Pipeline:
    """From sound to bearings and places, for one stream of frames.

    Raises `ModelError` or `KernelError` where the settings ask for what cannot be made.
    """

    def __init__(self, settings: Settings):
        array, audio = settings.mic_array, settings.audio
        shape = (array, settings.speed_m_s, float(audio.rate_hz), audio.frame, settings.correlation)
        self._shape = (array.mics, audio.frame)
        self._hop_s = settings.hop_s
        kind = settings.denoise.kind
        self._denoise = WaveDenoiser(settings) if kind == "wave" else None
        self._mask = MASKERS[kind](settings) if kind in MASKERS else None
        self._correlate = Correlator(*shape)
        self._pick = PeakPicker(*shape)
        self._locate = make_locator(settings)
        self._detect = Detector(settings.detection)
        self._find_faults = FaultFinder(settings)
        self._settings = settings
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
        tracks = self._track(bearings, detection, elapsed_s, pose.attitude if pose else None)
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
            faults=self._find_faults(frame, correlation, tdoa, elapsed_s),
            truth=frame.truth,
            tracks=tracks,
            pose=pose,
            positions=tuple(position for position in positions if position is not None),
            sightings=sightings,
        )

    def _looks(self, tracks: tuple[Track, ...], pose: Pose | None) -> Iterator[Sighting]:
        """This frame's own bearings of callers, those that went into their positions."""
        s = self._settings
        for track in tracks:
            if pose is None or track.look is None or not track.confirmed:
                continue
            look = sighting(pose, track.look, track.id, s.position, s.pose, self._tolerance_rad)
            if look is not None and self._positioner.see(look):
                yield look
