"""What is mixed: clean calls by class, noise by recording, from folders or synthesised; and who is held out.

    calls     FOLDER/CLASS/*.wav; classes that the folder lacks are synthesised (CALLERS)
    noise     FOLDER/**/*.wav: drones by pattern, the rest is background; without a folder rotors are made

The split is by recording and by drone, never by window: every fifth recording of a class, and the noise
recordings named by `mixes.held_out` (or every fifth of them), are heard in the evaluation only; the next
fifth of the calls validates. Synthesised sounds are split by seed.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from fnmatch import fnmatch
from itertools import islice
from pathlib import Path

import numpy as np
import soundfile
import soxr

from locagen_edge.errors import DatasetError
from locagen_edge.highpass import BLOCK, HighPass
from locagen_edge.lab.denoise.callers import CALLERS
from locagen_edge.lab.recordings import load
from locagen_edge.lab.settings import LabSettings
from locagen_edge.sim.rotors import rotor
from locagen_edge.stages.denoise import HIGH_PASS_HZ, STEP
from locagen_edge.types import F32

SYNTHESISED = 120
"""utterances of each class that has no recordings"""
ROTORS = 24
"""synthesised drones, where there are no recordings"""
SENTENCES = (
    "help", "help me please", "I am over here", "is anybody there", "my leg is broken", "call a doctor",
    "down here by the river", "we are three people", "hello, hello", "over here, can you see us",
)  # fmt: skip
VOICES = ("en-us", "de", "fr", "es", "it", "pl", "hi", "tr")
PARTS = ("train", "validate", "test")

Sounds = dict[str, list[F32]]
"""By class or name, each (n,), high-passed."""


@dataclass(frozen=True, eq=False)
class Corpus:
    """One part of all sounds."""

    calls: Sounds
    """by class"""
    drones: dict[str, F32]
    """by recording"""
    background: list[F32]


def corpus(s: LabSettings, part: str) -> Corpus:
    """The sounds of one of PARTS. Raises `DatasetError` where a folder holds nothing that can be used."""
    calls = {
        name: sounds
        for name, sounds in _calls(s, part).items()
        if sounds and (part == "test" or name not in s.mixes.unheard)
    }
    drones, background = _noise(s, part)
    return Corpus(calls, drones, background)


def high_passed(s: LabSettings, sound: F32) -> F32:
    """The part that counts, by the very filter that flies."""
    padded = np.pad(sound, (0, -len(sound) % BLOCK))
    return HighPass(HIGH_PASS_HZ, s.audio.rate_hz, 1)(padded[np.newaxis])[0, : len(sound)]


# --- calls --------------------------------------------------------------------------------------------


def _calls(s: LabSettings, part: str) -> Sounds:
    found: Sounds = {}
    if s.mixes.calls:
        by_class: dict[str, list[F32]] = {}
        for name, sound in load(s.mixes.calls, s.audio.rate_hz):
            by_class.setdefault(name.split("/")[0] if "/" in name else "other", []).append(sound)
        found = {
            name: [high_passed(s, sound) for k, sound in enumerate(sounds) if _part_of(k) == part]
            for name, sounds in by_class.items()
        }
    for name, make in CALLERS.items():
        if name not in found:
            found[name] = _synthesised(s, name, make, part)
    return found


def _synthesised(s: LabSettings, name: str, make: object, part: str) -> list[F32]:
    if name == "speech" and shutil.which("espeak-ng"):
        return [high_passed(s, x) for k, x in enumerate(_espeak(s.audio.rate_hz)) if _part_of(k) == part]
    assert callable(make)
    rate_hz = s.audio.rate_hz
    count = SYNTHESISED if part == "train" else SYNTHESISED // 4
    seeds = np.random.SeedSequence([s.mixes.seed, PARTS.index(part), *name.encode()]).spawn(count)
    length = round(s.mixes.clip_s * rate_hz)
    sounds = (make(length, float(rate_hz), 0.47 * rate_hz, np.random.default_rng(seed)) for seed in seeds)
    return [high_passed(s, np.asarray(sound, dtype=np.float32)) for sound in sounds]


def _espeak(rate_hz: int) -> list[F32]:
    """Every sentence by some voices, raised in pitch as callers do."""
    sounds = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "voice.wav"
        for k, sentence in enumerate(SENTENCES):
            for voice in VOICES[k % 2 :: 2]:
                words = ["espeak-ng", "-v", voice, "-p", str(40 + 7 * k), "-w", str(path), sentence]
                if subprocess.run(words, capture_output=True, check=False).returncode == 0:
                    sound, file_hz = soundfile.read(path, dtype="float32")
                    sounds.append(np.asarray(soxr.resample(sound, file_hz, rate_hz), dtype=np.float32))
    return sounds


def _part_of(k: int) -> str:
    return {0: "test", 1: "validate"}.get(k % 5, "train")


# --- noise --------------------------------------------------------------------------------------------


def _noise(s: LabSettings, part: str) -> tuple[dict[str, F32], list[F32]]:
    """Drones and backgrounds of a part. Validation hears the drones of the training, in other mixes."""
    if not s.mixes.noise:
        return _rotors(s, part), []
    found = recordings(s)
    names = [name for name in found if any(fnmatch(name, pattern) for pattern in s.mixes.drones)]
    held = {name for k, name in enumerate(names) if is_held_out(s, name, k)}
    background = [sound for name, sound in found.items() if name not in names]
    drones = {name: found[name] for name in names if (name in held) == (part == "test")}
    if not drones:
        raise DatasetError(
            f"mixes.noise: {s.mixes.noise} has no recording of a drone to {part} with that lasts "
            f"{_shortest(s) / s.audio.rate_hz:.3g} s or more; see mixes.drones and mixes.held_out"
        )
    return drones, background


def recordings(s: LabSettings) -> dict[str, F32]:
    """All noise recordings that are long enough for some noise before a call, high-passed."""
    found = load(s.mixes.noise, s.audio.rate_hz)
    return {name: high_passed(s, sound) for name, sound in found if len(sound) >= _shortest(s)}


def is_held_out(s: LabSettings, name: str, k: int) -> bool:
    """Whether the k-th recording of a drone is for the evaluation only."""
    return any(fnmatch(name, pattern) for pattern in s.mixes.held_out) if s.mixes.held_out else k % 5 == 0


def own_parts(s: LabSettings, sounds: list[F32]) -> tuple[list[F32], list[F32]]:
    """One drone's recordings, to tune on and to judge by: of four or more recordings every fourth is held
    back, of fewer the end of each, a quarter of it and at least enough for one mix.

    Raises `DatasetError` where that leaves nothing to tune on.
    """
    if len(sounds) >= 4:
        return [x for k, x in enumerate(sounds) if k % 4 != 1], sounds[1::4]
    needed = round((s.mixes.before_s + s.mixes.clip_s) * s.audio.rate_hz) + 2 * STEP
    cuts = [len(x) - max(len(x) // 4, needed) for x in sounds]
    tuned = [x[:cut] for x, cut in zip(sounds, cuts, strict=True) if cut >= _shortest(s)]
    if not tuned:
        seconds = (needed + _shortest(s)) / s.audio.rate_hz
        raise DatasetError(f"noise: a recording of at least {seconds:.1f} s is needed; a minute is better")
    return tuned, [x[cut:] for x, cut in zip(sounds, cuts, strict=True) if cut >= _shortest(s)]


def _shortest(s: LabSettings) -> int:
    return round((s.mixes.before_s + 0.5 * s.mixes.clip_s) * s.audio.rate_hz)


def _rotors(s: LabSettings, part: str) -> dict[str, F32]:
    """Drones of four rotors, each at its own throttle, one after the other in every part."""
    rate_hz = s.audio.rate_hz
    wanted = [k for k in range(ROTORS) if (k % 4 == 0) == (part == "test")]
    return {f"rotors-{k}": high_passed(s, _four(s, k, 10 * rate_hz)) for k in wanted}


def _four(s: LabSettings, k: int, n: int) -> F32:
    rng = np.random.default_rng([s.mixes.seed, k])
    throttle = rng.uniform(0.25, 0.8)
    total = np.zeros(n)
    for _ in range(4):
        made = rotor(throttle, float(s.audio.rate_hz), 0.47 * s.audio.rate_hz, rng)
        total += np.concatenate(list(islice(made, n // 7000 + 2)))[:n]
    return total.astype(np.float32)
