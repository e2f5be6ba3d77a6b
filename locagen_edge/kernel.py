"""The C kernel, seen from Python: the one file that touches cffi.

cffi hands a pointer to C without asking what lies behind it (a float64 array passes for `float *` in
silence), so everything is checked here, before the pointer. The C side is described in `csrc/locagen.h`.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from locagen_edge._kernel import ffi, lib
from locagen_edge.errors import KernelError

_FLOAT32 = np.dtype(np.float32)
_FLOATS = ffi.typeof("float[]")
_MOST_MICS = 8


class GccPhat:
    """GCC-PHAT of all microphone pairs of one frame, at the lags that the geometry allows.

    Hann window, real FFT, each bin scaled by `1 / sqrt(p + f)` where `p` is its power and `f` the larger of
    `floor` and `relative_floor` times the microphone's mean bin power in the band; then, for a pair
    `(i, j)`, the mean over the band's bins of `Re(U_j conj(U_i) exp(2 pi i f tau))`. A pair that is coherent
    over the band peaks at 1.0 (less what the floor takes), at a positive lag where `j` hears later.
    Silence gives zeros. Source: Knapp & Carter 1976, "The generalized correlation method for estimation
    of time delay".

    Args:
        mics: microphones, 2 to 8.
        frame: samples per microphone and frame, a power of two from 256 to 4096.
        lags: grid points each side of zero.
        oversample: grid points per sample, 1 to 64; the longest lag, `lags / oversample` samples, stays
            below a quarter of the frame.
        rate_hz: sample rate.
        band_hz: lowest and highest frequency that count, both included.
        floor: power of one bin, mean square of full scale, around which a bin fades to zero;
            the default, 1e-12, is -120 dB, under the converter's noise.
        relative_floor: the same as a share of the microphone's mean bin power in the band; the default,
            1e-3, keeps bins that are empty of the source (-30 dB) from being blown up to its size.

    Raises:
        KernelError: the configuration is none that the kernel can do; the text names the fault.

    Attributes:
        pairs: `(i, j)` with `i < j`, in the order of the correlation's rows.
        lag_s: delay of each column in seconds, float64, shape `(2 * lags + 1,)`.

    One object serves one thread. Frames stand alone: there is nothing to reset.
    """

    def __init__(
        self,
        *,
        mics: int,
        frame: int,
        lags: int,
        oversample: int,
        rate_hz: float,
        band_hz: tuple[float, float] = (300.0, 4700.0),
        floor: float = 1e-12,
        relative_floor: float = 1e-3,
    ) -> None:
        try:
            config = ffi.new(
                "locagen_gcc_config *",
                {
                    "mics": mics,
                    "frame": frame,
                    "lags": lags,
                    "oversample": oversample,
                    "rate_hz": rate_hz,
                    "band_low_hz": band_hz[0],
                    "band_high_hz": band_hz[1],
                    "floor": floor,
                    "relative_floor": relative_floor,
                },
            )
        except (OverflowError, TypeError) as fault:
            raise KernelError(f"kernel configuration: {fault}") from fault
        # With a size of 0, init refuses the configuration before it touches the one byte.
        self._memory = ffi.new("char[]", max(1, lib.locagen_gcc_sizeof(config)))
        self._state = ffi.cast("locagen_gcc *", self._memory)
        _check(lib.locagen_gcc_init(self._state, config))
        self.pairs = tuple((i, j) for i in range(mics) for j in range(i + 1, mics))
        self.lag_s: npt.NDArray[np.float64] = np.arange(-lags, lags + 1) / (oversample * float(rate_hz))
        self._shape = (mics, frame)
        # C writes here, the caller gets copies: that is faster than a new pointer for every new array.
        self._correlation = np.empty((len(self.pairs), 2 * lags + 1), _FLOAT32)
        self._levels = np.zeros((2, mics), _FLOAT32)
        self._power = self._levels[0]
        self._correlation_pointer = ffi.from_buffer(_FLOATS, self._correlation)
        self._power_pointer = ffi.from_buffer(_FLOATS, self._levels)
        self._process = lib.locagen_gcc_process

    def process(
        self, samples: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], int]:
        """Correlates one frame.

        Args:
            samples: float32, C-contiguous, shape `(mics, frame)`, full scale 1.0; left as it is.

        Returns:
            The correlation, float32, shape `(pairs, 2 * lags + 1)`; the mean square of each microphone in
            the band, corrected for the window, float32, shape `(mics,)`; and a mask with bit `m` set where
            microphone `m` held a sample that is not finite, or so large that its power overflowed: it
            counts as silent and its power is 0. The arrays are new with every call.

        Raises:
            KernelError: `samples` has another type, shape or memory layout.
        """
        source = _pointer(samples, self._shape)
        bad: int = self._process(self._state, source, self._correlation_pointer, self._power_pointer)
        return self._correlation.copy(), self._power.copy(), bad

    @property
    def fill(self) -> npt.NDArray[np.float32]:
        """Share of the band that each microphone filled in the last frame, float32, shape `(mics,)`.

        Mean over the band's bins of `p / (p + f)`: what a pair of coherent microphones can reach at its peak.
        """
        fill: npt.NDArray[np.float32] = self._levels[1].copy()
        return fill


@dataclass(frozen=True, slots=True)
class Source:
    """A direction that sound comes from, with what it is worth."""

    azimuth_rad: float
    """0 ahead, positive clockwise seen from above, -pi to pi"""
    elevation_rad: float
    """positive up; where the array is flat and level never above 0"""
    score: float
    """log of the likelihood ratio against "noise only"; noise alone gives some tens at 451 bins"""
    contrast: float
    """the same against "all of the noise is louder now", of the strongest source"""
    rival: float
    """of the strongest source: score of the best direction elsewhere over its own; near 1: several answers"""
    snr: float
    """power ratio per microphone, over the band's bins, as if the noise were white"""
    information: tuple[float, float, float]
    """xx, xy, yy in 1 / rad^2 along two arcs: x towards greater azimuth, y towards greater elevation"""

    def sigma_rad(self) -> tuple[float, float]:
        """1-sigma of azimuth and elevation, radians: pi where nothing is known.

        The inverse of the information; azimuth is the arc over cos(elevation). Near the plane of a flat array
        the elevation's is large: there delays do not change with it.
        """
        xx, xy, yy = self.information
        half, apart = (xx + yy) / 2.0, math.hypot((xx - yy) / 2.0, xy)
        # Each of the two principal directions is known to pi at worst.
        values = [max(value, math.pi**-2) for value in (half + apart, half - apart)]
        turn = 0.5 * math.atan2(2.0 * xy, xx - yy)
        c, s = math.cos(turn) ** 2, math.sin(turn) ** 2
        arc = math.sqrt(c / values[0] + s / values[1])
        level = max(math.cos(self.elevation_rad), 1e-6)
        return min(math.pi, arc / level), min(math.pi, math.sqrt(s / values[0] + c / values[1]))


class Steered:
    """Maximum likelihood over directions, with the noise's own cross-spectra.

    For each frame: `listen`, then `hear` and `search`, for each span; then, while nothing calls, `learn`,
    `watch` and now and then `settle`. Score and sources: `csrc/locagen.h`.

    Args:
        positions_m: microphones, shape `(mics, 3)`, FRD, metres; 2 to 8 of them.
        frame: samples per microphone and frame, a power of two from 256 to 4096.
        hop: samples from frame to frame, at least `frame / 8`; 0: frames do not overlap.
        rate_hz: sample rate.
        speed_m_s: of sound.
        band_hz: lowest and highest frequency that count, both included.
        taper: share of the window that is tapered, 0 rectangle, 1 Hann. The default, 0.1, loses 3 % of
            accuracy to tapering, Hann 39 %; Hann keeps strong tones of the noise out of other bins.
        smooth_bins: bins each side over which the source's spectrum is taken for smooth.
        spans: averages of the signal side by side, each with a memory of its own.
        lag: `learn` can take a frame of so many hops ago: what calls is known only after a while.
        loading: added to the noise's diagonal, as a share of its mean: the deepest null is this deep.
        smear: share of the noise's matrix, averaged over 100 Hz to each side, that is added to it.
        floor: the same as power of one bin, mean square of full scale.
        azimuths, elevations: the coarse grid; None: fine enough for the array.

    Raises:
        KernelError: the configuration is none that the kernel can do; the text names the fault.

    Attributes:
        first_bin: number of the band's first bin.
        frequency_hz: of each bin in the band, float64, shape `(bins,)`.
        elevation_rad, azimuth_rad: axes of the map, float32.

    One object serves one thread.
    """

    def __init__(
        self,
        positions_m: npt.ArrayLike,
        *,
        frame: int,
        hop: int = 0,
        rate_hz: float,
        speed_m_s: float,
        band_hz: tuple[float, float] = (300.0, 4700.0),
        taper: float = 0.1,
        smooth_bins: int = 6,
        spans: int = 1,
        lag: int = 0,
        loading: float = 1e-3,
        smear: float = 0.0,
        floor: float = 1e-12,
        azimuths: int | None = None,
        elevations: int | None = None,
    ) -> None:
        positions = np.array(positions_m, np.float64)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise KernelError(f"array: positions of shape (mics, 3) are needed, {positions.shape} given")
        mics = len(positions)
        if mics > _MOST_MICS:
            raise KernelError(ffi.string(lib.locagen_strerror(lib.LOCAGEN_E_MICS)).decode())
        rows, columns = _grid(positions, band_hz[1] / speed_m_s if speed_m_s > 0 else 0.0)
        try:
            config = ffi.new(
                "locagen_steer_config *",
                {
                    "mics": mics,
                    "frame": frame,
                    "hop": hop,
                    "spans": spans,
                    "lag": lag,
                    "smooth_bins": smooth_bins,
                    "azimuths": columns if azimuths is None else azimuths,
                    "elevations": rows if elevations is None else elevations,
                    "rate_hz": rate_hz,
                    "band_low_hz": band_hz[0],
                    "band_high_hz": band_hz[1],
                    "taper": taper,
                    "loading": loading,
                    "smear": smear,
                    "floor": floor,
                    "speed_m_s": speed_m_s,
                    "positions_m": positions.ravel().tolist(),
                },
            )
        except (OverflowError, TypeError) as fault:
            raise KernelError(f"kernel configuration: {fault}") from fault
        self._memory = ffi.new("char[]", max(1, lib.locagen_steer_sizeof(config)))
        self._state = ffi.cast("locagen_steer *", self._memory)
        _check(lib.locagen_steer_init(self._state, config))
        self._shape = (mics, frame)
        self._grid = (config.elevations, config.azimuths)
        self._power = np.empty(mics, _FLOAT32)
        self._power_pointer = ffi.from_buffer(_FLOATS, self._power)
        self._sources = ffi.new("locagen_source[]", _MOST_MICS)
        self._listen = lib.locagen_steer_listen
        bins = lib.locagen_steer_bin_count(self._state)
        self.first_bin: int = lib.locagen_steer_first_bin(self._state)
        self.frequency_hz: npt.NDArray[np.float64] = (
            (self.first_bin + np.arange(bins)) * float(rate_hz) / frame
        )
        self.elevation_rad = np.empty(self._grid[0], _FLOAT32)
        self.azimuth_rad = np.empty(self._grid[1], _FLOAT32)
        _check(
            lib.locagen_steer_axes(
                self._state,
                ffi.from_buffer(_FLOATS, self.elevation_rad),
                ffi.from_buffer(_FLOATS, self.azimuth_rad),
            )
        )

    def listen(self, samples: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], int]:
        """Takes a frame in: window, FFT.

        Args:
            samples: float32, C-contiguous, shape `(mics, frame)`, full scale 1.0; left as it is.

        Returns:
            The mean square of each microphone in the band, float32, shape `(mics,)`, new with every call; and
            a mask with bit `m` set where microphone `m` held a sample that is not finite or far too large: it
            does not count in this frame. A dead one, 50 dB under the loudest, does not either.

        Raises:
            KernelError: `samples` has another type, shape or memory layout.
        """
        bad: int = self._listen(self._state, _pointer(samples, self._shape), self._power_pointer)
        return self._power.copy(), bad

    def learn(self, share: float, ago: int = 0) -> None:
        """Puts the frame of so many hops ago into the noise's matrix: R <- (1 - share) R + share x x^H."""
        _check(lib.locagen_steer_learn(self._state, ago, share))

    def hear(self, share: float = 1.0, span: int = 0) -> None:
        """The same for the signal's matrix of a span, with the last frame; 1: this frame alone."""
        _check(lib.locagen_steer_hear(self._state, span, share))

    def watch(self, span: int = 0) -> None:
        """Puts aside how the noise strayed in the last search."""
        _check(lib.locagen_steer_watch(self._state, span))

    def settle(self, share: float, span: int = 0) -> None:
        """Keeps in mind what was put aside before the last time, so that scores mean the same in all noise.

        `share`: of each search.
        """
        _check(lib.locagen_steer_settle(self._state, span, share))

    def doubt(self, span: int = 0) -> None:
        """Instead of `watch`, while something calls: drops what was put aside."""
        _check(lib.locagen_steer_doubt(self._state, span))

    def weigh(self, weight: npt.NDArray[np.float32]) -> None:
        """Weights 0 to 1 of all bins in the band, float32, shape `(bins,)`, for the searches to come."""
        _check(lib.locagen_steer_weigh(self._state, _pointer(weight, (len(self.frequency_hz),))))

    def gain(self, span: int = 0) -> npt.NDArray[np.float32]:
        """Wiener's gain of all bins in the band, 0 to 1, float32, shape `(bins,)`.

        1 - noise / power of the span's signal over the noise, both as means over microphones and, as q, over
        neighbouring bins; 1 where nothing was heard or learnt.
        """
        gain = np.empty(len(self.frequency_hz), _FLOAT32)
        _check(lib.locagen_steer_gain(self._state, span, ffi.from_buffer(_FLOATS, gain)))
        return gain

    def search(
        self, max_sources: int = 1, span: int = 0, least: float = 0.0, further: float = 0.0
    ) -> tuple[Source, ...]:
        """The sources in the span's matrix, strongest first; at most one less than there are microphones.

        None before `hear`, in silence and with less than two microphones; none that scores `least` or less,
        and beside the first none that scores `further` or less. Where nothing was learnt the noise is taken
        for white, and its level from what is across the best direction.
        """
        room = min(max_sources, _MOST_MICS)
        found = _check(lib.locagen_steer_search(self._state, span, room, least, further, self._sources))
        return tuple(
            Source(s.azimuth_rad, s.elevation_rad, s.score, s.contrast, s.rival, s.snr, tuple(s.information))
            for s in self._sources[0:found]
        )

    def map(self, span: int = 0) -> npt.NDArray[np.float32]:
        """Scores of the span's last search on the coarse grid, float32, shape `(elevations, azimuths)`.

        Its axes are `elevation_rad` and `azimuth_rad`.
        """
        scores = np.empty(self._grid, _FLOAT32)
        _check(lib.locagen_steer_map(self._state, span, ffi.from_buffer(_FLOATS, scores)))
        return scores

    def bins(self) -> npt.NDArray[np.complex64]:
        """Bins of the last frame, complex64, shape `(mics, bins)`; squared magnitudes are bin powers."""
        bins = np.empty((self._shape[0], len(self.frequency_hz)), np.complex64)
        _check(lib.locagen_steer_bins(self._state, ffi.from_buffer(_FLOATS, bins.view(_FLOAT32))))
        return bins

    def noise(self) -> npt.NDArray[np.complex64]:
        """The noise's matrix, complex64, shape `(bins, mics, mics)`, without loading; zeros where none is."""
        mics = self._shape[0]
        noise = np.empty((len(self.frequency_hz), mics, mics), np.complex64)
        _check(lib.locagen_steer_noise(self._state, ffi.from_buffer(_FLOATS, noise.view(_FLOAT32))))
        return noise

    def reset(self) -> None:
        """Forgets noise, signal and frame."""
        _check(lib.locagen_steer_reset(self._state))


TAPS: int = lib.LOCAGEN_TAPS
"""Filters of `resample` have a multiple of so many."""


def resample(
    table: npt.NDArray[np.float32], up: int, down: int, at: int, samples: npt.NDArray[np.float32], count: int
) -> npt.NDArray[np.float32]:
    """`count` rows of a polyphase filter's output, float32, shape `(count, mics)`.

    Row `n` holds, for each microphone, the scalar product of `table[phase]` with what begins at
    `samples[:, start]`, where `start, phase = divmod(at + n * down, up)`.

    Args:
        table: float32, C-contiguous, shape `(up, taps)`, taps a multiple of `TAPS`.
        samples: float32, C-contiguous, shape `(mics, n)`.

    Raises:
        KernelError: a wrong type, shape or layout, or samples that end too early.
    """
    if np.ndim(table) != 2 or np.ndim(samples) != 2 or count < 0:
        raise KernelError(
            "resampling: a table and samples of two dimensions are needed, and no count below 0"
        )
    mics, length = samples.shape
    taps = table.shape[1]
    rows = np.empty((count, mics), _FLOAT32)
    source, target = _pointer(samples, samples.shape), ffi.from_buffer(_FLOATS, rows)
    filters = _pointer(table, (up, taps))
    try:
        code = lib.locagen_resample(filters, taps, up, down, at, source, mics, length, target, count)
    except OverflowError as fault:
        raise KernelError(f"resampling: {fault}") from fault
    _check(code)
    return rows


def _check(code: int) -> int:
    if code < 0:
        raise KernelError(ffi.string(lib.locagen_strerror(code)).decode())
    return code


def _grid(positions_m: npt.NDArray[np.float64], waves_per_m: float) -> tuple[int, int]:
    """Rows and columns of a grid on which the phase across the array steps by about a radian.

    A step of elevation over the rim of a flat array changes little, and so do azimuths near the pole: the
    rectangle is as fine as needed where it is coarsest.
    """
    arms = positions_m[:, None] - positions_m[None]
    reach = 2.0 * math.pi * waves_per_m * float(np.linalg.norm(arms, axis=2).max(initial=0.0))
    if not math.isfinite(reach):
        return 2, 8  # the kernel refuses the positions by name
    flat = np.linalg.matrix_rank(positions_m - positions_m.mean(axis=0), tol=1e-3) < 3
    columns = min(720, max(16, math.ceil(2.0 * math.pi * reach / 8.0) * 8))
    rows = max(4, math.ceil(0.5 * math.pi * reach / 2.0))
    return min(180, rows if flat else 2 * rows), columns


def _pointer(samples: npt.NDArray[np.float32], shape: tuple[int, ...]) -> Any:
    """What C may read from: everything is checked before."""
    try:
        # Comparing types by identity first: the comparison by value takes longer than the rest.
        if (samples.dtype is not _FLOAT32 and samples.dtype != _FLOAT32) or samples.shape != shape:
            raise KernelError(f"samples: {samples.dtype} {samples.shape} given, float32 {shape} needed")
        return ffi.from_buffer(_FLOATS, samples)
    except (AttributeError, TypeError, ValueError, BufferError) as fault:
        raise KernelError(f"samples: a C-contiguous float32 array is needed: {fault}") from fault
