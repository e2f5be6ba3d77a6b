"""A high-pass for a stream of blocks, without a loop over samples.

Fourth-order Butterworth from two biquads (Bristow-Johnson, "Cookbook formulae for audio EQ biquad filter
coefficients"; Q of a fourth order: 0.541 and 1.307). A block is one product of matrices: what the block's
samples do to its output, and what the four numbers that the filter remembers do (the filter's state space, as
in Oppenheim & Schafer, Discrete-Time Signal Processing, 6.3, run for a whole block). So how a stream is cut
does not show.
"""

from __future__ import annotations

import math

import numpy as np

from locagen_edge.types import F32, F64

QS = (0.54119610, 1.30656296)
BLOCK = 128
"""Samples filtered by one product; more costs more arithmetic, less more calls."""


class HighPass:
    """24 dB an octave below `corner_hz`; one memory per microphone."""

    def __init__(self, corner_hz: float, rate_hz: float, mics: int) -> None:
        b, a = _coefficients(corner_hz, rate_hz)
        forced, free, driven, kept = _block(b, a)
        # output and next memory from one product: [sound, memory] @ matrix
        self._matrix = np.block([[forced.T, driven.T], [free.T, kept.T]])
        self._memory = np.zeros((mics, len(a) - 1))

    def reset(self) -> None:
        """Silence before the next block."""
        self._memory[:] = 0.0

    def __call__(self, sound: F32) -> F32:
        """(mics, BLOCK * k) to the same. Every sample has to be finite."""
        out = np.empty(sound.shape, dtype=np.float32)
        for first in range(0, sound.shape[1], BLOCK):
            joined = np.concatenate([sound[:, first : first + BLOCK], self._memory], axis=1) @ self._matrix
            out[:, first : first + BLOCK] = joined[:, :BLOCK]
            self._memory = joined[:, BLOCK:]
        return out


def _coefficients(corner_hz: float, rate_hz: float) -> tuple[F64, F64]:
    """Numerator and denominator (5,) of the whole filter."""
    turn = 2.0 * math.pi * corner_hz / rate_hz
    b, a = np.ones(1), np.ones(1)
    for q in QS:
        alpha, cosine = math.sin(turn) / (2.0 * q), math.cos(turn)
        first = np.array([(1.0 + cosine) / 2.0, -(1.0 + cosine), (1.0 + cosine) / 2.0]) / (1.0 + alpha)
        second = np.array([1.0 + alpha, -2.0 * cosine, 1.0 - alpha]) / (1.0 + alpha)
        b, a = np.convolve(b, first), np.convolve(a, second)
    return b, a


def _block(b: F64, a: F64) -> tuple[F64, F64, F64, F64]:
    """State space (transposed direct form II) over BLOCK samples: y = forced x + free z, z' = driven x +
    kept z.
    """
    order = len(a) - 1
    step = np.zeros((order, order))
    step[:-1, 1:] = np.eye(order - 1)
    step[:, 0] = -a[1:]
    inlet = b[1:] - a[1:] * b[0]
    free = np.empty((BLOCK, order))
    driven = np.empty((order, BLOCK))
    power = np.eye(order)
    for k in range(BLOCK):
        free[k] = power[0]
        driven[:, BLOCK - 1 - k] = power @ inlet
        power = step @ power
    forced = b[0] * np.eye(BLOCK)
    response = free @ inlet  # of a sample one and more later
    for k in range(1, BLOCK):
        forced[np.arange(k, BLOCK), np.arange(BLOCK - k)] = response[k - 1]
    return forced, free, driven, power
