"""What the paper's models see: the delays against the base microphone, standardised, and their ratio.

A module of torch, so that the very code that made the training data becomes part of the exported graph: in
flight every model takes the normalised delays c tau / d of all pairs and makes its own features of them.
"""

from __future__ import annotations

import numpy as np
import torch

from locagen_edge.geometry import MicArray
from locagen_edge.types import F32

RATIO_LIMIT = 10.0
"""Without rounding the ratio goes to infinity near two azimuths; beyond this it says nothing more."""
ZERO = 1e-6
"""A delay below a millionth of the spacing counts as zero."""


class Features(torch.nn.Module):
    """Normalised delays (n, pairs) to (n, 2 mics - 3): base delays standardised, then ratios to the first.

    Where the first base delay is zero the ratio is 0: it has no sign there, and of the numbers that could
    stand for it only 0 favours neither. With whole-sample delays at 10 kHz that is one sample in seven.
    """

    mean: torch.Tensor
    scale: torch.Tensor

    def __init__(self, mics: int, mean: F32, scale: F32) -> None:
        super().__init__()
        self.base = mics - 1
        self.register_buffer("mean", torch.from_numpy(np.asarray(mean, np.float32)))
        self.register_buffer("scale", torch.from_numpy(np.asarray(scale, np.float32)))

    def forward(self, delays: torch.Tensor) -> torch.Tensor:
        base = delays[:, : self.base]
        first, others = base[:, :1], base[:, 1:]
        zero = first.abs() < ZERO
        ratio = others / torch.where(zero, torch.ones_like(first), first)
        ratio = torch.where(zero, torch.zeros_like(ratio), ratio.clamp(-RATIO_LIMIT, RATIO_LIMIT))
        return torch.cat([(base - self.mean) / self.scale, ratio], dim=1)

    @property
    def size(self) -> int:
        return 2 * self.base - 1


def fit_features(delays: F32, mics: int) -> Features:
    """Features standardised on these normalised delays (n, pairs)."""
    base = delays[:, : mics - 1]
    return Features(mics, base.mean(axis=0), base.std(axis=0))


def normalised(delay_s: F32, array: MicArray, speed_m_s: float) -> F32:
    """c tau / d (n, pairs) of delays (pairs, n): each delay as a share of its pair's longest."""
    scale = (speed_m_s / array.spacing_m).astype(np.float32)
    return np.ascontiguousarray((delay_s * scale[:, None]).T)
