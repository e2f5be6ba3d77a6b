"""Wind in the microphones: turbulence that drifts past, loud at low frequencies, partly coherent.

Spectrum: stagnation pressure of turbulence, level up to the frequency at which eddies of the turbulence's own
size drift past, then falling as f ** -5/3 (Morgan & Raspet, J. Acoust. Soc. Am. 92 (1992) 1180-1183).

Coherence: Corcos, "Resolution of pressure in turbulence", J. Acoust. Soc. Am. 35 (1963) 192-199. Between two
places, `a` apart along the wind and `b` across it, with eddies that drift at U_c:

    exp(-2 pi f (ALONG |a| + ACROSS |b|) / U_c), with the delay a / U_c

It is a delay of wind, not of sound: a hundred times longer than the sound's, so it is no bearing.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from locagen_edge.types import F64

C64 = npt.NDArray[np.complex64]
C128 = npt.NDArray[np.complex128]

ALONG = 0.11  # Corcos' decay constants, as measured since on plates and on microphones outdoors
ACROSS = 0.75
DRIFT = 0.7  # speed of eddies over speed of the wind
EDDY_M = 1.0  # size of the largest eddies that a hovering drone meets


def power(frequency_hz: F64, wind_m_s: float) -> F64:
    """Power spectrum at these frequencies (...), 1.0 at 0 Hz."""
    shape: F64 = 1.0 / (1.0 + (frequency_hz * EDDY_M / wind_m_s) ** (5.0 / 3.0))
    return shape


def coherence(positions_m: F64, heading_rad: F64, frequency_hz: F64, wind_m_s: float) -> C128:
    """Complex coherence (..., bins, mics, mics) between microphones (..., mics, 3).

    The wind blows towards `heading_rad` (...), body axes. Element (i, j) is E[x_i conj(x_j)] at power 1.
    """
    apart = positions_m[..., :, np.newaxis, :2] - positions_m[..., np.newaxis, :, :2]
    cosine = np.cos(heading_rad)[..., np.newaxis, np.newaxis]
    sine = np.sin(heading_rad)[..., np.newaxis, np.newaxis]
    along = cosine * apart[..., 0] + sine * apart[..., 1]
    across = cosine * apart[..., 1] - sine * apart[..., 0]
    fading = ALONG * np.abs(along) + ACROSS * np.abs(across)
    turn = (2.0 * np.pi / (DRIFT * wind_m_s)) * frequency_hz[:, np.newaxis, np.newaxis]
    partly: C128 = np.exp(-turn * (fading + 1j * along)[..., np.newaxis, :, :])
    return partly


def wind(positions_m: F64, frequency_hz: F64, size: int, wind_m_s: float, rng: np.random.Generator) -> C64:
    """Spectra (samples, mics, bins) of wind at microphones (samples, mics, 3), from random headings.

    `frequency_hz` (bins,) are the first bins of a real FFT of `size` samples, whose mean square is 1 on
    average.
    """
    count, mics = positions_m.shape[:2]
    heading = rng.uniform(-np.pi, np.pi, (count,))
    shape = power(frequency_hz[1:], wind_m_s)  # nothing at 0 Hz
    matrix = coherence(positions_m, heading, frequency_hz[1:], wind_m_s)
    # 1e-9: at the lowest bins the microphones hear the same, and rounding must not make it more than that
    root = np.linalg.cholesky(matrix + 1e-9 * np.eye(mics))
    noise = rng.standard_normal((count, len(shape), mics, 2)).view(np.complex128)
    spectra = np.zeros((count, mics, len(frequency_hz)), dtype=np.complex64)
    mixed = (root @ noise)[..., 0] * np.sqrt(shape * size**2 / (4.0 * shape.sum()))[:, np.newaxis]
    spectra[:, :, 1:] = mixed.swapaxes(1, 2)
    return spectra
