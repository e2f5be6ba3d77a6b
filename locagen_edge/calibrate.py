"""What `locagen-edge calibrate` does: a recording through the flight's own chain to delays, on to settings.

The mathematics is in `calibration.py`. Here are the chain (with lags wide enough for wrong positions and late
channels), what is wrong with channels before anything can be fitted, the known angles, the table for a
person, and the new settings file.
"""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from locagen_edge.calibration import (
    LEAST_FRAMES,
    NEAREST_M,
    TEMPERATURE_C,
    Arrivals,
    Calibration,
    Walk,
    calibrate,
)
from locagen_edge.errors import CalibrationError
from locagen_edge.files import write
from locagen_edge.geometry import MicArray, wrap
from locagen_edge.settings import Settings, sample
from locagen_edge.stages.correlation import Correlator
from locagen_edge.stages.faults import alone
from locagen_edge.stages.mic import wav_frames
from locagen_edge.stages.tdoa import PeakPicker
from locagen_edge.types import F64, Correlation, Tdoa

MOST_FRAMES = 3000
"""Of a longer recording they are taken evenly: 3000 settle 0.02 mm, and bound memory on a small board."""

FAULTY = 0.5
"""Share of the frames in which a channel must be wrong to count as that."""

CLOSURE = 0.25
"""Samples by which the delays of three pairs may miss closing: beyond it, they are of different sounds."""

NEGATIVE = 0.8
"""Share of the frames in which an inverted channel's trough is deeper than its peak is high."""


@dataclass(frozen=True, eq=False)
class Heard:
    """What the chain made of a recording."""

    arrivals: Arrivals
    gains_db: F64
    """(mics,) against microphone 0"""
    gain_sigma_db: F64
    frames: int
    """of them all; those of `arrivals` are the usable ones"""
    notes: tuple[str, ...]
    """what was wrong in some frames"""


def hear(paths: Sequence[Path], settings: Settings, margin: float) -> Heard:
    """Delays and levels of a recording, or of several as if they were one. `margin`: how much longer than the
    settings' the lags may be.

    Raises `SourceError` for a file that cannot be used, `CalibrationError` for channels that cannot.
    """
    audio = settings.audio
    plain = replace(settings, array=replace(settings.array, delays_s=(), gains_db=()))
    wide = MicArray(settings.mic_array.positions_m * margin)
    longest = wide.longest_delay_s(settings.speed_m_s) * audio.rate_hz
    if longest + 2 >= audio.frame / 4:
        raise CalibrationError(
            f"--margin {margin:g}: lags of {longest:.0f} samples are too long for the frame"
        )
    shape = (wide, settings.speed_m_s, float(audio.rate_hz), audio.frame, settings.correlation)
    correlate, pick = Correlator(*shape), PeakPicker(*shape)
    stride = max(1, audio.frame // (2 * audio.hop))  # frames that share more than half say nothing new
    faults: Counter[str] = Counter()
    troughs = []
    kept: list[tuple[float, Tdoa, F64]] = []
    frames = 0
    for number, frame in enumerate(wav_frames(paths, plain)):
        if number % stride:
            continue
        frames += 1
        correlation = correlate(frame)
        tdoa = pick(correlation)
        wrong, _ = alone(frame, correlation, frame.clipped)  # where they stand is what is asked for
        faults.update(wrong)
        troughs.append(_trough(correlation))
        if not wrong and np.all(np.isfinite(tdoa.delay_s)):
            middle_s = (frame.start + audio.frame / 2) / audio.rate_hz
            kept.append((middle_s, tdoa, correlation.power.astype(np.float64)))
    what = str(paths[0]) if len(paths) == 1 else f"{len(paths)} files"
    _refuse_faulty(what, faults, frames)
    _refuse_inverted(what, np.array(troughs), wide)
    usable = [row for row in kept if _closes(row[1], wide, CLOSURE / audio.rate_hz)]
    if len(usable) < LEAST_FRAMES:
        raise CalibrationError(
            f"{what}: {len(usable)} of {frames} frames hold a sound that all microphones hear; at least "
            f"{LEAST_FRAMES} are needed: record a loud broad-band sound (noise, claps, speech) walked all "
            "the way round, for half a minute or more, motors off"
        )
    every = math.ceil(len(usable) / MOST_FRAMES)
    usable = usable[::every]
    reduced = [_reduced(tdoa, wide) for _, tdoa, _ in usable]
    arrivals = Arrivals(
        delay_s=np.array([delay for delay, _ in reduced]),
        covariance_s2=np.array([covariance for _, covariance in reduced]),
        time_s=np.array([time_s for time_s, _, _ in usable]),
    )
    level_db = 10.0 * np.log10(np.array([power for _, _, power in usable]))
    above = level_db - level_db[:, :1]
    gains = np.median(above, axis=0)
    # a median's sigma is 1.253 times a mean's; its scatter by the median too
    scatter = 1.4826 * np.median(np.abs(above - gains), axis=0)
    notes = tuple(
        f"{text} (in {100 * count / frames:.0f} % of the frames, left out)"
        for text, count in sorted(faults.items())
        if count > 0.02 * frames
    )
    return Heard(arrivals, gains, 1.253 * scatter / math.sqrt(len(usable)), frames, notes)


def _trough(correlation: Correlation) -> F64:
    """(pairs,) whether each pair's trough is deeper than its peak is high; NaN: neither stands out."""
    low, high = -correlation.values.min(axis=1), correlation.values.max(axis=1)
    return np.where(np.maximum(low, high) > 0.3, (low > high).astype(np.float64), np.nan)


def _refuse_faulty(what: str, faults: Counter[str], frames: int) -> None:
    lasting = sorted(text for text, count in faults.items() if count > FAULTY * frames)
    if lasting:
        raise CalibrationError("\n".join(f"{what}: {text}" for text in lasting))


def _refuse_inverted(what: str, troughs: F64, array: MicArray) -> None:
    clear = np.sum(np.isfinite(troughs), axis=0)
    share = np.nansum(troughs, axis=0) / np.maximum(clear, 1)
    against = {
        pair
        for pair, s, n in zip(array.pairs, share, clear, strict=True)
        if n >= LEAST_FRAMES and s > NEGATIVE
    }
    if not against:
        return
    other = {m for m in range(1, array.mics) if (0, m) in against}
    inverted = other if len(other) <= array.mics / 2 else set(range(array.mics)) - other
    if {(i, j) for i, j in array.pairs if (i in other) != (j in other)} != against:
        return  # no set of inverted channels explains it: a sound of few tones, whose troughs mean nothing
    names = ", ".join(str(m) for m in sorted(inverted))
    doubt = " (or the other one)" if array.mics == 2 else ""
    raise CalibrationError(
        f"{what}: microphone {names}{doubt}: inverted (its sound comes upside down): mend the wiring or the "
        "channel's polarity, and record again"
    )


def _incidence(array: MicArray) -> F64:
    """(pairs, mics - 1): a pair's delay from arrivals against microphone 0."""
    table = np.zeros((len(array.pairs), array.mics))
    for row, (i, j) in enumerate(array.pairs):
        table[row, i], table[row, j] = -1.0, 1.0
    return table[:, 1:]


def _closes(tdoa: Tdoa, array: MicArray, limit_s: float) -> bool:
    table = _incidence(array)
    fitted = table @ np.linalg.lstsq(table, tdoa.delay_s, rcond=None)[0]
    return bool(np.abs(tdoa.delay_s - fitted).max() <= limit_s)


def _reduced(tdoa: Tdoa, array: MicArray) -> tuple[F64, F64]:
    """Pairs to arrivals against microphone 0 (mics - 1,), and their covariance; pairs that share a microphone
    share half of their error."""
    table = _incidence(array)
    weighted = table / tdoa.sigma_s[:, None] ** 2
    gain = np.linalg.solve(table.T @ weighted, weighted.T)
    first = np.array([[-1.0 if 0 in pair else 0.0] for pair in array.pairs])
    whole = np.column_stack([first, table])
    related = whole @ whole.T / 2.0 * np.outer(tdoa.sigma_s, tdoa.sigma_s)
    return gain @ tdoa.delay_s, gain @ related @ gain.T


# --- known angles -------------------------------------------------------------------------------------

LIMITS = {"time_s": (0.0, 1e6), "azimuth_deg": (-3600.0, 3600.0), "elevation_deg": (-90.0, 90.0)}


def read_angles(path: Path) -> F64:
    """(rows, 3) seconds, azimuth and elevation in degrees (NaN: not told) from a CSV file with the columns
    time_s, azimuth_deg and maybe elevation_deg. Raises `CalibrationError` with one fault per line."""
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets begin a file with a mark
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{path}: is not UTF-8 text") from error
    reader = csv.reader(io.StringIO(text))
    names = [name.strip() for name in next(reader, [])]
    if names not in (list(LIMITS), list(LIMITS)[:2]):
        raise CalibrationError(
            f"{path}: line 1 has to be time_s,azimuth_deg or time_s,azimuth_deg,elevation_deg"
        )
    rows: list[list[float]] = []
    faults: list[str] = []
    for cells in reader:
        where = f"{path}: line {reader.line_num}"
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(names):
            faults.append(f"{where}: {len(cells)} values for {len(names)} columns")
            continue
        row = [_number(cell) for cell in cells]
        for name, value, cell in zip(names, row, cells, strict=True):
            least, most = LIMITS[name]
            if not least <= value <= most:
                faults.append(f"{where}: {name}: {cell.strip()!r} is no number from {least:g} to {most:g}")
        if rows and not row[0] > rows[-1][0]:
            faults.append(f"{where}: time_s: does not come after the line before")
        rows.append(row)
    if len(rows) < 2 and not faults:
        faults.append(f"{path}: holds {len(rows)} lines of angles; two are needed, from one to the next")
    if faults:
        raise CalibrationError(
            "\n".join([*faults[:10], *([f"{path}: and more"] if len(faults) > 10 else [])])
        )
    table = np.full((len(rows), 3), np.nan)
    table[:, : len(names)] = rows
    return table


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def at_angles(heard: Heard, table: F64, walk: Walk, path: Path) -> tuple[Heard, Walk]:
    """The frames within the time of the table, and the walk with the angle at each, the shorter way from line
    to line."""
    time_s = heard.arrivals.time_s
    within = (time_s >= table[0, 0]) & (time_s <= table[-1, 0])
    if np.sum(within) < LEAST_FRAMES:
        raise CalibrationError(
            f"{path}: {np.sum(within)} usable frames lie between {table[0, 0]:g} and {table[-1, 0]:g} s; at "
            f"least {LEAST_FRAMES} are needed: is time_s counted from the recording's beginning?"
        )
    time_s = time_s[within]
    azimuth = np.interp(time_s, table[:, 0], np.unwrap(np.radians(table[:, 1])))
    elevation = np.full(len(time_s), walk.elevation_rad)
    if np.all(np.isfinite(table[:, 2])):
        elevation = np.interp(time_s, table[:, 0], np.radians(table[:, 2]))
    old = heard.arrivals
    arrivals = Arrivals(old.delay_s[within], old.covariance_s2[within], time_s)
    first, last = np.searchsorted(table[:, 0], [time_s[0], time_s[-1]])
    known = int(last - first + 1 + (table[first, 0] > time_s[0]))  # the lines around the frames, at both ends
    angles = np.stack([azimuth, elevation], axis=1)
    return replace(heard, arrivals=arrivals), replace(walk, angles=angles, known=known)


# --- for people ---------------------------------------------------------------------------------------


def fitted(heard: Heard, settings: Settings, walk: Walk) -> Calibration:
    """The calibration of what was heard, from the settings' positions. Raises `CalibrationError`."""
    return calibrate(
        heard.arrivals,
        settings.mic_array.positions_m,
        settings.environment.temperature_c,
        settings.speed_m_s,
        walk,
        settings.array.delays_s,
        settings.array.tolerance_m,
    )


def report(heard: Heard, found: Calibration, settings: Settings, walk: Walk) -> Iterator[str]:
    """What was found, line by line; where it is in doubt, how the walk went and no more."""
    used = int(np.sum(found.weight > 0.2))
    yield f"frames      {heard.frames}, usable {len(heard.arrivals.time_s)}, in agreement {used}"
    covered = 360.0 - math.degrees(found.gap_rad)
    turns = abs(found.turned_rad) / (2.0 * math.pi)
    sense = "clockwise" if found.turned_rad > 0.0 else "anticlockwise"
    given = "known" if walk.angles is not None else "unknown"
    yield f"directions  {given}, over {covered:.0f} of 360 degrees, {turns:.1f} turns {sense}"
    if found.doubts:
        return
    yield f"scale       ±{100 * found.scale_sigma:.2f} %, {_scale(found, settings, walk)}"
    yaw = f"rotation    ±{math.degrees(found.yaw_sigma_rad):.1f}°"
    if walk.angles is not None:
        yield f"{yaw}, from {walk.known} known angles"
    else:
        yield f"{yaw}, that of array.positions_m and mount_deg in the settings; --angles would tell it"
        if abs(found.turned_rad) > math.pi and walk.clockwise is None:
            yield f"            if you did not go {sense}, two channels are swapped: see --sense"
    yield f"distance    {_distance(walk)}"
    yield ""
    yield _row(["microphone", "x mm", "y mm", "z mm", "moved mm", "late us", "gain dB"])
    moved = np.linalg.norm(found.positions_m - settings.mic_array.positions_m, axis=1)
    for m, (at, sigma) in enumerate(zip(found.positions_m, found.position_sigma_m, strict=True)):
        axes = [_with_sigma(1e3 * a, 1e3 * s) for a, s in zip(at, sigma, strict=True)]
        if not found.heights:
            axes[2] = f"{1e3 * at[2]:.2f} as set"
        late = _with_sigma(1e6 * found.delays_s[m], 1e6 * found.delay_sigma_s[m])
        gain = _with_sigma(heard.gains_db[m], heard.gain_sigma_db[m])
        yield _row([str(m), *axes, f"{1e3 * moved[m]:.2f}", *([late, gain] if m else ["0", "0"])])
    yield ""
    yield (
        f"residual    {1e6 * found.rms_before_s:.2f} us rms before, {1e6 * found.rms_after_s:.2f} us after "
        f"({found.misfit:.1f} sigma)"
    )
    rms, most = (math.degrees(error) for error in bearing_errors(settings, found))
    yield f"bearings    with the old settings off by {rms:.2f}° rms, {most:.2f}° at most"
    for note in (*heard.notes, *found.notes):
        yield f"note        {note}"
    if found.misfit > 5.0:
        yield (
            "note        the residual is far above the frames' own noise: echoes, or a near sound "
            "(--distance-m), or its elevation changed"
        )


def _row(cells: list[str]) -> str:
    widths = (10, 16, 16, 16, 9, 16, 15)
    return " ".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))


def _with_sigma(value: float, sigma: float) -> str:
    return f"{value + 0.0:.2f} ± {sigma:.2f}"


def _scale(found: Calibration, settings: Settings, walk: Walk) -> str:
    air = f"from air of {settings.environment.temperature_c:g} ± {TEMPERATURE_C:g} °C"
    level = f"{math.degrees(walk.elevation_rad):g} ± {math.degrees(walk.elevation_sigma_rad):g}°"
    return air if found.heights else f"{air} and a sound at an elevation of {level}"


def _distance(walk: Walk) -> str:
    if math.isfinite(walk.distance_m):
        return f"{walk.distance_m:g} m: the wave's curvature is taken out"
    return f"not given: {NEAREST_M:g} m or more is within the sigmas; --distance-m takes the curvature out"


def bearing_errors(settings: Settings, found: Calibration) -> tuple[float, float]:
    """Rms and greatest azimuth error, radians, of the settings' array where the one found is true: level
    plane waves from all around, least squares."""
    believed, late = settings.mic_array, np.array(settings.array.delays_s or [0.0] * settings.mic_array.mics)
    late = found.delays_s - (late - late[0])
    skew = np.array([late[j] - late[i] for i, j in believed.pairs])
    true = MicArray(found.positions_m)
    errors = []
    for azimuth in np.radians(np.arange(0.0, 360.0, 5.0)):
        u = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        heard = true.delays_s(u, settings.speed_m_s) + skew
        v = np.linalg.lstsq(believed.baselines_m[:, :2], heard * settings.speed_m_s, rcond=None)[0]
        errors.append(wrap(math.atan2(v[1], v[0]) - azimuth))
    return float(np.sqrt(np.mean(np.square(errors)))), float(np.abs(errors).max())


# --- the new settings ---------------------------------------------------------------------------------


def calibrated(settings: Settings, heard: Heard, found: Calibration) -> Settings:
    """The settings with what was found; digits below a tenth of any sigma left out."""

    def rounded(values: F64, digits: int) -> tuple[float, ...]:
        return tuple(round(float(v), digits) + 0.0 for v in values)  # no -0.0

    array = replace(
        settings.array,
        positions_m=tuple(rounded(row, 6) for row in found.positions_m),  # in the vehicle's axes already
        mount_deg=(0.0, 0.0, 0.0),
        tolerance_m=round(max(found.tolerance_m, 1e-5), 6),
        delays_s=rounded(found.delays_s, 9),
        gains_db=rounded(heard.gains_db, 3),
    )
    return replace(settings, array=array)


def write_settings(path: Path, settings: Settings, recordings: Sequence[Path]) -> None:
    """The whole settings file with its manual, or what was there before. Raises `CalibrationError`."""
    more = f" and {len(recordings) - 1} more" if len(recordings) > 1 else ""
    origin = (
        f"[array] was measured by `locagen-edge calibrate` from {recordings[0].name!r}{more}; the rest is as "
        "it was."
    )
    try:
        write(path, sample(settings, origin))
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written: {error.strerror}") from error
