"""A model of the paper from the twin to the models directory, with its card."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from locagen_edge.errors import ModelError
from locagen_edge.lab.bound import mae_deg
from locagen_edge.lab.export import install
from locagen_edge.lab.methods import METHODS, split, train
from locagen_edge.lab.settings import LabSettings
from locagen_edge.lab.twin import sample

CARD = """# {name}

One of the paper's models ({kind}), from the delays of all pairs to the azimuth.

- **Input** `delays` (1, {pairs}) float32: c (t_j - t_i) / d_ij for the pairs (0,1), (0,2), ... Inside, the
  delays against microphone 0 are standardised, and their ratio to the first is added (0 where that is 0).
- **Output** `direction` (1, 2) float32: cosine and sine of the azimuth (0 ahead, positive clockwise seen
  from above); not normalised.
- **Array** (metres, x forward, y right, z down): {positions}
- **Trained** on {samples:,} computed arrivals, not on sound, at {rate:g} Hz: {twin}.
- **Held out** ({held_out:,} samples): mean |error| {mae:.2f} degrees.
- **Made by** `locagen-lab train {name}`.
- **Not for** other arrays (refused), other sample rates, or sources well below the array's height.
"""


def install_method(name: str, s: LabSettings, directory: Path) -> str:
    """Trains the method, installs file, manifest entry and card, and says how good it is in one line.

    Raises `ModelError` for an unknown name.
    """
    if name not in METHODS:
        raise ModelError(f"method {name}: is unknown; there are {', '.join(METHODS)}")
    directory.mkdir(parents=True, exist_ok=True)
    learned, rest = split(sample(s, s.data.samples, s.data.seed), s.data.train_share)
    trained = train(name, s, learned)
    mae = mae_deg(trained.azimuths(rest.delay_s), rest.azimuth_rad)
    content = trained.onnx()
    card = CARD.format(
        name=name,
        kind="a random forest" if name.startswith("forest") else "a network",
        pairs=len(s.mic_array.pairs),
        positions=np.round(s.mic_array.positions_m, 6).tolist(),
        samples=len(learned.azimuth_rad),
        held_out=len(rest.azimuth_rad),
        rate=s.audio.rate_hz,
        twin=", ".join(f"{key} {value}" for key, value in dataclasses.asdict(s.twin).items()),
        mae=mae,
    )
    install(name, content, s.mic_array.positions_m, card, directory)
    return f"{name}: {len(content):,} bytes, mean |error| {mae:.2f}° at {s.audio.rate_hz / 1000:g} kHz"
