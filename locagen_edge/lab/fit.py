"""Training a network on given samples: AdamW under one cycle of learning rates, stopped early."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from locagen_edge.lab.settings import MlpSettings
from locagen_edge.types import F32, F64

Tell = Callable[[int, int, float], None]
"""told after each pass: its number from 1, how many there are at most, mean |error| on validation samples"""


def quiet(_: int, __: int, ___: float) -> None:
    """Tells nobody."""


@dataclass(frozen=True, slots=True)
class History:
    """How a training went."""

    validation_deg: tuple[float, ...]
    """mean |error| on the validation samples after each pass"""
    best_epoch: int


def fit(
    model: torch.nn.Module,
    x: F32,
    azimuth_rad: F32,
    s: MlpSettings,
    validation_share: float,
    tell: Tell = quiet,
) -> History:
    """Trains the model in place on inputs (n, ...) and azimuths (n,); leaves the best pass's weights in it.

    The loss is the squared error of cosine and sine, whose best answer for an input is the mean direction
    of all azimuths that lead to it. The last `validation_share` of the samples are not trained on: the pass
    with the smallest mean |error| there counts, and `s.patience` passes without a better one end it.
    Where there is CUDA, it trains there.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # layers this small take longer on two threads than on one
    try:
        return _fit(model, x, azimuth_rad, s, max(int(len(x) * validation_share), 1), tell)
    finally:
        model.cpu()
        torch.set_num_threads(threads)


def _fit(
    model: torch.nn.Module,
    x: F32,
    azimuth_rad: F32,
    s: MlpSettings,
    held: int,
    tell: Tell,
) -> History:
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model.to(device)
    inputs = torch.from_numpy(x[:-held]).to(device)
    directions = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1).astype(np.float32)
    wanted = torch.from_numpy(directions).to(device)
    generator = torch.Generator().manual_seed(s.seed)
    steps = math.ceil(len(inputs) / s.batch)
    optimiser = torch.optim.AdamW(model.parameters(), lr=s.rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=s.rate, total_steps=steps * s.epochs)
    best, best_epoch, weights = math.inf, 0, copy.deepcopy(model.state_dict())
    history: list[float] = []
    for epoch in range(s.epochs):
        model.train()
        order = torch.randperm(len(inputs), generator=generator).to(device)
        for rows in torch.split(order, s.batch):
            loss = torch.nn.functional.mse_loss(model(inputs[rows]), wanted[rows])
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
        error = np.abs(_turn(predict(model, x[-held:]) - azimuth_rad[-held:]))
        history.append(math.degrees(float(error.mean())))
        tell(epoch + 1, s.epochs, history[-1])
        if history[-1] < best:
            best, best_epoch, weights = history[-1], epoch, copy.deepcopy(model.state_dict())
        elif epoch - best_epoch >= s.patience:
            break
    model.load_state_dict(weights)
    return History(tuple(history), best_epoch)


def predict(model: torch.nn.Module, x: F32) -> F64:
    """Azimuths (n,) for inputs (n, ...), radians."""
    model.eval()
    device = next(model.parameters()).device
    with torch.no_grad():
        y = model(torch.from_numpy(x).to(device)).cpu().numpy().astype(np.float64)
    azimuth: F64 = np.arctan2(y[:, 1], y[:, 0])
    return azimuth


def _turn(angle: F64) -> F64:
    turned: F64 = np.angle(np.exp(1j * angle))
    return turned
