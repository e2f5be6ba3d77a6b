"""From sound to numbers, as real converters do it: clocks that are off, clipping, steps.

A microphone's constant delay and gain are factors of its spectrum and are applied there; what is left is what
is not linear or does not stand still.
"""

from __future__ import annotations

import numpy as np

from locagen_edge.sim.propagation import interpolate
from locagen_edge.types import F32, F64, Array

OVERSAMPLE = 2  # `interpolate` wants the sound within half of its Nyquist frequency


def drifted(spectrum: Array, size: int, at: F64) -> F32:
    """Sound (rows, n) with these spectra (rows, bins), read at fractional samples `at` (rows, n).

    `bins` are the first of a real FFT of `size` samples; nothing may lie above 0.48 of the sample rate. The
    error is below -80 dB. `at` stays 8 samples away from 0 and `size`.
    """
    double = np.fft.irfft(OVERSAMPLE * spectrum, OVERSAMPLE * size, axis=-1).astype(np.float32, copy=False)
    rows = zip(double.reshape(-1, double.shape[-1]), at.reshape(-1, at.shape[-1]), strict=True)
    read = np.stack([interpolate(row, OVERSAMPLE * moments) for row, moments in rows])
    sound: F32 = read.reshape(at.shape)
    return sound


def convert(sound: F32, bits: int) -> F32:
    """Clipped at full scale and rounded to words of so many bits, still float32; 0 bits: left as it is.

    Two's complement: -1 to 1 - 2 ** (1 - bits) in steps of 2 ** (1 - bits). No dither: sensor noise is one.
    """
    if bits == 0:
        return sound
    steps = np.float32(2.0 ** (bits - 1))
    words = sound * steps
    np.rint(words, out=words)
    np.clip(words, -steps, steps - np.float32(1.0), out=words)
    words /= steps
    return words
