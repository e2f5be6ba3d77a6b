"""From a trained denoiser to a model that flies: ONNX, parity over a stream, size, time, card, manifest."""

from __future__ import annotations

import dataclasses
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from locagen_edge.errors import ModelError
from locagen_edge.files import replacing
from locagen_edge.lab.export import install, to_onnx_with_states
from locagen_edge.lab.nets.mask import BINS, MaskNet
from locagen_edge.lab.nets.wave import WaveNet
from locagen_edge.lab.settings import LabSettings
from locagen_edge.models import Network, load_network
from locagen_edge.stages.denoise import CHUNK, MASK_DELAY, RATE_HZ, STEP, WAVE_DELAY
from locagen_edge.types import F32

PARITY = 1e-4
"""Largest difference between file, by chunks, and trained network, all at once: in a mask of 0 to 1, or in
sound of about 1.
"""
CHUNKS = 40
MICS = 3
CALLS = 200


def models_in(s: LabSettings, directory: Path) -> LabSettings:
    """The same settings with the models of another directory."""
    return dataclasses.replace(s, models=dataclasses.replace(s.models, directory=str(directory)))


def to_file(net: torch.nn.Module) -> bytes:
    """The ONNX file of either network: CHUNK samples a call, states in and out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch about its own exporter
        if isinstance(net, WaveNet):
            states = net.start(MICS)
            mics = torch.export.Dim("mics", min=1, max=64)
            open_dimensions = ({0: mics}, tuple({0: mics} for _ in states))
            return to_onnx_with_states(
                net,
                (torch.rand(MICS, CHUNK), *states),
                *_names("sound", "clean", len(states)),
                open_dimensions,
            )
        assert isinstance(net, MaskNet)
        states = net.start()
        given, answers = _names("relative", "mask", len(states))
        shapes = (torch.rand(1, CHUNK // STEP, BINS), torch.rand(1, BINS))
        return to_onnx_with_states(net, (*shapes, *states), [given[0], "noise", *given[1:]], answers)


def _names(given: str, answer: str, states: int) -> tuple[list[str], list[str]]:
    return [given, *(f"state_{k}" for k in range(states))], [answer, *(f"next_{k}" for k in range(states))]


def publish(name: str, net: torch.nn.Module, directory: Path, s: LabSettings, story: str) -> dict[str, Any]:
    """Installs the model and checks what was installed. Raises `ModelError` where it does not answer as
    trained.

    `story`: the card's lines on data and figures.
    """
    directory.mkdir(parents=True, exist_ok=True)
    content = to_file(net)
    facts: dict[str, Any] = {
        "parameters": sum(p.numel() for p in net.parameters()), "bytes": len(content),
    }  # fmt: skip
    install(name, content, None, "\n", directory)  # without its card: that tells what is measured now
    network = load_network(name, models_in(s, directory))
    facts["parity"] = parity(net, network)
    facts["call_ms"] = call_ms(net, network)
    if facts["parity"] > PARITY:
        raise ModelError(f"model {name}: file and trained network differ by {facts['parity']:.2g}")
    install(name, content, None, card(name, net, facts, story), directory)
    _keep_weights(name, net, directory)
    return facts


def _keep_weights(name: str, net: torch.nn.Module, directory: Path) -> None:
    """Beside the file, for tuning: an ONNX file does not give them back as they were."""
    with replacing(directory / f"{name}.npz") as temporary, temporary.open("wb") as file:
        np.savez(file, **{key: value.numpy() for key, value in net.state_dict().items()})


def weights_of(name: str, directory: Path) -> dict[str, torch.Tensor]:
    """What a model was when it was published. Raises `ModelError` where it cannot be tuned."""
    path = directory / f"{name}.npz"
    try:
        with np.load(path, allow_pickle=False) as kept:
            return {key: torch.from_numpy(kept[key]) for key in kept.files}
    except (OSError, ValueError) as error:
        raise ModelError(f"model {name}: {path} with its weights is missing or broken: {error}") from error


def parity(net: torch.nn.Module, network: Network) -> float:
    """Largest difference between the network on a whole stream and the file chunk by chunk."""
    first, *rest = _inputs(net, CHUNKS)
    with torch.no_grad():
        whole = net(*(torch.from_numpy(x) for x in (first, *rest)), *_start(net))[0].numpy()
    states = network.zeros(mics=MICS)
    size = first.shape[1] // CHUNKS
    parts = []
    for k in range(CHUNKS):
        answer, *states = network([first[:, k * size : (k + 1) * size], *rest, *states])
        parts.append(answer)
    return float(np.abs(np.concatenate(parts, axis=1) - whole).max())


def _inputs(net: torch.nn.Module, chunks: int) -> list[F32]:
    rng = np.random.default_rng(1)
    if isinstance(net, WaveNet):
        sound = rng.standard_normal((MICS, chunks * CHUNK)) * np.geomspace(1.0, 1e-5, chunks * CHUNK)
        sound[1] = 0.0  # a dead microphone
        return [sound.astype(np.float32)]
    relative = rng.exponential(1.0, (1, chunks * CHUNK // STEP, BINS)) * 10.0 ** rng.uniform(
        -1, 2, (1, 1, BINS)
    )
    noise = rng.exponential(1.0, (1, BINS))
    noise[:, ::7] = 0.0
    relative[:, ::5] = 0.0
    return [relative.astype(np.float32), noise.astype(np.float32)]


def _start(net: torch.nn.Module) -> tuple[torch.Tensor, ...]:
    assert isinstance(net, WaveNet | MaskNet)
    return net.start(MICS) if isinstance(net, WaveNet) else net.start()


def call_ms(net: torch.nn.Module, network: Network) -> float:
    """Median time of one call, three microphones, one thread."""
    inputs = [*_inputs(net, 1), *network.zeros(mics=MICS)]
    took = []
    for _ in range(CALLS):
        began = time.perf_counter()
        network(inputs)
        took.append(time.perf_counter() - began)
    return 1e3 * float(np.median(took))


WHAT = {
    WaveNet: (
        "The paper's denoiser: a causal 1-D convolutional network from waveform to waveform, one set of "
        "weights for "
        "all microphones",
        "`sound` (mics, 512) float32, high-passed at 80 Hz; states",
        f"`clean` (mics, 512): the same {WAVE_DELAY} samples ({1e3 * WAVE_DELAY / RATE_HZ:g} ms) earlier; "
        f"next states",
    ),
    MaskNet: (
        "One mask for all microphones, told the spectrum of the noise; it touches no phase",
        "`relative` (1, 4, 128): power of four spectra (256 samples every 128, root of Hann, bins 1 to "
        "128) over that "
        "of the noise, mean over microphones; `noise` (1, 128): mean power of the noise, of any level; "
        "states",
        "`mask` (1, 4, 128), 0 to 1, of the spectra three earlier: the cleaned sound comes "
        f"{MASK_DELAY} samples ({1e3 * MASK_DELAY / RATE_HZ:g} ms, one hop) late; next states",
    ),
}


def card(name: str, net: torch.nn.Module, facts: dict[str, Any], story: str) -> str:
    """What stands beside the file."""
    what, given, answer = WHAT[type(net)]
    return f"""# {name}

{what} ({facts["parameters"]:,} parameters, {facts["bytes"]:,} bytes).

- **Input** {given}.
- **Output** {answer}.
- **Array**: any; 10 kHz.
- **File**, 512 samples at a time, and trained network, all at once, agree within {facts["parity"]:.0e}.
- **Time** of one call for {MICS} microphones, one thread: {facts["call_ms"]:.2f} ms per 51.2 ms, where made.
{story}"""


def story(s: LabSettings, history: list[dict[str, float]]) -> str:
    """The card's lines on what a network was trained with."""
    steps = int(history[-1]["step"]) if history else 0
    best = min((row["validation"] for row in history), default=float("nan"))
    mixes = s.mixes
    return (
        f"- **Trained** for {steps:,} steps on mixes of {mixes.snr_db[0]:g} to {mixes.snr_db[1]:g} dB, "
        f"{mixes.clip_s:g} s "
        f"each; best validation loss {best:.3f}. Calls: "
        f"{'recordings' if mixes.calls else 'none recorded'}, and "
        f"synthesised; noise: {'recordings' if mixes.noise else 'synthesised rotors'}.\n"
        f"- **Held out**: noise {', '.join(mixes.held_out) or 'every fifth recording'}; of calls every "
        f"fifth recording"
        f"{' and all of ' + ', '.join(mixes.unheard) if mixes.unheard else ''}.\n"
    )
