"""The definition of the steered search in float64, straight from its formulas: slow, no shared code."""

from typing import Any

import numpy as np

from locagen_edge.geometry import direction


def window(frame: int, taper: float) -> np.ndarray:
    """Tukey's, periodic."""
    n = np.arange(frame)
    edge = np.minimum(n, frame - n)
    flank = taper * frame / 2
    return np.where(edge < flank, 0.5 - 0.5 * np.cos(np.pi * edge / max(flank, 1e-9)), 1.0)


class Reference:
    """One array and one configuration; the caller keeps the matrices."""

    def __init__(
        self,
        positions_m: np.ndarray,
        *,
        frame: int,
        rate_hz: float,
        speed_m_s: float,
        band_hz: tuple[float, float] = (300.0, 4700.0),
        taper: float = 0.1,
        smooth_bins: int = 6,
        loading: float = 1e-3,
        smear: float = 0.0,
        floor: float = 1e-12,
        **_: Any,
    ) -> None:
        f = np.arange(frame // 2 + 1) * rate_hz / frame
        low, high = (np.float64(np.float32(edge)) for edge in band_hz)
        bins_per_hz = frame / np.float64(np.float32(rate_hz))
        self.k = np.arange(int(np.ceil(low * bins_per_hz)), int(np.floor(high * bins_per_hz)) + 1)
        self.f = f[self.k]
        self.positions = np.float64(np.float32(positions_m))
        self.speed = speed_m_s
        self.window = window(frame, taper)
        w2 = self.window**2
        self.looks = w2.sum() ** 2 / (frame * (w2**2).sum())
        self.noise_looks = np.inf  # how many independent frames the noise was learnt from, times looks
        self.smooth, self.loading, self.floor = smooth_bins, loading, floor
        self.smear, self.smear_half = smear, int(100.0 * frame / rate_hz)

    def bins(self, samples: np.ndarray) -> np.ndarray:
        """(mics, bins), squared magnitudes are bin powers"""
        frame = len(self.window)
        spectrum = np.fft.rfft(samples * self.window, axis=1)[:, self.k]
        return spectrum * np.sqrt(2 / (frame * (self.window**2).sum()))

    @staticmethod
    def cross(x: np.ndarray) -> np.ndarray:
        """(bins, mics, mics) of one frame"""
        return np.einsum("ik,jk->kij", x, x.conj())

    def loaded(self, noise: np.ndarray) -> np.ndarray:
        mics = noise.shape[1]
        around = np.array(
            [
                noise[max(k - self.smear_half, 0) : k + self.smear_half + 1].mean(axis=0)
                for k in range(len(noise))
            ]
        )
        noise = noise + self.smear * around
        level = np.trace(noise, axis1=1, axis2=2).real / mics + self.floor
        return noise + (self.loading * level + self.floor)[:, None, None] * np.eye(mics)

    def gain(self, signal: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Wiener's, (bins,); noise as it was learnt"""
        of_signal, of_noise = (np.einsum("kii->ki", matrix).real for matrix in (signal, noise))
        over = self.smoothed((of_signal / (of_noise + self.floor)).mean(axis=1))
        return np.maximum(1 - 1 / np.maximum(over, 1e-30), 0)

    def smoothed(self, q: np.ndarray) -> np.ndarray:
        """Means over the bins each side that there are."""
        kernel = np.ones(2 * min(self.smooth, len(q) - 1) + 1)
        middle = len(kernel) // 2
        cut = slice(middle, middle + len(q))
        return np.convolve(q, kernel)[cut] / np.convolve(np.ones(len(q)), kernel)[cut]

    def phases(self, u: np.ndarray) -> np.ndarray:
        """a (bins, mics) of direction u"""
        return np.exp(2j * np.pi * self.f[:, None] * (self.positions @ u) / self.speed)

    def score(
        self, signal: np.ndarray, noise: np.ndarray, u: np.ndarray, nulls: tuple[np.ndarray, ...] = ()
    ) -> float:
        """By whitening with Cholesky's factor; noise as `loaded` gives it."""
        whitener = np.linalg.inv(np.linalg.cholesky(noise))
        n, mics = self.noise_looks, noise.shape[1]
        unbiased = max(0.25, (1 - (mics - 1) / n) * (1 - mics / n))
        x = unbiased * (whitener @ signal @ whitener.conj().transpose(0, 2, 1))
        a = np.einsum("kij,kj->ki", whitener, self.phases(u))
        for v in nulls:
            b = np.einsum("kij,kj->ki", whitener, self.phases(v))
            b /= np.linalg.norm(b, axis=1)[:, None]
            out = np.eye(b.shape[1]) - b[:, :, None] * b[:, None, :].conj()
            a = np.einsum("kij,kj->ki", out, a)
        q = np.einsum("ki,kij,kj->k", a.conj(), x, a).real / (np.abs(a) ** 2).sum(axis=1)
        q = np.maximum(self.smoothed(q), 1)
        looks = 1 / (1 / self.looks + 1 / self.noise_looks)
        return float(looks * (q - 1 - np.log(q)).sum())

    def at(self, signal: np.ndarray, noise: np.ndarray, azimuth: float, elevation: float) -> float:
        return self.score(signal, noise, direction(azimuth, elevation))
