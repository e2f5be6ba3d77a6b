"""The paper's denoiser: a causal 1-D convolutional network from waveform to waveform, for one microphone.

One set of weights serves all microphones, so none of them is shifted against another. First and last layer
share their weights and start as a windowed cosine and sine frame, which reconstructs exactly: random first
layers with rectifiers learn far too slowly (Luo & Mesgarani, "Conv-TasNet", IEEE/ACM Trans. ASLP 27 (2019),
have the same encoder, mask and decoder from random weights and hundreds of hours). Between them dilated
causal convolutions see 1.5 s of the past and nothing of the future: a sample comes out once the last piece
that holds it has come in, STRIDE samples later.
"""

from __future__ import annotations

import math

import torch

from locagen_edge.lab.settings import WaveSettings

STRIDE = 64
KERNEL = 2 * STRIDE
PAIRS = STRIDE
"""cosines and as many sines"""
SILENCE = 1e-10
"""Power under which nothing is told apart. A limit, not a term: the exporter drops terms this small."""
TAPS = 3
DILATIONS = (1, 3, 9, 27, 81)

States = tuple[torch.Tensor, ...]


class Dilated(torch.nn.Module):
    """A causal convolution over time with a residual way round it."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.dilation = dilation
        self.mix = torch.nn.Linear(TAPS * width, width)
        self.scale = torch.nn.Parameter(torch.tensor(0.5))

    def forward(self, y: torch.Tensor, past: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """`y` (batch, time, width), `past` the (TAPS - 1) * dilation steps before: both again."""
        long = torch.cat([past, y], dim=1)
        time = y.shape[1]
        taps = torch.cat([long[:, k * self.dilation : k * self.dilation + time] for k in range(TAPS)], dim=2)
        return y + self.scale * torch.nn.functional.elu(self.mix(taps)), long[:, time:]


class WaveNet(torch.nn.Module):
    """Sound (batch, STRIDE * k) to sound of the same length, STRIDE samples late."""

    def __init__(self, s: WaveSettings) -> None:
        super().__init__()
        self.width = s.width
        self.frame = torch.nn.Parameter(_cosines_and_sines())
        self.enter = torch.nn.Linear(PAIRS, s.width)
        self.blocks = torch.nn.ModuleList(Dilated(s.width, d) for d in DILATIONS)
        self.leave = torch.nn.Linear(s.width, PAIRS)

    def start(self, batch: int = 1) -> States:
        """The states of silence before the first sample."""
        past = [torch.zeros(batch, (TAPS - 1) * dilation, self.width) for dilation in DILATIONS]
        return (torch.zeros(batch, STRIDE), torch.zeros(batch, STRIDE), *past)

    def forward(self, sound: torch.Tensor, *states: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The clean sound up to STRIDE samples ago, and the next states: last input, overlap, past."""
        batch = sound.shape[0]
        pieces = torch.cat([states[0], sound], dim=1).reshape(batch, -1, STRIDE)
        windows = torch.cat([pieces[:, :-1], pieces[:, 1:]], dim=2)
        heard = windows @ self.frame
        cosine, sine = heard[..., :PAIRS], heard[..., PAIRS:]
        y = torch.nn.functional.elu(
            self.enter(0.5 * torch.log10((cosine**2 + sine**2).clamp_min(SILENCE)) + 2.0)
        )
        after = [pieces[:, -1]]
        pasts = []
        for block, past in zip(self.blocks, states[2:], strict=True):
            y, past = block(y, past)
            pasts.append(past)
        mask = torch.sigmoid(self.leave(y))
        masked = torch.cat([cosine * mask, sine * mask], dim=2) @ self.frame.T
        first, second = masked[..., :STRIDE], masked[..., STRIDE:]
        before = torch.cat([states[1].unsqueeze(1), second[:, :-1]], dim=1)
        clean = (first + before).reshape(batch, -1)
        return (clean, *after, second[:, -1], *pasts)


def _cosines_and_sines() -> torch.Tensor:
    """(KERNEL, 2 PAIRS): frame @ frame.T, overlapped and added, gives the sound back."""
    n = torch.arange(KERNEL, dtype=torch.float64)[:, None]
    k = torch.arange(PAIRS, dtype=torch.float64)[None, :]
    turns = math.pi / PAIRS * (n + 0.5) * (k + 0.5)
    window = torch.sin(math.pi / KERNEL * (n + 0.5))
    frame = window * torch.cat([torch.cos(turns), torch.sin(turns)], dim=1) / math.sqrt(PAIRS)
    return frame.to(torch.float32)
