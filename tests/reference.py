"""The kernel's definition once more, in float64, as plainly as it can be written."""

import numpy as np
import numpy.typing as npt


def gcc_phat(
    samples: npt.NDArray[np.floating],
    *,
    lags: int,
    oversample: int,
    rate_hz: float,
    band_hz: tuple[float, float],
    floor: float,
    relative_floor: float,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Correlation `(pairs, 2 * lags + 1)` and power `(mics,)` of samples `(mics, frame)`."""
    mics, frame = samples.shape
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(frame) / frame)
    spectra = np.fft.rfft(samples.astype(np.float64) * window)
    # The kernel takes its band as float32: so does this, or an edge on a bin may fall to the other side.
    low, high = (float(np.float32(edge)) * frame / float(np.float32(rate_hz)) for edge in band_hz)
    bins = np.arange(int(np.ceil(low)), int(np.floor(high)) + 1)
    spectra = spectra[:, bins] * np.sqrt(2 / (frame * np.sum(window**2)))
    bin_power = np.abs(spectra) ** 2
    power = bin_power.sum(axis=1)
    floors = np.maximum(floor, relative_floor * bin_power.mean(axis=1))
    scale = np.sqrt(bin_power + floors[:, None])
    unit = np.divide(spectra, scale, out=np.zeros_like(spectra), where=scale > 0)
    lag = np.arange(-lags, lags + 1) / oversample
    turn = np.exp(2j * np.pi / frame * bins[:, None] * lag)
    correlation = [
        ((unit[j] * unit[i].conj()) @ turn).real / len(bins) for i in range(mics) for j in range(i + 1, mics)
    ]
    return np.array(correlation), power
