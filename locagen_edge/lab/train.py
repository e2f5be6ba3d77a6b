"""Trains the first learned estimator: an MLP from the delays of all pairs to the azimuth.

    python -m locagen_edge.lab.train [--directory models] [--seed 1] [--steps 4000]

Inputs are delays as a share of each pair's longest, c tau / d, so the model holds at any rate and
temperature for the array it was trained for; outputs are the azimuth's cosine and sine, which have no seam at
360 degrees. Samples are drawn anew at every step: plane waves from all azimuths and from the horizon to 60
degrees below, with independent Gaussian arrival errors.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch

from locagen_edge.geometry import MicArray
from locagen_edge.lab.export import install, to_onnx
from locagen_edge.lab.nets.mlp import mlp
from locagen_edge.lab.settings import MlpSettings
from locagen_edge.models import default_directory
from locagen_edge.settings import Settings
from locagen_edge.types import F32, F64

NAME = "tdoa-mlp"
LOWEST_DEG = -60.0
ARRIVAL_NOISE = 0.01
"""1-sigma of each arrival as a share of the spacing: 3 us on 10 cm, about 10 dB SNR in one frame."""
BATCH = 2048
SHAPE = MlpSettings(width=32, layers=2)
"""About 1,300 weights: the answer is smooth, and a call has to cost microseconds."""


def samples(array: MicArray, count: int, noise: float, rng: np.random.Generator) -> tuple[F32, F64]:
    """Normalised delays (count, pairs) with arrival noise, and the true azimuths (count,) in radians."""
    azimuth = rng.uniform(-math.pi, math.pi, count)
    elevation = np.radians(rng.uniform(LOWEST_DEG, 0.0, count))
    u = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)]
    )
    arrival = -array.positions_m @ u
    arrival += noise * array.spacing_m.mean() * rng.standard_normal(arrival.shape)
    first, second = np.array(array.pairs).T
    delays = (arrival[second] - arrival[first]) / array.spacing_m[:, None]
    return delays.T.astype(np.float32), azimuth


def train(array: MicArray, seed: int, steps: int, progress: bool = False) -> torch.nn.Module:
    """The trained network. Same seed and steps, same weights on the same machine."""
    from tqdm import trange

    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    model = mlp(len(array.pairs), SHAPE)
    optimiser = torch.optim.AdamW(model.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=1e-2, total_steps=steps)
    bar = trange(steps, desc="training", unit="step", disable=not progress)
    for step in bar:
        x, azimuth = samples(array, BATCH, ARRIVAL_NOISE, rng)
        wanted = torch.from_numpy(np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1).astype(np.float32))
        loss = torch.nn.functional.mse_loss(model(torch.from_numpy(x)), wanted)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        if progress and step % 100 == 0:
            bar.set_postfix(mse=f"{loss.item():.2e}")
    return model


def mean_error_deg(model: torch.nn.Module, array: MicArray, noise: float, seed: int) -> float:
    """Mean |azimuth error| in degrees on 20,000 new samples."""
    x, azimuth = samples(array, 20_000, noise, np.random.default_rng(seed))
    with torch.no_grad():
        y = model(torch.from_numpy(x)).numpy()
    error = np.angle(np.exp(1j * (np.arctan2(y[:, 1], y[:, 0]) - azimuth)))
    return float(np.degrees(np.abs(error).mean()))


CARD = """# {name}

A multilayer perceptron ({pairs}-32-32-2, tanh) from the delays of all pairs to the azimuth.

- **Input** `delays` (1, {pairs}) float32: c (t_j - t_i) / d_ij for the pairs (0,1), (0,2), ...
- **Output** `direction` (1, 2) float32: cosine and sine of the azimuth (0 ahead, positive clockwise seen
  from above); not normalised.
- **Array** (metres, x forward, y right, z down): {positions}
- **Trained** on simulated plane waves alone, azimuth uniform, elevation uniform from {lowest:g} to 0 degrees,
  Gaussian error of {noise:g} of the spacing on each arrival; seed {seed}, {steps} steps of {batch}.
- **Held-out seeds**: mean |error| {clean:.2f} degrees without noise, {noisy:.2f} with the training noise.
- **Made by** `python -m locagen_edge.lab.train --seed {seed} --steps {steps}`. No recorded sound was used.
- **Not for** other arrays (refused), near sources, or elevations below {lowest:g} degrees.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description="Train and install the MLP from delays to azimuth.")
    parser.add_argument("--directory", type=Path, default=default_directory(), help="where to install it")
    parser.add_argument("--seed", type=int, default=1, help="of weights and samples (default 1)")
    parser.add_argument("--steps", type=int, default=4000, help=f"batches of {BATCH} (default 4000)")
    arguments = parser.parse_args()
    array = Settings().mic_array
    model = train(array, arguments.seed, arguments.steps, progress=True)
    clean = mean_error_deg(model, array, 0.0, seed=arguments.seed + 1)
    noisy = mean_error_deg(model, array, ARRIVAL_NOISE, seed=arguments.seed + 2)
    card = CARD.format(
        name=NAME,
        pairs=len(array.pairs),
        positions=np.round(array.positions_m, 6).tolist(),
        lowest=LOWEST_DEG,
        noise=ARRIVAL_NOISE,
        seed=arguments.seed,
        steps=arguments.steps,
        batch=BATCH,
        clean=clean,
        noisy=noisy,
    )
    content = to_onnx(model, torch.zeros(1, len(array.pairs)), "delays", "direction")
    install(NAME, content, array.positions_m, card, arguments.directory)
    print(f"{NAME}: {len(content)} bytes, mean |error| {clean:.2f}° clean, {noisy:.2f}° with noise")


if __name__ == "__main__":
    main()
