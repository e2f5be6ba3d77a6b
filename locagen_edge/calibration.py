"""Delays of a sound walked around the array -> where the microphones are, and how late their channels.

Far away, microphone m hears a sound from direction u_k by

    r_mk = t_m - t_0 = (p_0 - p_m) . u_k / c + delay_m

later than microphone 0, so all frames together are affine in the directions: R = A U + d ("Affine structure
from sound", Thrun, NIPS 18, 2005). At one elevation the u_k lie on a circle, and the r_k on an ellipse: its
centre is the delays of the channels, its axes and their slant the array, and only rotation and reflection
remain free. The ellipse is found by linear least squares in the plane that holds the r_k (singular value
decomposition), then A, d and every frame's own azimuth together by Levenberg-Marquardt steps on the weighted
delays, under Student's t in place of Gauss (Lange, Little & Taylor, J. Am. Stat. Assoc. 84 (1989) 881-896).
Each azimuth concerns its own frame alone and is eliminated (Schur complement; Triggs et al., "Bundle
adjustment", 2000, section 6), so that the covariance of A and d counts that no azimuth was known.

What no sound from unknown directions tells, and where it is taken from:

- rotation: from the nominal positions (Procrustes), as well as those are known; from known angles, if given;
- reflection, which is two swapped channels: the nominal one, unless the walk's sense or angles are given;
- scale: from the speed of sound, and from the cosine of the elevation, which shrinks the ellipse;
- heights: nominal, unless known angles come from different elevations. At an elevation e an error of height h
  looks like a delay of h sin(e) / c, and is counted into the delays' sigma.

A source at a known distance D is no plane wave: what its curvature adds, up to r^2 / (2 D c) at a microphone
r from the middle, is computed from the positions of the step before. Without a distance it is left out: it
goes with twice the azimuth, so that over a full circle it hardly moves the ellipse (0.05 mm and 0.3 us at 1 m
for a triangle of 10 cm), and what a sound 2 m away would change is counted into the sigmas.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from locagen_edge.errors import CalibrationError
from locagen_edge.geometry import KELVIN, MicArray
from locagen_edge.types import F64

LEAST_FRAMES = 20
"""Five directions settle an ellipse without noise; from twenty frames its scatter can be judged."""

WIDEST_GAP_DEG = 120.0
"""An ellipse of which more is missing is guessed: its far side is seen to second order only."""

MOST_POSITION_M = 0.001
MOST_DELAY_S = 3e-6
"""Sigmas beyond these, half a degree of bearing each, count as "could not determine"."""

NEAREST_M = 2.0
"""A sound whose distance is not told may be as near as this."""

UNLIKE = 0.25
"""Share by which a distance between two microphones may differ from the settings' before they are taken for
another array, or the delays for another sound than the one walked around."""

SWAPPED = 3.0
"""Another order of the channels explains the shape by so much better, and the settings' own not at all."""
SWAPPED_M = 0.003

TEMPERATURE_C = 2.0
"""1-sigma of the air's temperature: a thermometer in the shade, on another day."""

FREEDOM = 4.0
"""Of Student's t: a few per cent of wild frames lose their weight."""

BESIDE = 3
BESIDE_S = 1.5
"""Frames to each side, no further away than this, that a frame has to be like."""
JUMP_S = 1e-5
"""Five degrees of a 10 cm array: a brisk walker does half of that within those frames."""
MOST_JUMP = 0.15
"""Of the array's longest delay: nine degrees."""

MOST_STEPS = 60
HEIGHTS_SPREAD = 0.08
"""Standard deviation of sin(elevation), 5 degrees, from which known angles tell the heights."""


@dataclass(frozen=True, eq=False)
class Arrivals:
    """What was measured: one row per frame, each microphone against microphone 0."""

    delay_s: F64
    """(frames, mics - 1) t_m - t_0"""
    covariance_s2: F64
    """(frames, mics - 1, mics - 1)"""
    time_s: F64
    """(frames,) of each frame's middle"""


@dataclass(frozen=True, eq=False)
class Walk:
    """What is known of the sound's way."""

    elevation_rad: float = 0.0
    """of the source seen from the array, positive up, where `angles` tell none"""
    elevation_sigma_rad: float = math.radians(2.0)
    distance_m: float = math.inf
    clockwise: bool | None = None
    """seen from above; None: not known"""
    angles: F64 | None = None
    """(frames, 2) azimuth and elevation at each frame, radians; None: unknown"""
    angle_sigma_rad: float = math.radians(3.0)
    """of one known angle"""
    known: int = 1
    """how many of the known angles are independent; the frames between are interpolated"""


@dataclass(frozen=True, eq=False)
class Calibration:
    """What was found."""

    positions_m: F64
    """(mics, 3) FRD, around the middle of the nominal ones"""
    position_sigma_m: F64
    """(mics, 3) from the delays' scatter and the scale; that of the rotation is apart, `yaw_sigma_rad`"""
    delays_s: F64
    """(mics,) by how much a channel is late; the first is 0"""
    delay_sigma_s: F64
    """(mics,)"""
    azimuth_rad: F64
    """(frames,) of the sound, as fitted; frames unlike their neighbours are left out"""
    weight: F64
    """(frames,) 0 to 1: what each counted"""
    rms_before_s: float
    """of the delays' residuals with the nominal positions, each frame at its best azimuth"""
    rms_after_s: float
    misfit: float
    """residuals over their sigma: about 1 where nothing but the frames' own noise is left"""
    gap_rad: float
    """widest arc without a direction"""
    turned_rad: float
    """how far the sound went round, clockwise positive"""
    yaw_sigma_rad: float
    scale_sigma: float
    """relative"""
    speed_m_s: float
    """of sound, with which it was found"""
    heights: bool
    """whether z was determined; else it is nominal"""
    doubts: tuple[str, ...]
    """what could not be determined, in words; empty: all was"""
    notes: tuple[str, ...]
    """what else a person should know"""

    @property
    def tolerance_m(self) -> float:
        """1-sigma per axis and microphone that stands for all of it, the delays as path lengths included."""
        axes = self.position_sigma_m if self.heights else self.position_sigma_m[:, :2]
        flat = self.positions_m[:, :2] - self.positions_m[:, :2].mean(axis=0)
        turned = self.yaw_sigma_rad**2 * float(np.mean(flat**2))
        late = float(np.mean((self.speed_m_s * self.delay_sigma_s) ** 2))
        return math.sqrt(float(np.mean(axes**2)) + turned + late)


def calibrate(
    arrivals: Arrivals,
    nominal_m: F64,
    temperature_c: float,
    speed_m_s: float,
    walk: Walk,
    before_s: Sequence[float] = (),
    tolerance_m: float = 0.0005,
) -> Calibration:
    """The calibration, with everything in `doubts` that it could not determine.

    Args:
        nominal_m: (mics, 3) positions as they are believed to be.
        before_s: the channels' delays as they are believed to be, for the residual before.
        tolerance_m: how well the nominal positions are known at best, 1-sigma per axis.

    Raises:
        CalibrationError: there are too few frames, or they fit no array at all.
    """
    frames, others = arrivals.delay_s.shape
    if frames < LEAST_FRAMES:
        raise CalibrationError(f"only {frames} usable frames; at least {LEAST_FRAMES} are needed")
    steady = _steady(arrivals, MOST_JUMP * MicArray(nominal_m).longest_delay_s(speed_m_s))
    if np.sum(steady) < LEAST_FRAMES:
        raise CalibrationError(
            f"the delays jump about: {np.sum(steady)} of {frames} frames are like those before and after "
            "them: see that one sound goes round, louder than all others and their echoes"
        )
    arrivals = Arrivals(*(a[steady] for a in (arrivals.delay_s, arrivals.covariance_s2, arrivals.time_s)))
    walk = walk if walk.angles is None else replace(walk, angles=walk.angles[steady])
    if others < 2 and walk.angles is None:
        raise CalibrationError("two microphones cannot be calibrated from unknown directions: give --angles")
    middle = nominal_m.mean(axis=0)
    nominal = nominal_m - middle
    problem = _Problem(arrivals, nominal, speed_m_s, walk)
    fit = problem.best([problem.solved(start) for start in problem.starts()])
    doubts: list[str] = []
    if walk.angles is None:
        fit, shape_doubts = _oriented(fit, nominal, speed_m_s, walk.clockwise)
        doubts += shape_doubts

    positions = _positions(fit.slope, speed_m_s, nominal)
    covariance, misfit, weight = problem.covariance(fit)
    scale = _scale_sigma(temperature_c, walk)
    position_sigma, delay_sigma, yaw = _sigmas(covariance, positions, speed_m_s, fit.slope.shape[1])
    if walk.angles is None:  # from the nominal positions
        yaw = _loose_m(positions, nominal, tolerance_m) / math.sqrt(float(np.sum(nominal[:, :2] ** 2)))
    sine = math.sin(walk.elevation_rad) if not problem.heights else 0.0
    delay_sigma[1:] = np.hypot(delay_sigma[1:], math.sqrt(2.0) * tolerance_m * abs(sine) / speed_m_s)
    if math.isinf(walk.distance_m):
        near = _Problem(arrivals, nominal, speed_m_s, replace(walk, distance_m=NEAREST_M)).solved(fit)
        moved, later = _apart(near, fit, nominal, speed_m_s)
        position_sigma, delay_sigma = np.hypot(position_sigma, moved), np.hypot(delay_sigma, later)
    gap = _widest_gap(fit.azimuth[weight > 0.2])
    doubts += _undetermined(position_sigma, delay_sigma, gap, walk, problem.heights)
    notes = _elsewhere(positions, nominal) if walk.angles is not None else ()
    if not notes:
        doubts += _unlike(positions, nominal)
    measured = 3 if problem.heights else 2
    position_sigma[:, :measured] = np.hypot(position_sigma[:, :measured], scale * positions[:, :measured])
    step = _wrapped(np.diff(fit.azimuth[weight > 0.2]))
    return Calibration(
        positions_m=positions + middle,
        position_sigma_m=position_sigma,
        delays_s=np.concatenate([[0.0], fit.offset]),
        delay_sigma_s=delay_sigma,
        azimuth_rad=fit.azimuth,
        weight=weight,
        rms_before_s=problem.rms_of(
            nominal, np.array(before_s) if len(before_s) else np.zeros(others + 1), weight
        ),
        rms_after_s=problem.rms(fit, weight),
        misfit=misfit,
        gap_rad=gap,
        turned_rad=float(step.sum()),
        yaw_sigma_rad=yaw,
        scale_sigma=scale,
        speed_m_s=speed_m_s,
        heights=problem.heights,
        doubts=tuple(doubts),
        notes=notes,
    )


def _steady(arrivals: Arrivals, most_s: float) -> np.ndarray:
    """(frames,) whether a frame's delays are like those of the frames around it: a walker does not jump. None
    is where half of them differ from their neighbours by more than `most_s`.

    Wild frames must go before the fit: where only an arc was walked, they would fill the rest of the circle.
    """
    frames = len(arrivals.time_s)
    near = np.arange(frames)[:, None] + np.arange(-BESIDE, BESIDE + 1)
    there = (near >= 0) & (near < frames)
    near = np.clip(near, 0, frames - 1)
    there &= np.abs(arrivals.time_s[near] - arrivals.time_s[:, None]) <= BESIDE_S
    around = np.where(there[:, :, None], arrivals.delay_s[near], np.nan)
    off = np.abs(arrivals.delay_s - np.nanmedian(around, axis=1)).max(axis=1)
    usual = float(np.median(off))
    return np.asarray((off <= max(JUMP_S, 4.0 * usual)) & (there.sum(axis=1) >= 3) & (usual <= most_s))


# --- the fit ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Fit:
    slope: F64
    """(mics - 1, 2 or 3) A, seconds: (p_0 - p_m) / c"""
    offset: F64
    """(mics - 1,) d, seconds"""
    azimuth: F64
    """(frames,)"""
    cost: float = math.inf


class _Problem:
    """Residuals, and the steps that lessen them."""

    def __init__(self, arrivals: Arrivals, nominal: F64, speed_m_s: float, walk: Walk) -> None:
        self._r = arrivals.delay_s
        # rows of delays times the whitener have unit variance
        self._whiten = np.linalg.cholesky(np.linalg.inv(arrivals.covariance_s2)).transpose(0, 2, 1)
        self._nominal, self._speed, self._walk = nominal, speed_m_s, walk
        frames = len(self._r)
        known = walk.angles
        self._elevation = np.full(frames, walk.elevation_rad) if known is None else known[:, 1]
        self.heights = known is not None and float(np.std(np.sin(known[:, 1]))) > HEIGHTS_SPREAD
        # as if each frame knew its azimuth, all of them together no better than the angles that were given
        sigma = walk.angle_sigma_rad * math.sqrt(max(frames / walk.known, 1.0))
        self._prior = np.full(frames, 0.0 if known is None else sigma**-2)
        self._told = np.zeros(frames) if known is None else known[:, 0]
        self._free = max(self._r.shape[1] - 1, 1)  # of a frame's delays its azimuth costs one
        self._dimensions = 3 if self.heights else 2
        lower = (nominal[0] - nominal[1:])[:, 2] / speed_m_s
        self._held = np.zeros_like(self._r) if self.heights else np.outer(-np.sin(self._elevation), lower)

    def _directions(self, azimuth: F64) -> F64:
        """(frames, 2 or 3) the part of u that A multiplies."""
        level = np.cos(self._elevation)
        u = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(self._elevation)], axis=1)
        return u[:, : self._dimensions]

    def _curved(self, slope: F64, azimuth: F64) -> F64:
        """(frames, mics - 1) what a source at a finite distance adds to the plane wave's delays."""
        if not math.isfinite(self._walk.distance_m):
            return np.zeros_like(self._r)
        far = self._walk.distance_m
        positions = _positions(slope, self._speed, self._nominal)
        level = np.cos(self._elevation)
        u = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(self._elevation)], axis=1)
        path = np.linalg.norm(far * u[:, None, :] - positions[None], axis=2)
        more = (path - far + u @ positions.T) / self._speed
        return np.asarray(more[:, 1:] - more[:, :1])

    def _residual(self, fit: _Fit) -> F64:
        """(frames, mics - 1) seconds."""
        model = self._directions(fit.azimuth) @ fit.slope.T + fit.offset + self._held
        return np.asarray(self._r - model - self._curved(fit.slope, fit.azimuth))

    def _whitened(self, fit: _Fit) -> F64:
        return np.asarray(np.einsum("kij,kj->ki", self._whiten, self._residual(fit)))

    def _squares(self, fit: _Fit, noise: float) -> F64:
        """(frames,) squared residuals in sigmas, that of the known angle included."""
        off = _wrapped(self._told - fit.azimuth)
        return np.asarray(np.sum(self._whitened(fit) ** 2, axis=1) / noise + self._prior * off**2)

    # --- where to begin

    def starts(self) -> list[_Fit]:
        if self._walk.angles is not None:
            return [self._linear()]
        slope = (self._nominal[0] - self._nominal[1:])[:, :2] / self._speed
        found = [self._at_best_azimuths(slope, np.zeros(len(slope)))]
        ellipse = self._ellipse()
        if ellipse is not None:
            found.append(self._at_best_azimuths(*ellipse))
        return found

    def _linear(self) -> _Fit:
        """Known angles: linear least squares for A and d; wild frames are left out in rounds."""
        design = np.column_stack([self._directions(self._told), np.ones(len(self._r))])
        target = self._r - self._held
        keep = np.ones(len(target), dtype=bool)
        for _ in range(4):
            solution = np.linalg.lstsq(design[keep], target[keep], rcond=None)[0]
            off = np.linalg.norm(target - design @ solution, axis=1)
            keep = off <= 3.0 * np.median(off[keep])
        return _Fit(np.asarray(solution[:-1].T, np.float64), solution[-1], self._told.copy())

    def _ellipse(self) -> tuple[F64, F64] | None:
        """A and d from the ellipse on which the delays lie; None where they lie on none."""
        target = self._r - self._held
        keep = np.linalg.norm(target - np.median(target, axis=0), axis=1)
        keep = keep <= 3.0 * np.median(keep)
        for _ in range(4):
            middle = target[keep].mean(axis=0)
            _, extent, axes = np.linalg.svd(target[keep] - middle, full_matrices=False)
            size = extent[0] / math.sqrt(keep.sum())
            x, y = ((target - middle) @ axes[:2].T / size).T
            design = np.column_stack([x * x, 2.0 * x * y, y * y, x, y])
            a, b, c, d, e = np.linalg.lstsq(design[keep], np.ones(keep.sum()), rcond=None)[0]
            off = np.abs(design @ np.array([a, b, c, d, e]) - 1.0)
            keep = off <= 4.0 * np.median(off[keep])
        form = np.array([[a, b], [b, c]])
        if np.linalg.eigvalsh(form)[0] <= 1e-6:
            return None
        centre = -np.linalg.solve(form, np.array([d, e])) / 2.0
        square = np.linalg.inv(form) * (1.0 + centre @ form @ centre)
        if np.linalg.eigvalsh(square)[0] <= 0.0:
            return None
        root = np.linalg.cholesky(square)
        level = float(np.cos(self._elevation).mean())
        return axes[:2].T @ root * size / level, middle + axes[:2].T @ centre * size

    def _at_best_azimuths(self, slope: F64, offset: F64) -> _Fit:
        """Each frame at the azimuth that fits best: of a grid, then by Gauss-Newton."""
        grid: F64 = np.radians(np.arange(0.0, 360.0, 5.0))
        off = [
            np.sum(self._whitened(_Fit(slope, offset, np.full(len(self._r), at))) ** 2, axis=1) for at in grid
        ]
        fit = _Fit(slope, offset, grid[np.argmin(off, axis=0)])
        for _ in range(5):
            _, by_azimuth = self._derivatives(fit)
            along = np.sum(by_azimuth * self._whitened(fit), axis=1)
            step = along / np.maximum(np.sum(by_azimuth**2, axis=1), 1e-300)
            fit = _Fit(slope, offset, fit.azimuth + np.clip(step, -0.1, 0.1))
        return fit

    # --- the steps

    def best(self, fits: list[_Fit]) -> _Fit:
        """The likeliest, all judged by the noise of the quietest."""
        noise = min(self._noise(fit) for fit in fits)
        return min(fits, key=lambda fit: self._priced(fit, noise).cost)

    def solved(self, fit: _Fit, steps: int = MOST_STEPS) -> _Fit:
        """Levenberg-Marquardt on all unknowns, the azimuths eliminated."""
        noise = 1.0
        fit = self._priced(fit, noise)
        damping = 1e-3
        for step in range(steps):
            if step % 5 == 0:
                noise = self._noise(fit)
                fit = self._priced(fit, noise)
            trial = self._priced(self._stepped(fit, damping, noise), noise)
            if trial.cost <= fit.cost:
                gained = fit.cost - trial.cost
                fit, damping = trial, max(damping / 10.0, 1e-12)
                if gained < 1e-9 * max(abs(fit.cost), 1.0) and step > 10:
                    break
            else:
                damping *= 10.0
                if damping > 1e8:
                    break
        return fit

    def _noise(self, fit: _Fit) -> float:
        """Variance of the whitened delays: by the median, which wild frames do not move. 1 for two
        microphones, whose residuals all go into the azimuths."""
        if self._r.shape[1] < 2:
            return 1.0
        squares = np.sum(self._whitened(fit) ** 2, axis=1)
        # the median of chi-square with n degrees of freedom is n (1 - 2 / (9 n))^3 (Wilson & Hilferty)
        middle = self._free * (1.0 - 2.0 / (9.0 * self._free)) ** 3
        return max(float(np.median(squares) / middle), 1e-4)

    def _weights(self, fit: _Fit, noise: float) -> F64:
        return np.asarray((FREEDOM + self._free) / (FREEDOM + self._squares(fit, noise)))

    def _priced(self, fit: _Fit, noise: float) -> _Fit:
        loss = (FREEDOM + self._free) / 2.0 * np.log1p(self._squares(fit, noise) / FREEDOM)
        return _Fit(fit.slope, fit.offset, fit.azimuth, float(loss.sum()))

    def _derivatives(self, fit: _Fit) -> tuple[F64, F64]:
        """Whitened model by A and d, (frames, mics - 1, parameters), and by azimuth, (frames, mics - 1).

        The curvature's own change with them is of second order, and left out.
        """
        frames, others = self._r.shape
        u = np.column_stack([self._directions(fit.azimuth), np.ones(frames)])
        by_array = np.einsum("kij,kl->kijl", self._whiten, u).reshape(frames, others, -1)
        level = np.cos(self._elevation)
        turn = np.stack([-level * np.sin(fit.azimuth), level * np.cos(fit.azimuth)], axis=1)
        by_azimuth = np.einsum("kij,kj->ki", self._whiten, turn @ fit.slope[:, :2].T)
        return by_array, by_azimuth

    def _normal(self, fit: _Fit, weight: F64, noise: float, damping: float = 0.0) -> tuple[F64, ...]:
        """The normal matrix of A and d with the azimuths eliminated, the right side, and what eliminates."""
        by_array, by_azimuth = self._derivatives(fit)
        residual = self._whitened(fit)
        own = np.sum(by_azimuth**2, axis=1) / noise + self._prior
        own = own * (1.0 + damping) + 1e-12 * own.max()
        along = np.sum(by_azimuth * residual, axis=1) / noise
        along += self._prior * _wrapped(self._told - fit.azimuth)
        cross = np.einsum("kip,ki->kp", by_array, by_azimuth) / noise
        full = np.einsum("kip,kiq,k->pq", by_array, by_array, weight / noise, optimize=True)
        normal = full - np.einsum("kp,kq,k->pq", cross, cross, weight / own, optimize=True)
        gradient = np.einsum("kip,ki,k->p", by_array, residual, weight / noise) - cross.T @ (
            weight * along / own
        )
        return normal, gradient, own, along, cross

    def _turn(self, slope: F64) -> F64:
        """(parameters,) how A and d change as the array turns: what unknown directions cannot see."""
        spin = np.zeros((len(slope), self._dimensions + 1))
        spin[:, 0], spin[:, 1] = -slope[:, 1], slope[:, 0]
        return np.asarray((spin / np.linalg.norm(spin)).ravel())

    def _stepped(self, fit: _Fit, damping: float, noise: float) -> _Fit:
        normal, gradient, own, along, cross = self._normal(fit, self._weights(fit, noise), noise, damping)
        if self._walk.angles is None:
            turn = self._turn(fit.slope)
            normal = normal + np.trace(normal) * np.outer(turn, turn)
        normal = normal + damping * np.diag(np.diag(normal))
        change = np.linalg.lstsq(normal, gradient, rcond=None)[0]
        azimuth = fit.azimuth + np.clip((along - cross @ change) / own, -0.5, 0.5)
        table = change.reshape(len(fit.slope), -1)
        return _Fit(fit.slope + table[:, :-1], fit.offset + table[:, -1], azimuth)

    # --- what it is worth

    def covariance(self, fit: _Fit) -> tuple[F64, float, F64]:
        """Of A and d (parameters, parameters) s^2, without the rotation; the misfit; each frame's weight."""
        noise, free = self._noise(fit), self._free
        squares = self._squares(fit, noise)
        weight = self._weights(fit, noise)
        # of an M-estimator: E[psi^2] / E[psi']^2 times the inverse of the plain normal matrix (Huber &
        # Ronchetti, *Robust Statistics*, 2nd ed., section 7.6)
        slack = np.mean(weight * (1.0 - 2.0 / free * squares / (FREEDOM + squares)))
        spare = max(len(squares) - (fit.slope.size + fit.offset.size) / free, 1.0)
        variance = float(np.sum(weight**2 * squares)) / (free * spare) / max(float(slack), 0.05) ** 2
        if self._r.shape[1] < 2:  # what disagrees went into the azimuths
            variance = max(variance, 1.0)
        normal, *_ = self._normal(fit, np.ones(len(squares)), noise)
        if self._walk.angles is None:
            turn = self._turn(fit.slope)
            normal = normal + 1e3 * np.trace(normal) * np.outer(turn, turn)
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-14, hermitian=True)
        return (
            inverse / np.outer(scale, scale) * variance,
            math.sqrt(noise),
            weight * FREEDOM / (FREEDOM + free),
        )

    def rms(self, fit: _Fit, weight: F64) -> float:
        """Weighted rms of the residuals, seconds."""
        squares = np.mean(self._residual(fit) ** 2, axis=1)
        return math.sqrt(float(np.sum(weight * squares) / np.sum(weight)))

    def rms_of(self, positions: F64, delays_s: F64, weight: F64) -> float:
        """The same for given positions and delays, each frame at its best azimuth."""
        slope = (positions[0] - positions[1:])[:, : self._dimensions] / self._speed
        return self.rms(self._at_best_azimuths(slope, delays_s[1:] - delays_s[0]), weight)


# --- gauge --------------------------------------------------------------------------------------------


def _positions(slope: F64, speed_m_s: float, nominal: F64) -> F64:
    """(mics, 3) around their middle; heights are nominal where A has none."""
    rows = np.zeros((len(slope) + 1, 3))
    rows[1:, : slope.shape[1]] = -slope * speed_m_s
    rows -= rows.mean(axis=0)
    if slope.shape[1] == 2:
        rows[:, 2] = nominal[:, 2]
    return rows


def aligning_angle(points: F64, wanted: F64) -> float:
    """The rotation, radians, that brings points (n, 2) closest to others: Procrustes without reflection."""
    cosine = float(np.sum(points * wanted))
    sine = float(np.sum(points[:, 0] * wanted[:, 1] - points[:, 1] * wanted[:, 0]))
    return math.atan2(sine, cosine)


def _rotation(angle: float) -> F64:
    return np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])


def off_m(points: F64, wanted: F64) -> float:
    """Rms distance (n, 2) from others after the best rotation."""
    turned = points @ _rotation(aligning_angle(points, wanted))
    return float(np.sqrt(np.mean(np.sum((turned - wanted) ** 2, axis=1))))


def _oriented(fit: _Fit, nominal: F64, speed_m_s: float, clockwise: bool | None) -> tuple[_Fit, list[str]]:
    """The fit turned, and mirrored if need be, towards the nominal positions; doubts about their order."""
    flat = nominal[:, :2]
    hands = [fit, _Fit(fit.slope * np.array([1.0, -1.0]), fit.offset, -fit.azimuth, fit.cost)]
    off = [off_m(_positions(hand.slope, speed_m_s, nominal)[:, :2], flat) for hand in hands]
    chosen = hands[int(np.argmin(off))]
    doubts = []
    if clockwise is not None:
        turned = float(_wrapped(np.diff(chosen.azimuth)).sum())
        if abs(turned) < math.pi:
            doubts.append("could not determine which way the sound went round: it did not go round")
        elif (turned > 0.0) != clockwise:
            chosen = hands[1 - int(np.argmin(off))]
    points = _positions(chosen.slope, speed_m_s, nominal)[:, :2]
    doubts += _swapped(points, flat, mirror=clockwise is None)
    turn = aligning_angle(points, flat)
    fit = _Fit(chosen.slope @ _rotation(turn), chosen.offset, _wrapped(chosen.azimuth + turn), fit.cost)
    return fit, doubts


def _swapped(points: F64, nominal: F64, *, mirror: bool) -> list[str]:
    """Whether another order of the channels explains the shape far better. `mirror`: either hand will do."""
    hands = (1.0, -1.0) if mirror else (1.0,)
    pairs = list(itertools.combinations(range(len(points)), 2))
    own = min(off_m(points * [1.0, hand], nominal) for hand in hands)
    order = np.arange(len(points))
    others = []
    for i, j in pairs:
        swapped = order.copy()
        swapped[[i, j]] = j, i
        others.append(min(off_m(points[swapped] * [1.0, hand], nominal) for hand in hands))
    if own < SWAPPED_M or own < SWAPPED * min(others):
        return []
    likely = [pair for pair, off in zip(pairs, others, strict=True) if off < 1.5 * min(others) + 1e-3]
    names = " or ".join(f"{i} and {j}" for i, j in likely)
    return [
        f"two channels are swapped: microphones {names} (the shape misses the settings by "
        f"{1e3 * own:.1f} mm, swapped by {1e3 * min(others):.1f} mm): mend audio.channel_map, and run this "
        "again"
    ]


def _apart(one: _Fit, other: _Fit, nominal: F64, speed_m_s: float) -> tuple[F64, F64]:
    """By how much two fits differ: positions (mics, 3) after the best rotation, metres; delays (mics,), s."""
    ours, theirs = (_positions(fit.slope, speed_m_s, nominal) for fit in (one, other))
    ours[:, :2] = ours[:, :2] @ _rotation(aligning_angle(ours[:, :2], theirs[:, :2]))
    return ours - theirs, np.concatenate([[0.0], one.offset - other.offset])


# --- judgement ----------------------------------------------------------------------------------------


def _wrapped(angle: F64) -> F64:
    return np.asarray((angle + math.pi) % (2.0 * math.pi) - math.pi)


def _scale_sigma(temperature_c: float, walk: Walk) -> float:
    """Relative: c goes with the square root of temperature; cos(e) to first and second order of its error."""
    air = 0.5 * TEMPERATURE_C / (KELVIN + temperature_c)
    e = walk.elevation_sigma_rad
    # mean square of (t x + x^2 / 2) for x ~ N(0, e^2)
    level = math.sqrt((math.tan(walk.elevation_rad) * e) ** 2 + 0.75 * e**4)
    return math.hypot(air, level)


def _loose_m(positions: F64, nominal: F64, tolerance_m: float) -> float:
    """1-sigma per axis of the nominal positions: as stated, or as the shape found shows if that is more."""
    flat = positions[:, :2] - nominal[:, :2]
    spare = max(2 * len(flat) - 3, 1)  # rotation and place are taken from them
    return max(tolerance_m, math.sqrt(float(np.sum(flat**2)) / spare))


def _sigmas(covariance: F64, positions: F64, speed_m_s: float, dimensions: int) -> tuple[F64, F64, float]:
    """1-sigma of the positions (mics, 3) around their middle and without their common rotation, metres; of
    the delays (mics,), seconds; and of the rotation, radians."""
    mics = len(positions)
    table = covariance.reshape(mics - 1, dimensions + 1, mics - 1, dimensions + 1)
    centred = (np.eye(mics) - 1.0 / mics)[:, 1:]  # positions around their middle, from p_m - p_0
    blocks = table[:, :dimensions, :, :dimensions]
    joint = speed_m_s**2 * np.einsum("mi,iajb,nj->manb", centred, blocks, centred)
    joint = joint.reshape(mics * dimensions, mics * dimensions)
    spin = np.zeros((mics, dimensions))
    spin[:, 0], spin[:, 1] = -positions[:, 1], positions[:, 0]
    arm = float(np.linalg.norm(spin))
    turn = spin.ravel() / arm
    apart = np.eye(len(turn)) - np.outer(turn, turn)
    shape = np.diag(apart @ joint @ apart).reshape(mics, dimensions)
    position = np.zeros((mics, 3))
    position[:, :dimensions] = np.sqrt(np.maximum(shape, 0.0))
    delay = np.sqrt(np.maximum(np.diag(table[:, dimensions, :, dimensions]), 0.0))
    yaw = math.sqrt(max(float(turn @ joint @ turn), 0.0)) / arm
    return position, np.concatenate([[0.0], delay]), yaw


def _widest_gap(azimuth: F64) -> float:
    """The widest arc without a direction, radians, in steps of 5 degrees. A step that has less than a fifth
    of its share counts as without: strays lie everywhere."""
    if len(azimuth) < LEAST_FRAMES:
        return 2.0 * math.pi
    steps = 72
    counts, _ = np.histogram(azimuth % (2.0 * math.pi), bins=steps, range=(0.0, 2.0 * math.pi))
    heard = np.flatnonzero(counts > 0.2 * len(azimuth) / steps)
    empty = np.diff(np.append(heard, heard[0] + steps)) - 1
    return float(empty.max()) * 2.0 * math.pi / steps


def _undetermined(position_m: F64, delay_s: F64, gap: float, walk: Walk, heights: bool) -> list[str]:
    found = []
    if walk.angles is None and math.degrees(gap) > WIDEST_GAP_DEG:
        found.append(
            f"could not determine positions and delays: the sound covers {360 - math.degrees(gap):.0f} "
            f"degrees of the horizon, and from unknown directions {360 - WIDEST_GAP_DEG:.0f} are needed: "
            "walk all the way round, or give --angles"
        )
    worst = float(position_m[:, : 3 if heights else 2].max())
    if not worst <= MOST_POSITION_M:
        found.append(f"could not determine the positions: 1-sigma {1e3 * worst:.1f} mm, at most 1 is useful")
    late = float(delay_s.max())
    if not late <= MOST_DELAY_S:
        found.append(
            f"could not determine the channels' delays: 1-sigma {1e6 * late:.1f} us, at most 3 is useful"
        )
    return found


def _elsewhere(positions: F64, nominal: F64) -> tuple[str, ...]:
    """Microphones where the settings have another one: with known angles no doubt, but a surprise."""
    distance = np.linalg.norm(positions[:, None, :2] - nominal[None, :, :2], axis=2)
    nearest = distance.argmin(axis=1)
    strange = np.flatnonzero(nearest != np.arange(len(positions)))
    if len(strange) == 0 or len(set(nearest)) < len(nearest):
        return ()
    moves = ", ".join(f"{m} where the settings have {nearest[m]}" for m in strange)
    return (f"channels are swapped: microphone {moves}; the positions are those of the channels as they are",)


def _unlike(positions: F64, nominal: F64) -> list[str]:
    found, wanted = MicArray(positions), MicArray(nominal)
    share = found.spacing_m / wanted.spacing_m - 1.0
    worst = int(np.argmax(np.abs(share)))
    if abs(share[worst]) <= UNLIKE:
        return []
    i, j = wanted.pairs[worst]
    return [
        f"could not determine the array: microphones {i} and {j} come out "
        f"{1e3 * found.spacing_m[worst]:.0f} mm apart, the settings say "
        f"{1e3 * wanted.spacing_m[worst]:.0f} mm: "
        "measure array.positions_m with a ruler first, and see that one sound alone goes round the array"
    ]
