"""Training of either denoiser: AdamW, half the rate where the validation loss stands still, resumable.

A run is a folder: settings.toml, checkpoint.pt (all that is needed to go on), curve.json and curve.png.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from locagen_edge.errors import DatasetError
from locagen_edge.files import replacing, write
from locagen_edge.lab.denoise.mixes import Batch, Mixer
from locagen_edge.lab.denoise.sounds import corpus
from locagen_edge.lab.nets.mask import LOOKAHEAD, MaskNet
from locagen_edge.lab.nets.wave import STRIDE, WaveNet
from locagen_edge.lab.settings import FitSettings, LabSettings, MaskSettings, WaveSettings
from locagen_edge.stages.denoise import STEP, WINDOW, window

CLIP_NORM = 1.0
VALIDATION = 96
"""mixes, the same at every validation"""
LEVELS_DB = (-50.0, -12.0)
"""of mixtures, below full scale, for the waveform network, which hears how loud it is"""

Loss = Callable[[torch.nn.Module, Batch], torch.Tensor]


@dataclass(frozen=True)
class Kind:
    """One of the two denoisers."""

    settings: Callable[[LabSettings], Any]
    net: Callable[[Any], torch.nn.Module]
    loss: Callable[[Any], Loss]


# --- what is minimised --------------------------------------------------------------------------------


def si_snr_db(output: torch.Tensor, clean: torch.Tensor) -> torch.Tensor:
    """(batch,): power of the clean sound in the output over that of the rest of the output."""
    gain = gain_of(output, clean).unsqueeze(1)
    rest = output - gain * clean
    power = (gain * clean).square().sum(dim=1)
    ratio_db: torch.Tensor = 10.0 * torch.log10((power + 1e-8) / (rest.square().sum(dim=1) + 1e-8))
    return ratio_db


def gain_of(output: torch.Tensor, clean: torch.Tensor) -> torch.Tensor:
    """(batch,): how much of the clean sound the output holds."""
    gain: torch.Tensor = (output * clean).sum(dim=1) / (clean.square().sum(dim=1) + 1e-8)
    return gain


def wave_loss(s: WaveSettings) -> Loss:
    """The paper's: 20 % SI-SNR and 80 % mean absolute error.

    SI-SNR counts in dB and the error in units of the clean sound's mean absolute value, so the SI-SNR
    decides what is heard and the error how loud it is. The other way round, with SI-SNR in units of 10 dB,
    the network learns to be silent where it is in doubt (a gain of 0.7 on the call at 0 dB, and classes
    that it deletes). Mixes without a call count with the error alone, in units of the mixture.
    """

    def loss(net: torch.nn.Module, batch: Batch) -> torch.Tensor:
        low, high = LEVELS_DB
        level = 10.0 ** (torch.empty(len(batch.call), 1).uniform_(low, high) / 20.0)
        mixture = batch.mixture[:, 0]
        level = level / mixture.square().mean(dim=1, keepdim=True).sqrt()
        sound = mixture * level
        assert isinstance(net, WaveNet)
        output = net(sound, *net.start(len(sound)))[0][:, STRIDE:] / level
        clean = batch.call[:, :-STRIDE]
        calling = clean.square().sum(dim=1) > 0.0
        unit = torch.where(calling, clean.abs().mean(dim=1), mixture.abs().mean(dim=1))
        error = (output - clean).abs().mean(dim=1) / unit
        snr = torch.where(calling, si_snr_db(output, clean), torch.zeros_like(unit))
        total: torch.Tensor = (-s.si_snr_share * snr + (1.0 - s.si_snr_share) * error).mean()
        return total

    return loss


def mask_loss(s: MaskSettings) -> Loss:
    """SI-SDR of the resynthesised first microphone, and that the call keeps its loudness.

    How loud counts by the call's share of the mixture: under loud noise it would teach the mask to stay open.

    A mix without a call has to become silent: its level against the input counts, in the same unit of 10 dB,
    down to -30 dB.
    """
    taper = torch.from_numpy(window().astype(np.float32))

    def loss(net: torch.nn.Module, batch: Batch) -> torch.Tensor:
        assert isinstance(net, MaskNet)
        spectra = torch.fft.rfft(batch.mixture.unfold(2, WINDOW, STEP) * taper)
        relative = (spectra.abs().square() / (batch.reference.unsqueeze(2) + 1e-12)).mean(dim=1)
        noise = batch.reference.mean(dim=1)
        mask = net(relative[..., 1:], noise[:, 1:], *net.start(len(relative)))[0][:, LOOKAHEAD:]
        masked = spectra[:, 0, : mask.shape[1], 1:] * mask
        pieces = torch.fft.irfft(torch.nn.functional.pad(masked, (1, 0))) * taper
        output = (pieces[:, 1:, :STEP] + pieces[:, :-1, STEP:]).reshape(len(mask), -1)
        clean = batch.call[:, STEP : STEP + output.shape[1]]
        sound = batch.mixture[:, 0, STEP : STEP + output.shape[1]]
        calling = clean.square().sum(dim=1) > 0.0
        share = clean.square().sum(dim=1) / sound.square().sum(dim=1)
        lost = share.clamp(max=1.0) * (1.0 - gain_of(output, clean)).square()
        kept = -si_snr_db(output, clean) / 10.0 + s.gain_weight * lost
        silent = torch.log10(output.square().sum(dim=1) / sound.square().sum(dim=1) + 1e-3)
        return torch.where(calling, kept, 0.3 * silent).mean()

    return loss


KINDS: dict[str, Kind] = {
    "wave": Kind(lambda s: s.wave, WaveNet, wave_loss),
    "mask": Kind(lambda s: s.mask, MaskNet, mask_loss),
}


# --- the run ------------------------------------------------------------------------------------------


def fit(
    kind: str, s: LabSettings, folder: Path, training: Mixer, validation: Mixer, seconds: float = math.inf,
    start: dict[str, Any] | None = None,
) -> torch.nn.Module:  # fmt: skip
    """Trains, or goes on with the run in `folder`; returns the network with the best validation loss.

    `start`: weights to begin with. Ends after the settings' steps, or `seconds` of this call.
    """
    chosen = KINDS[kind]
    fs: FitSettings = chosen.settings(s)
    torch.set_num_threads(fs.threads)
    torch.manual_seed(fs.seed)
    net = chosen.net(fs)
    if start is not None:
        net.load_state_dict(start)
    loss_of = chosen.loss(fs)
    optimiser = torch.optim.AdamW(net.parameters(), lr=fs.rate)
    schedule = torch.optim.lr_scheduler.ReduceLROnPlateau(optimiser, factor=0.5, patience=fs.patience)
    step, best, weights, curve = 0, math.inf, net.state_dict(), []
    path = folder / "checkpoint.pt"
    if path.exists():
        kept = _read(path, kind)
        net.load_state_dict(kept["net"])
        optimiser.load_state_dict(kept["optimiser"])
        schedule.load_state_dict(kept["schedule"])
        step, best, weights, curve = kept["step"], kept["best"], kept["weights"], kept["curve"]
    held = [validation.batch(fs.batch) for _ in range(max(VALIDATION // fs.batch, 1))]
    began, losses = time.monotonic(), []
    torch.manual_seed(fs.seed + step)
    if not curve:
        best = _validate(net, loss_of, held)
        weights = {name: value.clone() for name, value in net.state_dict().items()}
    with tqdm(
        total=fs.steps,
        initial=step,
        unit="step",
        bar_format="{desc} |{bar}| {n}/{total} {elapsed}<{remaining}",
    ) as bar:
        while step < fs.steps and time.monotonic() - began < seconds:
            net.train()
            loss = loss_of(net, training.batch(fs.batch))
            if torch.isfinite(loss):
                optimiser.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                torch.nn.utils.clip_grad_norm_(net.parameters(), CLIP_NORM)
                optimiser.step()
                losses.append(float(loss.detach()))
            step += 1
            bar.update()
            last = step >= fs.steps or time.monotonic() - began >= seconds
            if step % fs.check and not last:
                continue
            error = _validate(net, loss_of, held)
            schedule.step(error)
            if error < best:
                best = error
                weights = {name: value.clone() for name, value in net.state_dict().items()}
            curve.append({
                "step": step, "training": float(np.mean(losses or [math.nan])), "validation": error,
                "rate": optimiser.param_groups[0]["lr"],
            })  # fmt: skip
            losses = []
            bar.set_description(f"{kind} {error:.3f} best {best:.3f} rate {curve[-1]['rate']:.1e}")
            with replacing(path) as temporary:
                torch.save({
                    "kind": kind, "net": net.state_dict(), "optimiser": optimiser.state_dict(), "step": step,
                    "schedule": schedule.state_dict(), "best": best, "weights": weights, "curve": curve,
                }, temporary)  # fmt: skip
            write(folder / "curve.json", json.dumps(curve, indent=1) + "\n")
    net.load_state_dict(weights)
    return net.eval()


def _validate(net: torch.nn.Module, loss_of: Loss, held: list[Batch]) -> float:
    net.eval()
    state = torch.get_rng_state()
    torch.manual_seed(0)  # the same levels every time
    with torch.no_grad():
        error = float(np.mean([float(loss_of(net, batch)) for batch in held]))
    torch.set_rng_state(state)
    return error


def mixers(s: LabSettings) -> tuple[Mixer, Mixer]:
    """For training and for validation."""
    held = corpus(s, "validate")
    training = Mixer(s, corpus(s, "train"), 1, s.mixes.pool, s.mixes.alter)
    return training, Mixer(s, held, 2, max(s.mixes.pool // 4, 4), s.mixes.alter)


def network(kind: str, s: LabSettings, folder: Path) -> torch.nn.Module:
    """The best network of a run. Raises `DatasetError` where the folder holds none of this kind."""
    chosen = KINDS[kind]
    net = chosen.net(chosen.settings(s))
    net.load_state_dict(_read(folder / "checkpoint.pt", kind)["weights"])
    return net.eval()


def _read(path: Path, kind: str) -> dict[str, Any]:
    try:
        kept: dict[str, Any] = torch.load(path, weights_only=True)
    except Exception as error:
        raise DatasetError(f"{path}: is no checkpoint that can be gone on with: {error}") from error
    if kept.get("kind") != kind:
        raise DatasetError(f"{path}: is of a {kept.get('kind')} network, not of {kind}; use another folder")
    return kept
