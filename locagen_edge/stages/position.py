"""Sighting -> Position: callers on the map, from bearings along the flight and depression over height.

A single bearing is a ray without an end, and no Gaussian in metres is like one. So a bank of extended Kalman
filters stands along the first ray, each with its own range, every one narrow enough for its linearisation to
hold; the looks that follow decide between them by likelihood (Peach, "Bearings-only tracking using a set of
range-parameterised extended Kalman filters", IEE Proc. Control Theory Appl. 142, 1995). Place and covariance
are the mean and the moments of the whole bank. A vehicle that hovers and knows no height leaves the bank as
broad as it began: the range is not observable, and no place is told. Against the paper: each update also
carries the second-order term of the angle (Bar-Shalom, Li & Kirubarajan, *Estimation with Applications to
Tracking and Navigation*, section 10.3.2). Without it bearings from a vehicle that passes 2 m beside a caller
give a normalised error squared of 3.5 instead of 2.

What is the same in all looks of a vehicle is part of the state, with its covariance: compass, attitude about
the body's two level axes, place and height of the vehicle, and the height of the ground at the caller. These
decay slowly to zero and are renewed as fast (first-order Gauss-Markov). As states, and not as wider sigmas of
the looks, they do not average out over a hundred looks; and where a second vehicle or a curved path tells a
compass error, it is learnt. (A Schmidt filter, which only considers them, gives that away and saves no work
here.)

A steep look is a residual on the plane that touches the sphere of directions at the measured one, so nothing
is singular straight below, where azimuth means nothing; a flat one that of azimuth and elevation's cosine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from locagen_edge import geodesy
from locagen_edge.geometry import heading
from locagen_edge.settings import PoseSettings, PositionSettings
from locagen_edge.types import F64, Pose, Position, Sighting, TrueBearing

SPACING = 0.3
"""Of the bank's ranges, in logarithm; each filter's 1-sigma is half of it, so that their sum is smooth."""
STEEP_RAD = 1.0
"""Depression (2 sigma down) from which one look over a height gives a place that is as good as Gaussian."""
HORIZON_RAD = 1e-3
"""Depression of a level array's answer to delays that no direction explains."""
BLUNT_RAD = 0.5
"""Azimuths less certain than this say nothing that a filter could use."""
EDGE = 0.05
"""Share of the bank's last filter from which the caller may as well be beyond it."""
TOLD_M = 10.0
"""Longer semi-axis that is good enough at any distance."""
CREDIBLE = 7.0
"""Filters further than this below the best in log-likelihood have no say in what is an outlier."""
DEAD = 25.0
"""Filters further than that below the best are dropped: one in a hundred thousand million."""
ANYWHERE = -math.log(2.0 * math.pi)
"""Log-likelihood of a direction that nothing foretells; that of its elevation is near 0."""
LOST_AFTER = 5
"""Looks in a row outside the gate after which the filter begins again with them."""
OBSERVERS = 8
"""Vehicles in one filter; it costs with the square of them."""

SHARED = 3
"""States of the caller: north, east, height of the ground there over that below the vehicle."""
COMPASS, ROLL, PITCH, NORTH, EAST, HEIGHT = range(6)
"""Errors of one vehicle: its attitude, its place, its height."""
OWN = 6


@dataclass
class _Observer:
    row: int
    """where its errors begin in the state"""
    sigma: F64
    """(OWN,) stationary 1-sigma of its errors"""
    last: Sighting
    here: F64
    """(2,) north, east of its last look"""


@dataclass
class _Bank:
    """All filters of one caller, at one time."""

    origin: tuple[float, float]
    t_ns: int
    x: F64
    """(filters, states)"""
    p: F64
    """(filters, states, states)"""
    weight: F64
    """(filters,) logarithms"""
    observers: dict[str, _Observer]
    last: _Observer
    looked_ns: int
    looks: int = 1
    outside: int = 0


@dataclass(frozen=True)
class _Look:
    """A sighting in the bank's axes."""

    here: F64
    azimuth: float
    depression: float | None
    """None: no elevation, or no height that it could be measured against"""
    steep: bool
    heading: float
    """in the bank's axes"""


@dataclass
class Counters:
    """What became of the sightings."""

    used: int = 0
    thinned: int = 0
    """sooner after the last than position.look_s"""
    unusable: int = 0
    """not finite, off the map, too vague to begin with, or too many vehicles"""
    outside: int = 0
    """beyond the gate"""
    restarts: int = 0
    """times that looks beyond the gate took over"""


@dataclass
class Positioner:
    """Follows callers on the map: `see` takes what comes, `position` tells a place at any time after."""

    settings: PositionSettings
    counters: Counters = field(default_factory=Counters)
    evidence: float = 0.0
    """log-likelihood of all that was seen, given what was seen before: what two readings of it compare by"""
    _banks: dict[int, _Bank] = field(default_factory=dict)

    def see(self, sighting: Sighting) -> bool:
        """Takes in a sighting, False where it was not used (`counters` tell why).

        Sightings come roughly in order of time; one that is late counts as if it came now.
        """
        if not _usable(sighting):
            self.counters.unusable += 1
            return False
        bank = self._banks.get(sighting.caller)
        if bank is not None and self._stale(bank, sighting.t_ns):
            bank = None
        if bank is None:
            return self._begin(sighting)
        observer = bank.observers.get(sighting.observer)
        if observer is not None:
            since_s = abs(sighting.t_ns - observer.last.t_ns) * 1e-9
            if since_s < 0.999 * self.settings.look_s:  # a clock of whole frames is a little early at times
                self.counters.thinned += 1
                return False
        elif len(bank.observers) == OBSERVERS:
            self.counters.unusable += 1
            return False
        gain = _update(bank, sighting, self.settings)
        if gain is not None:
            self.counters.used += 1
            self.evidence += gain
            return True
        self.counters.outside += 1
        self.evidence += ANYWHERE
        if bank.outside >= LOST_AFTER:
            self.counters.restarts += 1
            return self._begin(sighting)
        return False

    def position(self, caller: int, t_ns: int) -> Position | None:
        """Where this caller is at a time, None where nothing is known, or nothing any more."""
        bank = self._banks.get(caller)
        if bank is None or self._stale(bank, t_ns):
            return None
        return _told(bank, caller, t_ns, self.settings)

    def positions(self, t_ns: int) -> tuple[Position, ...]:
        """All callers of whom anything is known at a time, the longest unheard first."""
        told = (self.position(caller, t_ns) for caller in self._banks)
        return tuple(position for position in told if position is not None)

    def _stale(self, bank: _Bank, t_ns: int) -> bool:
        return (t_ns - bank.looked_ns) * 1e-9 > self.settings.forget_s

    def _begin(self, sighting: Sighting) -> bool:
        self._banks.pop(sighting.caller, None)
        bank = _born(sighting, self.settings)
        if bank is None:
            self.counters.unusable += 1
            return False
        while len(self._banks) >= self.settings.callers:
            del self._banks[min(self._banks, key=lambda caller: self._banks[caller].looked_ns)]
        self._banks[sighting.caller] = bank
        self.counters.used += 1
        self.evidence += ANYWHERE
        return True


def sighting(
    pose: Pose,
    look: TrueBearing,
    caller: int,
    settings: PositionSettings,
    attitude: PoseSettings,
    tolerance_rad: float = 0.0,
) -> Sighting | None:
    """A look, with the sigmas of its noise alone, from a vehicle's pose, with what lasts.

    That is: the errors of compass, attitude and place by the settings, and of the bearing by the places of
    the microphones (`tolerance_rad`, 1-sigma). None where the pose knows no place.
    """
    if pose.latitude_deg is None or pose.longitude_deg is None:
        return None
    return Sighting(
        t_ns=pose.t_ns,
        observer=settings.vehicle,
        caller=caller,
        latitude_deg=pose.latitude_deg,
        longitude_deg=pose.longitude_deg,
        altitude_m=pose.altitude_m,
        height_m=pose.height_m,
        height_sigma_m=pose.height_sigma_m,
        azimuth_rad=look.azimuth_rad,
        azimuth_sigma_rad=look.azimuth_sigma_rad,
        elevation_rad=look.elevation_rad,
        elevation_sigma_rad=look.elevation_sigma_rad,
        heading_rad=0.0 if pose.attitude is None else heading(pose.attitude),
        azimuth_bias_sigma_rad=math.hypot(math.radians(attitude.compass_deg), tolerance_rad),
        elevation_bias_sigma_rad=math.hypot(math.radians(attitude.tilt_deg), tolerance_rad),
        position_sigma_m=settings.gps_m,
    )


# --- what comes in ------------------------------------------------------------------------------------


def _usable(s: Sighting) -> bool:
    numbers = [
        getattr(s, name)
        for name in Sighting.__slots__
        if name not in ("observer", "caller") and getattr(s, name) is not None
    ]
    sigmas = (s.height_sigma_m, s.position_sigma_m, s.azimuth_bias_sigma_rad, s.elevation_bias_sigma_rad)
    return (
        all(math.isfinite(number) for number in numbers)
        and abs(s.latitude_deg) <= 90.0
        and abs(s.longitude_deg) <= 360.0
        and abs(s.elevation_rad or 0.0) <= math.pi / 2.0 + 1e-9
        and s.azimuth_sigma_rad > 0.0
        and (s.elevation_rad is None or s.elevation_sigma_rad > 0.0)
        and min(sigmas) >= 0.0
    )


def _look(s: Sighting, origin: tuple[float, float]) -> _Look:
    """Place and direction in the axes of the bank's origin: near a pole, north there is not north here."""
    turn = geodesy.axes(*origin) @ geodesy.axes(s.latitude_deg, s.longitude_deg).T
    level = turn @ np.array([math.cos(s.azimuth_rad), math.sin(s.azimuth_rad), 0.0])
    here = geodesy.north_east_down_m(s.latitude_deg, s.longitude_deg, 0.0, *origin, 0.0)[:2]
    depression = None
    if s.elevation_rad is not None and s.height_m is not None and s.height_m > 0.5:
        depression = -s.elevation_rad
        if depression < -3.0 * math.hypot(s.elevation_sigma_rad, s.elevation_bias_sigma_rad):
            depression = None  # nobody calls from above: the mirror image of a flat array, or an echo
    return _Look(
        here=here,
        azimuth=math.atan2(level[1], level[0]),
        depression=depression,
        steep=depression is not None and depression - 2.0 * s.elevation_sigma_rad > STEEP_RAD,
        heading=math.atan2(level[1], level[0]) - s.azimuth_rad + s.heading_rad,
    )


def _errors(s: Sighting) -> F64:
    """(OWN,) 1-sigma of a vehicle's lasting errors."""
    tilt = s.elevation_bias_sigma_rad
    return np.array(
        [s.azimuth_bias_sigma_rad, tilt, tilt, s.position_sigma_m, s.position_sigma_m, s.height_sigma_m]
    )


# --- the first look -----------------------------------------------------------------------------------


def _born(s: Sighting, settings: PositionSettings) -> _Bank | None:
    """The bank along the first ray, one filter where the first look is steep, None where it is too vague."""
    origin = (s.latitude_deg, s.longitude_deg)
    look = _look(s, origin)
    if not look.steep and math.hypot(s.azimuth_sigma_rad, s.azimuth_bias_sigma_rad) > BLUNT_RAD:
        return None
    ahead = np.array([math.cos(look.azimuth), math.sin(look.azimuth)])
    right = np.array([-ahead[1], ahead[0]])
    if look.steep:
        assert look.depression is not None
        assert s.height_m is not None
        sine, cotangent = math.sin(look.depression), 1.0 / math.tan(look.depression)
        ranges = np.array([s.height_m * cotangent])
        noise = np.array([s.height_m * s.elevation_sigma_rad / sine**2])
        per_elevation, per_height = -s.height_m / sine**2, cotangent
        slant = np.array([s.height_m / sine])
        across = slant * _cross_sigma(s, look)
    else:
        least, most = settings.range_m
        ranges = np.exp(np.arange(math.log(least) + SPACING / 2.0, math.log(most), SPACING))
        noise = ranges * SPACING / 2.0
        per_elevation = per_height = 0.0
        across = ranges * s.azimuth_sigma_rad
    filters = len(ranges)
    terrain = np.hypot(settings.terrain_m, settings.terrain_share * ranges)
    # the place as a linear function of the errors: measured azimuth = true + error, vehicle = told + error
    slope = np.zeros((filters, 2, 1 + OWN))
    slope[:, :, 0] = -per_height * ahead
    own = slope[:, :, 1:]
    bow = look.azimuth - look.heading
    down = np.full(filters, s.height_m or 0.0)
    if not look.steep:
        down = np.minimum(down, 1.5 * ranges)
    own[:, :, COMPASS] = -ranges[:, None] * right
    own[:, :, ROLL] = (down * math.cos(bow))[:, None] * right + per_elevation * math.sin(bow) * ahead
    own[:, :, PITCH] = (down * math.sin(bow))[:, None] * right - per_elevation * math.cos(bow) * ahead
    own[:, 0, NORTH] = own[:, 1, EAST] = 1.0
    own[:, :, HEIGHT] = per_height * ahead
    variance = np.concatenate([terrain[:, None] ** 2, np.tile(_errors(s) ** 2, (filters, 1))], axis=1)
    p = np.zeros((filters, SHARED + OWN, SHARED + OWN))
    p[:, np.arange(2, SHARED + OWN), np.arange(2, SHARED + OWN)] = variance
    mixed = slope * variance[:, None, :]
    p[:, :2, 2:] = mixed
    p[:, 2:, :2] = np.swapaxes(mixed, 1, 2)
    p[:, :2, :2] = (
        mixed @ np.swapaxes(slope, 1, 2)
        + noise[:, None, None] ** 2 * np.outer(ahead, ahead)
        + across[:, None, None] ** 2 * np.outer(right, right)
    )
    x = np.zeros((filters, SHARED + OWN))
    x[:, :2] = ranges[:, None] * ahead
    observer = _Observer(SHARED, _errors(s), s, look.here)
    bank = _Bank(origin, s.t_ns, x, p, np.zeros(filters), {s.observer: observer}, observer, s.t_ns)
    if look.depression is not None and not look.steep:
        fitted = _corrected(bank.x, bank.p, observer, s, _rows(s, look, bank.x)[-1])
        bank.x, bank.p, bank.weight = fitted.x, fitted.p, bank.weight + fitted.log_likelihood
    return bank


# --- the looks that follow ----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Row:
    """One scalar residual: the angle of the line of sight from `ahead` towards `aside`."""

    ahead: F64
    aside: F64
    """both (filters or 1, 3) unit vectors, north, east, down"""
    tilt: F64
    """(filters or 1, 3): shares of the errors COMPASS, ROLL, PITCH"""
    measured: float
    """the angle, or its cosine"""
    sigma: float
    cosine: bool = False


@dataclass(frozen=True)
class _Corrected:
    x: F64
    p: F64
    log_likelihood: F64
    distance2: F64
    """(filters,) innovation squared over its variance"""


def _cross_sigma(s: Sighting, look: _Look) -> float:
    """1-sigma of the direction across a steep look, radians.

    A level array's azimuth is worth sigma / cos and its elevation sigma / sin of the depression: each gives
    that sigma, and straight below only the second does.
    """
    assert look.depression is not None
    return max(
        s.azimuth_sigma_rad * math.cos(look.depression), s.elevation_sigma_rad * math.sin(look.depression)
    )


def _rows(s: Sighting, look: _Look, x: F64) -> list[_Row]:
    """What a sighting measures, as each filter sees it."""
    if look.steep:
        return _steep_rows(s, look)
    away = x[:, :2] - look.here
    distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-3)
    # from where the filter has the caller, not from where the noisy look has: errors that are the same in all
    # looks must come out the same in all, or the filter believes that it can tell them from the place
    bow = np.arctan2(away[:, 1], away[:, 0]) - look.heading
    slope = np.minimum((s.height_m or 0.0) / distance, 1.5)
    none, one = np.zeros(len(x)), np.ones(len(x))
    rows = []
    if s.azimuth_sigma_rad <= BLUNT_RAD:
        cosine, sine = math.cos(look.azimuth), math.sin(look.azimuth)
        rows.append(
            _Row(
                ahead=np.array([[cosine, sine, 0.0]]),
                aside=np.array([[-sine, cosine, 0.0]]),
                tilt=np.stack([one, -slope * np.cos(bow), -slope * np.sin(bow)], axis=1),
                measured=0.0,
                sigma=s.azimuth_sigma_rad,
            )
        )
    if look.depression is not None:
        cosine, sigma = _level_cosine(s, look.depression)
        level = not math.isnan(cosine)
        rows.append(
            _Row(
                ahead=np.stack([away[:, 0] / distance, away[:, 1] / distance, none], axis=1),
                aside=np.array([[0.0, 0.0, -1.0]]),
                tilt=np.stack([none, -np.sin(bow), np.cos(bow)], axis=1),
                measured=cosine if level else -look.depression,
                sigma=sigma if level else s.elevation_sigma_rad,
                cosine=level,
            )
        )
    return rows


def _level_cosine(s: Sighting, depression: float) -> tuple[float, float]:
    """The cosine of the depression with its 1-sigma where a level array measured it, else NaN.

    Such an array measures just that. Near the horizon the cosine's even noise is anything but even in
    elevation, and the elevation's sigma depends on the noise itself: taken in angle, looks that err towards
    the vehicle would count for more than those that err away. Noise beyond a cosine of 1 is told as the
    horizon.
    """
    sigma = s.elevation_sigma_rad * max(math.sin(depression), s.azimuth_sigma_rad)
    if sigma < 0.5 * s.azimuth_sigma_rad * math.cos(depression):
        return math.nan, sigma  # better than a level array could
    return 1.0 if depression < HORIZON_RAD else math.cos(depression), sigma


def _steep_rows(s: Sighting, look: _Look) -> list[_Row]:
    """Both residuals on the plane that touches the sphere at the measured direction."""
    assert look.depression is not None
    cosine, sine = math.cos(look.azimuth), math.sin(look.azimuth)
    level, down = math.cos(look.depression), math.sin(look.depression)
    bow = look.azimuth - look.heading
    ahead = np.array([[level * cosine, level * sine, down]])
    return [
        _Row(
            ahead=ahead,
            aside=np.array([[-sine, cosine, 0.0]]),
            tilt=np.array([[level, -down * math.cos(bow), -down * math.sin(bow)]]),
            measured=0.0,
            sigma=_cross_sigma(s, look),
        ),
        _Row(
            ahead=ahead,
            aside=np.array([[down * cosine, down * sine, -level]]),
            tilt=np.array([[0.0, -math.sin(bow), math.cos(bow)]]),
            measured=0.0,
            sigma=s.elevation_sigma_rad,
        ),
    ]


def _corrected(x: F64, p: F64, observer: _Observer, s: Sighting, row: _Row) -> _Corrected:
    """Every filter of the bank after one residual: an extended Kalman update with the second-order term."""
    states, k = x.shape[1], observer.row
    pick = np.zeros((3, states))  # from the state to the vector from vehicle to caller
    pick[0, 0] = pick[1, 1] = pick[2, k + HEIGHT] = 1.0
    pick[0, k + NORTH] = pick[1, k + EAST] = pick[2, 2] = -1.0
    ahead, aside = row.ahead @ pick, row.aside @ pick
    offset = np.array([-observer.here[0], -observer.here[1], s.height_m or 0.0])
    b = (x * ahead).sum(axis=1) + row.ahead @ offset
    a = (x * aside).sum(axis=1) + row.aside @ offset
    square = np.maximum(a * a + b * b, 1e-6)
    h = (b[:, None] * aside - a[:, None] * ahead) / square[:, None]
    radial = (b[:, None] * ahead + a[:, None] * aside) / square[:, None]
    angle, slope, bend = np.arctan2(a, b), np.ones(len(a)), -radial
    value = angle - row.measured
    if row.cosine:
        value, slope = np.cos(angle) - row.measured, -np.sin(angle)
        bend = -0.5 * np.cos(angle)[:, None] * h - slope[:, None] * radial
    # the second derivative is h k' + k h' for h the angle's first derivative and this bend k
    ph, pk = (p @ h[:, :, None])[:, :, 0], (p @ bend[:, :, None])[:, :, 0]
    hh, hk, kk = (h * ph).sum(axis=1), (h * pk).sum(axis=1), (bend * pk).sum(axis=1)
    own = slice(k, k + 3)
    gain = h.copy()
    gain[:, own] += row.tilt
    gain *= slope[:, None]
    value = value + hk + slope * (row.tilt * x[:, own]).sum(axis=1)
    ph = slope[:, None] * (ph + (p[:, :, own] * row.tilt[:, None, :]).sum(axis=2))
    s2 = (gain * ph).sum(axis=1) + hh * kk + hk * hk + row.sigma**2
    if row.cosine and row.measured == 1.0:
        beyond = [max(0.5 * math.erfc(-z), 1e-300) for z in value / np.sqrt(2.0 * s2)]
        return _Corrected(x, p, np.log(beyond), np.zeros(len(x)))
    distance2 = value**2 / s2
    return _Corrected(
        x=x - ph * (value / s2)[:, None],
        p=p - ph[:, :, None] * (ph / s2[:, None])[:, None, :],
        log_likelihood=-0.5 * (distance2 + np.log(2.0 * math.pi * s2)),
        distance2=distance2,
    )


def _update(bank: _Bank, s: Sighting, settings: PositionSettings) -> float | None:
    """Takes a sighting into the bank and gives its log-likelihood.

    None: it is outside the gate, and the bank is as it was.
    """
    look = _look(s, bank.origin)
    x, p = _predicted(bank, s.t_ns, settings)
    observer = bank.observers.get(s.observer)
    if observer is None:
        observer = _Observer(x.shape[1], _errors(s), s, look.here)
        x, p = _widened(x, p, observer.sigma)
    observer = _Observer(observer.row, _errors(s), s, look.here)
    weight, taken = bank.weight, 0
    for row in _rows(s, look, x):
        fitted = _corrected(x, p, observer, s, row)
        credible = weight > weight.max() - CREDIBLE
        if fitted.distance2[credible].min() > settings.gate_sigma**2:
            bank.outside += 1
            return None
        x, p, weight = fitted.x, fitted.p, weight + fitted.log_likelihood
        taken += 1
    if not taken:
        return None
    gain = _log_sum(weight) - _log_sum(bank.weight)
    live = weight > weight.max() - DEAD
    live[-1] = True  # the furthest stays: it tells whether the caller may be beyond the bank
    bank.x, bank.p, bank.weight = x[live], p[live], weight[live] - weight.max()
    bank.t_ns = max(bank.t_ns, s.t_ns)
    bank.looked_ns = bank.t_ns
    bank.observers[s.observer] = bank.last = observer
    bank.looks += 1
    bank.outside = 0
    return gain


def _log_sum(weight: F64) -> float:
    most = float(weight.max())
    return most + math.log(float(np.exp(weight - most).sum()))


def _predicted(bank: _Bank, t_ns: int, settings: PositionSettings) -> tuple[F64, F64]:
    """State and covariance at a time not before the bank's own."""
    dt = max(t_ns - bank.t_ns, 0) * 1e-9
    keep = math.exp(-dt / settings.bias_s)
    stays, renewed = np.ones(bank.x.shape[1]), np.zeros(bank.x.shape[1])
    renewed[:2] = settings.walk_m**2 * dt
    for observer in bank.observers.values():
        own = slice(observer.row, observer.row + OWN)
        stays[own] = keep
        renewed[own] = observer.sigma**2 * (1.0 - keep**2)
    p = bank.p * np.outer(stays, stays)
    diagonal = np.arange(len(stays))
    p[:, diagonal, diagonal] += renewed
    return bank.x * stays, p


def _widened(x: F64, p: F64, sigma: F64) -> tuple[F64, F64]:
    """Room for the errors of one more vehicle."""
    filters, states = x.shape
    wide = np.zeros((filters, states + OWN, states + OWN))
    wide[:, :states, :states] = p
    new = np.arange(states, states + OWN)
    wide[:, new, new] = sigma**2
    return np.concatenate([x, np.zeros((filters, OWN))], axis=1), wide


# --- what is told -------------------------------------------------------------------------------------


def _told(bank: _Bank, caller: int, t_ns: int, settings: PositionSettings) -> Position:
    x, p = _predicted(bank, t_ns, settings)
    share = np.exp(bank.weight - bank.weight.max())
    share /= share.sum()
    mean = share @ x[:, :2]
    off = x[:, :2] - mean
    covariance = np.einsum("m,mij->ij", share, p[:, :2, :2]) + (share * off.T) @ off
    here, last = bank.last.here, bank.last.last
    away = mean - here
    height = last.height_m or 0.0
    at_vehicle = geodesy.axes(last.latitude_deg, last.longitude_deg) @ geodesy.axes(*bank.origin).T
    # every filter's azimuth, not that of the mean: along a ray without an end they agree
    lines = (x[:, :2] - here) / np.maximum(np.linalg.norm(x[:, :2] - here, axis=1), 1e-3)[:, None]
    line = at_vehicle[:2, :2] @ (share @ lines)
    lat, lon, _ = geodesy.moved(*bank.origin, 0.0, np.array([mean[0], mean[1], 0.0]))
    to_place = geodesy.axes(lat, lon) @ geodesy.axes(*bank.origin).T
    covariance = to_place[:2, :2] @ covariance @ to_place[:2, :2].T
    covariance = 0.5 * (covariance + covariance.T)
    values, vectors = np.linalg.eigh(covariance)
    minor, major = np.sqrt(np.maximum(values, 0.0))
    distance = math.hypot(away[0], away[1], height)
    edge = len(share) > 1 and share[-1] > EDGE
    observable = bool(major <= max(TOLD_M, settings.told_share * distance) and not edge)
    ground = None
    if observable and last.altitude_m is not None and last.height_m is not None:
        rise = x[:, 2] - x[:, bank.last.row + HEIGHT]
        ground = last.altitude_m - last.height_m + float(share @ rise)
    return Position(
        t_ns=t_ns,
        caller=caller,
        range_observable=observable,
        latitude_deg=lat if observable else None,
        longitude_deg=lon if observable else None,
        altitude_m=ground,
        covariance_m2=covariance,
        semi_major_m=float(major),
        semi_minor_m=float(minor),
        orientation_rad=math.atan2(vectors[1, 1], vectors[0, 1]) % math.pi,
        azimuth_rad=math.atan2(line[1], line[0]),
        azimuth_sigma_rad=_azimuth_sigma(x, p, share, here),
        age_s=max(t_ns - bank.looked_ns, 0) * 1e-9,
        looks=bank.looks,
    )


def _azimuth_sigma(x: F64, p: F64, share: F64, here: F64) -> float:
    """1-sigma of the azimuth from a place, at most that of an azimuth of which nothing is known."""
    away = x[:, :2] - here
    square = np.maximum((away**2).sum(axis=1), 1e-6)
    slope = np.stack([-away[:, 1], away[:, 0]], axis=1) / square[:, None]
    within = np.einsum("mi,mij,mj->m", slope, p[:, :2, :2], slope)
    angle = np.arctan2(away[:, 1], away[:, 0])
    turned = share @ np.exp(1j * angle)
    between = (np.angle(np.exp(1j * angle) * np.conj(turned))) ** 2
    return min(math.sqrt(float(share @ (within + between))), math.pi / math.sqrt(3.0))
