"""Wires the way: Frame in, Estimate out. No clock, no I/O, no asyncio.

The same object flies in the daemon, replays recordings, is tested and is timed. Time is that of the frames.
"""

from __future__ import annotations

from locagen_edge.errors import SourceError
from locagen_edge.geometry import tolerance_rad
from locagen_edge.settings import Settings
from locagen_edge.stages.bearing import make_locator
from locagen_edge.stages.correlation import Correlator
from locagen_edge.stages.denoise import WaveDenoiser
from locagen_edge.stages.detection import Detector
from locagen_edge.stages.faults import FaultFinder
from locagen_edge.stages.tdoa import PeakPicker
from locagen_edge.stages.track import Tracker
from locagen_edge.types import Estimate, Frame, Pose


class Pipeline:
    """From sound to bearing, for one stream of frames.

    Raises `ModelError` or `KernelError` where the settings ask for what cannot be made.
    """

    def __init__(self, settings: Settings):
        array, audio = settings.mic_array, settings.audio
        shape = (array, settings.speed_m_s, float(audio.rate_hz), audio.frame, settings.correlation)
        self._shape = (array.mics, audio.frame)
        self._hop_s = settings.hop_s
        self._denoise = WaveDenoiser(settings) if settings.denoise.kind == "wave" else None
        self._correlate = Correlator(*shape)
        self._pick = PeakPicker(*shape)
        self._locate = make_locator(settings)
        self._detect = Detector(settings.detection)
        self._find_faults = FaultFinder()
        self._track = Tracker(
            settings.track,
            settings.pose,
            tolerance_rad(array, settings.array.tolerance_m),
            audio.frame / audio.hop,
            array.normal,
        )
        self._last_ns: int | None = None

    def process(self, frame: Frame, pose: Pose | None = None) -> Estimate:
        """The estimate for one frame. Frames have to come in the order of time; gaps are allowed.

        `pose`: the vehicle's at the frame's middle; without one, callers are followed as the body sees them.
        """
        if frame.samples.shape != self._shape:
            raise SourceError(f"a frame of shape {frame.samples.shape} came, settings say {self._shape}")
        elapsed_s = self._hop_s if self._last_ns is None else max(frame.t_ns - self._last_ns, 0) * 1e-9
        self._last_ns = frame.t_ns
        if self._denoise is not None:
            frame = self._denoise(frame)
        correlation = self._correlate(frame)
        tdoa = self._pick(correlation)
        bearing = self._locate(frame, tdoa)
        detection = self._detect(correlation, bearing, elapsed_s)
        self._locate.settle(detection.call)
        tracks = self._track((bearing,), detection, elapsed_s, pose.attitude if pose else None)
        return Estimate(
            t_ns=frame.t_ns,
            start=frame.start,
            overruns=frame.overruns,
            tdoa=tdoa,
            bearing=bearing,
            detection=detection,
            track=tracks[0] if tracks else None,
            faults=self._find_faults(frame, correlation, tdoa, bearing, elapsed_s),
            truth=frame.truth,
            tracks=tracks,
            pose=pose,
        )
