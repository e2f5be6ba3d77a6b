"""The mask network tuned to one's own drone, and told how much that is worth on noise it was not tuned on."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from locagen_edge.errors import DatasetError
from locagen_edge.files import write
from locagen_edge.lab.denoise.cases import Case, case
from locagen_edge.lab.denoise.evaluate import CLASS_SNRS_DB, mask_method, run_cases
from locagen_edge.lab.denoise.fit import fit
from locagen_edge.lab.denoise.mixes import Mixer
from locagen_edge.lab.denoise.peers import Method, wiener
from locagen_edge.lab.denoise.publish import models_in, publish, weights_of
from locagen_edge.lab.denoise.sounds import Corpus, corpus, high_passed, own_parts
from locagen_edge.lab.recordings import load, read_sound
from locagen_edge.lab.settings import LabSettings
from locagen_edge.models import directory_of
from locagen_edge.settings import Settings, sample
from locagen_edge.types import F32

NAME = "denoise-mask-own"
ALTER = 0.3
"""of what training on many drones does: the own drone flies faster and slower too, but stays the same drone
"""
EACH = 3
"""cases of every class in the judgement"""


def tune(s: LabSettings, noise: Path, out: Path, each: int = EACH) -> dict[str, Any]:
    """Tunes `denoise.mask` on the recordings and installs the result in out/models with out/flight.toml.

    Returns the report's numbers. Raises `DatasetError` where there is too little noise, or another drone's
    tuning in `out`.
    """
    sounds = own_recordings(s, noise)
    tuned_on, held = own_parts(s, sounds)
    _same_drone(out, sounds)
    base = weights_of(s.denoise.mask, directory_of(s))
    shape = base["enter.weight"].shape[0]
    s = dataclasses.replace(s, mask=dataclasses.replace(s.mask, width=shape, blocks=_blocks(base)))
    own = Corpus(corpus_of_calls(s, "train"), {str(k): sound for k, sound in enumerate(tuned_on)}, [])
    validation = Corpus(corpus_of_calls(s, "validate"), own.drones, [])
    pool = s.mixes.pool
    net = fit(
        "mask", s, out, Mixer(s, own, 11, pool, ALTER), Mixer(s, validation, 12, max(pool // 4, 4), ALTER),
        start=base,
    )  # fmt: skip
    net.load_state_dict(halfway(base, net.state_dict()))
    seconds = sum(len(x) for x in tuned_on) / s.audio.rate_hz
    story = (
        f"- **Tuned** from {s.denoise.mask} on {seconds:.0f} s of one drone's noise; made for that drone.\n"
    )
    facts = publish(NAME, net, out / "models", s, story)
    methods: dict[str, Method] = {
        "as it came": mask_method(s.denoise.mask, s),
        "tuned": mask_method(NAME, models_in(s, out / "models")),
        "Wiener, noise before": wiener,
    }
    result = {
        "tuned_on_s": seconds,
        "held_back_s": sum(len(x) for x in held) / s.audio.rate_hz,
        "facts": facts,
        **run_cases(list(_cases(s, held, each)), methods, CLASS_SNRS_DB),
    }
    flight = Settings(
        **{f.name: getattr(s, f.name) for f in dataclasses.fields(Settings)}
        | {
            "models": dataclasses.replace(s.models, directory=str((out / "models").resolve())),
            "denoise": dataclasses.replace(s.denoise, kind="mask", mask=NAME),
        }
    )
    write(out / "flight.toml", sample(flight))
    return result


def halfway(base: dict[str, Any], tuned: dict[str, Any]) -> dict[str, Any]:
    """Weights between those before and after tuning: seconds of one drone are soon learnt by heart, and what
    lies between two such networks is better on the noise of neither (Wortsman et al., "Robust fine-tuning of
    zero-shot models", CVPR 2022).
    """
    return {name: (base[name] + value) / 2 for name, value in tuned.items()}


def own_recordings(s: LabSettings, noise: Path) -> list[F32]:
    """Of a file or of a folder, high-passed."""
    if noise.is_dir():
        return [high_passed(s, sound) for _, sound in load(str(noise), s.audio.rate_hz)]
    if not noise.is_file():
        raise DatasetError(f"{noise}: is neither a recording nor a folder of them")
    sound = read_sound(noise, s.audio.rate_hz)
    if not sound.any():
        raise DatasetError(f"{noise}: nothing but silence; was the microphone muted?")
    return [high_passed(s, sound)]


def _same_drone(out: Path, sounds: list[F32]) -> None:
    """A run that was cut off is gone on with, but never with the sound of another drone."""
    digest = hashlib.sha256(b"".join(sound.tobytes() for sound in sounds)).hexdigest()
    kept = out / "noise.sha256"
    if (out / "checkpoint.pt").exists() and (not kept.exists() or kept.read_text().strip() != digest):
        raise DatasetError(f"{out}: is tuned to other recordings; choose another --out")
    out.mkdir(parents=True, exist_ok=True)
    write(kept, digest + "\n")


def corpus_of_calls(s: LabSettings, part: str) -> dict[str, list[F32]]:
    """Calls alone: the noise is the own drone's."""
    return corpus(dataclasses.replace(s, mixes=dataclasses.replace(s.mixes, noise="")), part).calls


def _cases(s: LabSettings, held: list[F32], each: int) -> Iterator[Case]:
    for kind, sounds in sorted(corpus_of_calls(s, "test").items()):
        rng = np.random.default_rng([s.mixes.seed, 77, *kind.encode()])
        for k in range(each):
            yield case(s, kind, "own", sounds[k % len(sounds)], held, rng)


def _blocks(weights: dict[str, Any]) -> int:
    return len({name.split(".")[1] for name in weights if name.startswith("blocks.")})


def markdown(result: dict[str, Any]) -> str:
    """What tuning was worth."""
    lines = [
        "# The mask network, tuned on one drone",
        "",
        f"Tuned on {result['tuned_on_s']:.0f} s of its noise, judged on {result['held_back_s']:.0f} s of "
        f"it that were "
        "held back, with calls that no training heard: SI-SDR improvement in dB (median over -5, 0, 5 dB) "
        "and gain on "
        "the call.",
        "",
        "| class | " + " | ".join(result["by_class"]) + " |",
        "| --- |" + " --- |" * len(result["by_class"]),
    ]
    for kind in result["classes"]:
        row = [result["by_class"][name][kind] for name in result["by_class"]]
        lines.append(
            f"| {kind} | " + " | ".join(f"{x['improvement_db']:.1f}, {x['gain']:.2f}" for x in row) + " |"
        )
    row = [result["by_snr"][name]["0"] for name in result["by_class"]]
    lines.append("| **NR at 0 dB** | " + " | ".join(f"{x['nr']:.0%}, {x['gain']:.2f}" for x in row) + " |")
    return "\n".join(lines) + "\n"


def line(result: dict[str, Any]) -> str:
    """The same in one line."""
    before, after = (result["by_snr"][name]["0"] for name in ("as it came", "tuned"))
    worth = "" if after["nr"] > before["nr"] else "; it brought nothing: fly the mask as it came"
    return (
        f"noise removed at 0 dB, on the {result['held_back_s']:.0f} s held back: {before['nr']:.0%} as it "
        f"came, "
        f"{after['nr']:.0%} tuned; gain on the call {before['gain']:.2f}, {after['gain']:.2f}{worth}"
    )
