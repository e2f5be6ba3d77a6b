"""The network that serves the bearing: noise relative spectra in, one mask for all microphones out.

Time and frequency are kept apart, so that few weights see much: a band of four bins is described by a short
vector, every band's vectors run through the same recurrent layer over time, and a dense layer mixes the
bands. What is learnt of a call in one band holds in the others, and the recurrence is all the memory there
is: its state goes in and comes out, so a stream cut anywhere gives what the whole file gives.

The mixture comes divided by the tracked noise spectrum (denoise.md's 3 dB), so neither level nor the
microphones' colour can matter. The answer for a spectrum is given LOOKAHEAD spectra later.
"""

from __future__ import annotations

import torch

from locagen_edge.lab.settings import MaskSettings

BINS = 128
"""of a 256-point spectrum, without 0 Hz"""
BAND = 4
BANDS = BINS // BAND
LOOKAHEAD = 3
"""Spectra: with the half window that overlap-add waits for, exactly one hop of 512 samples."""
AROUND = 4
"""bins beside a band that it sees too"""
FLOOR = 1e-3
"""-30 dB under the noise there is nothing to hear"""
PER_BIN = 4

States = tuple[torch.Tensor, ...]


class Block(torch.nn.Module):
    """Over time, each band by itself; then over the bands, each moment by itself."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gru = torch.nn.GRU(width, width, batch_first=True)
        self.out = torch.nn.Linear(width, width)
        self.widen = torch.nn.Linear(width, width)
        self.bands = torch.nn.Linear(BANDS, BANDS)
        self.narrow = torch.nn.Linear(width, width)

    def forward(self, y: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """`y` (batch, bands, time, width), `state` (1, batch * bands, width): both again, one step on."""
        batch, bands, time, width = y.shape
        heard, state = self.gru(y.reshape(batch * bands, time, width), state)
        y = y + self.out(heard).reshape(batch, bands, time, width)
        wide = torch.nn.functional.elu(self.widen(y))
        mixed = torch.nn.functional.elu(self.bands(wide.transpose(1, 3))).transpose(1, 3)
        return y + self.narrow(mixed), state


class MaskNet(torch.nn.Module):
    """Relative power (batch, time, BINS) and noise power (batch, BINS) to a mask of 0 to 1."""

    def __init__(self, s: MaskSettings) -> None:
        super().__init__()
        self.width = s.width
        seen = (LOOKAHEAD + 2) * (BAND + 2 * AROUND)
        self.enter = torch.nn.Linear(seen, s.width)
        self.place = torch.nn.Parameter(torch.zeros(BANDS, 1, s.width))
        self.blocks = torch.nn.ModuleList(Block(s.width) for _ in range(s.blocks))
        self.leave = torch.nn.Linear(s.width, BAND * PER_BIN)
        self.refine = torch.nn.Linear(PER_BIN + LOOKAHEAD + 1, 8)
        self.answer = torch.nn.Linear(8, 1)

    def start(self, batch: int = 1) -> States:
        """The states of silence before the first spectrum."""
        past = torch.zeros(batch, LOOKAHEAD, BINS)
        return (past, *(torch.zeros(1, batch * BANDS, self.width) for _ in self.blocks))

    def forward(
        self, relative: torch.Tensor, noise: torch.Tensor, *states: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Mask (batch, time, BINS) for the spectra LOOKAHEAD earlier, and the next states."""
        batch, time, _ = relative.shape
        level = torch.log10(relative + FLOOR)
        shape = torch.log10(noise.clamp_min(1e-20))
        shape = (shape - shape.mean(dim=1, keepdim=True)).unsqueeze(1).expand(batch, time, BINS)
        long = torch.cat([states[0], level], dim=1)
        taps = [long[:, k : k + time] for k in range(LOOKAHEAD + 1)]
        seen = torch.cat([_banded(x) for x in (*taps, shape)], dim=3)
        y = torch.nn.functional.elu(self.enter(seen.transpose(1, 2)) + self.place)
        after = [long[:, time:]]
        for block, state in zip(self.blocks, states[1:], strict=True):
            y, state = block(y, state)
            after.append(state)
        per_bin = self.leave(y).transpose(1, 2).reshape(batch, time, BINS, PER_BIN)
        fine = torch.cat([per_bin, torch.stack(taps, dim=3)], dim=3)
        mask = torch.sigmoid(self.answer(torch.nn.functional.elu(self.refine(fine)))).squeeze(3)
        return (mask, *after)


def _banded(x: torch.Tensor) -> torch.Tensor:
    """(batch, time, BINS) to (batch, time, BANDS, BAND + 2 AROUND): each band and its neighbours."""
    padded = torch.nn.functional.pad(x, (AROUND, AROUND))
    parts = [
        padded[:, :, k : k + BINS].reshape(*x.shape[:2], BANDS, BAND) for k in range(0, 2 * AROUND + 1, BAND)
    ]
    return torch.cat(parts, dim=3)
