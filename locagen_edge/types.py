"""What travels along the way, in the order of travel.

    Frame -> Correlation -> Tdoa -> Bearing -> Track -> Position  (Detection, Pose and faults beside them)

Each type carries its own time and rate, so that no stage has to ask another for them. All are frozen;
arrays inside are not to be written to. Conventions of axes, signs and units: CONTRIBUTING.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Quaternion = tuple[float, float, float, float]
"""w, x, y, z, of length 1"""


@dataclass(frozen=True, slots=True)
class Truth:
    """Where the source really was at a frame's middle: known only to a simulation."""

    azimuth_rad: float
    elevation_rad: float
    range_m: float
    calling: bool
    """whether the source sounds in this frame"""


@dataclass(frozen=True, slots=True)
class Drift:
    """How a sound card's clock runs against the computer's monotonic one."""

    ppm: float
    """positive: the card is fast"""
    sigma_ppm: float

    def __str__(self) -> str:
        return f"{self.ppm:+.0f} ±{max(self.sigma_ppm, 1.0):.0f} ppm"


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A piece of sound from all microphones."""

    samples: F32
    """(mics, samples), full scale 1.0"""
    rate_hz: float
    t_ns: int
    """monotonic time of the first sample, ns"""
    start: int
    """number of the first sample since the source was opened; frames overlap by the frame less the hop"""
    overruns: int = 0
    """times that sound was lost between the previous frame and this one's end"""
    clipped: int = 0
    """bit m set: microphone m stood at the device's full scale since the previous frame's end"""
    drift: Drift | None = None
    """of the device's clock, where it has one and it is known"""
    truth: Truth | None = None
    pose: Pose | None = None
    """of the vehicle at the middle, where a recording tells"""
    utc_ns: int | None = None
    """of the first sample, since 1970, where a recording tells"""

    @property
    def middle_ns(self) -> int:
        """monotonic time of the middle"""
        return self.t_ns + round(len(self.samples[0]) * 0.5e9 / self.rate_hz)

    @property
    def end_ns(self) -> int:
        """monotonic time of the end of the last sample"""
        return self.t_ns + round(len(self.samples[0]) * 1e9 / self.rate_hz)


@dataclass(frozen=True, slots=True, eq=False)
class Correlation:
    """GCC-PHAT of every pair, on a sub-sample grid of the lags that the geometry allows."""

    values: F32
    """(pairs, lags); 1.0 is full coherence over the whole band"""
    lag_s: F64
    """(lags,) seconds; positive: the pair's second microphone hears later"""
    power: F32
    """(mics,) mean square in the band, full scale 1.0"""
    fill: F32
    """(mics,) share of the band that the sound fills above the floor: what a coherent peak can reach"""
    bad_mics: int
    """bit m set: microphone m held a sample that is not finite, and counts as silent"""


@dataclass(frozen=True, slots=True, eq=False)
class Tdoa:
    """Time differences of arrival of all pairs."""

    delay_s: F64
    """(pairs,) t_j - t_i, seconds; NaN where a pair has no peak"""
    sigma_s: F64
    """(pairs,) 1-sigma of the delay, seconds; infinite where there is no peak"""
    peak: F64
    """(pairs,) height of the peak, 0 to 1"""


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """A position in body axes from hyperbolic TDOA, with what it is worth."""

    position_m: F64
    """(3,) x forward, y right, z down; z is 0 by assumption where the array is flat"""
    covariance_m2: F64
    """(3, 3)"""
    range_m: float
    range_sigma_m: float
    range_observable: bool
    """False: the delays do not bound the range, and only the direction means anything"""


@dataclass(frozen=True, slots=True)
class Evidence:
    """That something calls at all."""

    ratio: float
    """of the best direction's score to that of noise alone"""
    since_s: float
    """for how long it has called, at the frame's end"""


@dataclass(frozen=True, slots=True, eq=False)
class Bearing:
    """Where the sound of one frame comes from. None instead of an angle: nothing can be said."""

    azimuth_rad: float | None
    """body axes: 0 ahead, positive clockwise seen from above, -pi to pi"""
    azimuth_sigma_rad: float
    elevation_rad: float | None
    """positive up; None where the array cannot tell"""
    elevation_sigma_rad: float
    misfit: float
    """rms of (measured - fitted) delay over its sigma; about 1 when one far source explains all pairs; 0
    where an estimator judges that otherwise"""
    estimator: str
    fix: Fix | None = None
    evidence: Evidence | None = None
    """None where an estimator does not know whether it is a call"""
    span_s: float = 0.0
    """time constant of the average over sound before the frame that it was taken from"""


@dataclass(frozen=True, slots=True)
class Detection:
    """Whether something calls."""

    call: bool
    snr_db: float
    """in-band, mean of the live microphones, over the tracked background"""
    level_dbfs: float
    """in-band level, mean of the live microphones"""
    since_s: float = 0.0
    """for how long it has called, at the frame's end; 0 where nothing calls"""


@dataclass(frozen=True, slots=True, eq=False)
class Mask:
    """What share of a frame's sound is the caller's, by frequency: the same for all microphones."""

    t_ns: int
    """that of the frame"""
    weight: F32
    """(frame / 2 + 1,) 0 to 1, of each bin of the frame's spectrum: the mean of `masks` over time"""
    masks: F32
    """(spectra, bins) 0 to 1, of the short spectra within the frame that the network has judged"""
    snr_db: float
    """in-band power kept over power taken away; -inf while the noise is not known"""


@dataclass(frozen=True, slots=True)
class TrueBearing:
    """A direction in earth axes. The sigmas hold the error of the vehicle's attitude, unless it is said
    otherwise."""

    azimuth_rad: float
    """clockwise from true north, -pi to pi"""
    azimuth_sigma_rad: float
    elevation_rad: float | None
    """over the horizon, positive up"""
    elevation_sigma_rad: float


@dataclass(frozen=True, slots=True)
class Track:
    """The bearing of one caller over time: as the body sees it now, and in the earth's axes."""

    azimuth_rad: float
    """body axes"""
    azimuth_sigma_rad: float
    elevation_rad: float | None
    elevation_sigma_rad: float
    age_s: float
    """since the call was first heard"""
    silent_s: float
    """since the call was last heard"""
    confidence: float
    """0 to 1: share of the recent frames that held a call and agreed with the track"""
    id: int = 0
    """the same as long as the track lives; no two tracks of a stream have the same"""
    confirmed: bool = False
    """heard often enough to be no chance"""
    earth: TrueBearing | None = None
    """None: the attitude is not known now, and the track is followed in body axes"""
    look: TrueBearing | None = None
    """this frame's own bearing of the caller, not smoothed, with the sigmas of its noise alone: what
    positions are made of. None: not heard in this frame, or the attitude is not known"""


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the vehicle was at one moment, and how it was turned. None: not known, or too old."""

    t_ns: int
    """monotonic time, as of `Frame.t_ns`"""
    attitude: Quaternion | None
    """unit quaternion w, x, y, z that turns vectors of the body (FRD) into those of the earth (NED): that
    of MAVLink's ATTITUDE_QUATERNION"""
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    """above mean sea level"""
    height_m: float | None = None
    """above the ground below"""
    height_sigma_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Sighting:
    """One look of one vehicle at one caller, in earth axes: what a position is made of.

    What differs from look to look (`..._sigma_rad`) averages out; what is the same in all looks of a vehicle
    for minutes (`..._bias_sigma...`, the place, the height) does not, and is told apart for that.
    """

    t_ns: int
    """when the sound was heard, on a clock that all observers of one filter share"""
    observer: str
    """which vehicle"""
    caller: int
    """which caller: the number of the vehicle's track"""
    latitude_deg: float
    """of the vehicle, as are longitude, altitude and height"""
    longitude_deg: float
    azimuth_rad: float
    """direction to the caller, clockwise from true north"""
    azimuth_sigma_rad: float
    altitude_m: float | None = None
    """above mean sea level"""
    height_m: float | None = None
    """above the ground below; None: not known, and the elevation tells no range"""
    height_sigma_m: float = 1.0
    elevation_rad: float | None = None
    """negative below the horizon; None where the array cannot tell"""
    elevation_sigma_rad: float = 0.0
    heading_rad: float = 0.0
    """of the vehicle's nose, clockwise from true north: errors of the attitude turn with it"""
    azimuth_bias_sigma_rad: float = 0.0
    """of the compass"""
    elevation_bias_sigma_rad: float = 0.0
    """of roll and pitch, each"""
    position_sigma_m: float = 0.0
    """of the vehicle's place, per axis"""


@dataclass(frozen=True, slots=True, eq=False)
class Position:
    """Where a caller is on the map, with what that is worth."""

    t_ns: int
    caller: int
    range_observable: bool
    """False: the looks do not bound the range. There is a bearing, and no place."""
    latitude_deg: float | None
    longitude_deg: float | None
    altitude_m: float | None
    """of the ground there, above mean sea level; None where no vehicle told altitude and height"""
    covariance_m2: F64
    """(2, 2) of north and east, caller's walk, compass, GPS and terrain included; where the range is not
    observable, of a place that is not told"""
    semi_major_m: float
    """1-sigma: the ellipse of both semi-axes holds the caller with 39 %, 2.45 times as large with 95 %"""
    semi_minor_m: float
    orientation_rad: float
    """of the major axis, clockwise from true north, 0 to pi"""
    azimuth_rad: float
    """from the vehicle that looked last, clockwise from true north"""
    azimuth_sigma_rad: float
    age_s: float
    """since the last look that agreed"""
    looks: int
    """how many did"""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """All that the pipeline says of one frame."""

    t_ns: int
    start: int
    overruns: int
    tdoa: Tdoa
    bearing: Bearing
    detection: Detection
    track: Track | None
    """the best of `tracks`"""
    faults: tuple[str, ...]
    """what is wrong with the microphones now, in words for the operator"""
    truth: Truth | None = None
    tracks: tuple[Track, ...] = ()
    """all callers, the best first"""
    pose: Pose | None = None
    """of the vehicle at the frame's middle"""
    positions: tuple[Position, ...] = ()
    """of those confirmed tracks whose looks told anything of a place; `caller` is the track's id"""
    sightings: tuple[Sighting, ...] = ()
    """the looks of this frame that went into positions"""

    def position(self, track: Track | None) -> Position | None:
        """Where the caller of this track is."""
        return next((p for p in self.positions if track is not None and p.caller == track.id), None)


Array = npt.NDArray[Any]
