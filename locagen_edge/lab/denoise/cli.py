"""`locagen-lab denoise train | evaluate | tune`."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from locagen_edge.errors import DatasetError
from locagen_edge.files import write
from locagen_edge.lab.settings import LabSettings, read
from locagen_edge.settings import sample

KINDS = ("wave", "mask")
TUNE_STEPS = 300


def add_command(subparsers: Any, common: argparse.ArgumentParser) -> None:
    """Adds `denoise` to what `argparse.ArgumentParser.add_subparsers` gave."""
    parser = subparsers.add_parser(
        "denoise",
        help="train, evaluate or tune a denoiser",
        description="Networks that take the rotors out of the sound and leave the caller: train them from "
        "any folders of sounds, judge them beside their peers, tune one to your own drone.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    sounds = argparse.ArgumentParser(add_help=False, parents=[common])
    sounds.add_argument(
        "--calls",
        type=Path,
        metavar="FOLDER",
        help="clean sounds, a folder below for each class (default: mixes.calls; none: synthesised)",
    )

    train = commands.add_parser(
        "train", parents=[sounds], help="train a network, or go on with a run that was cut off",
        description="Train the paper's waveform network (wave) or the mask that serves the bearing (mask). "
        "The run's folder holds settings.toml, checkpoint.pt, curve.png, and at the end models/.",
    )  # fmt: skip
    train.add_argument("kind", choices=KINDS)
    train.add_argument("--noise", type=Path, metavar="FOLDER",
                       help="noise without calls (default: mixes.noise; none: rotors)")  # fmt: skip
    train.add_argument(
        "--out", type=Path, default=Path("denoise-run"), metavar="DIR", help="the run's folder"
    )
    train.add_argument(
        "--minutes", type=float, default=math.inf, help="stop after this time; the same command goes on"
    )
    train.add_argument("--start", type=Path, metavar="DIR", help="begin with the best weights of another run")
    train.set_defaults(command=_train)

    evaluate = commands.add_parser(
        "evaluate", parents=[sounds], help="judge denoisers beside their peers",
        description="Score the installed denoisers, Wiener filters and the packages that are there, on "
        "recordings and drones that were held out. Writes report.md, report.json and figures.",
    )  # fmt: skip
    evaluate.add_argument(
        "--noise", type=Path, metavar="FOLDER", help="noise without calls (default: mixes.noise)"
    )
    evaluate.add_argument(
        "--out", type=Path, default=Path("denoise-report"), metavar="DIR", help="where to write"
    )
    evaluate.add_argument("--each", type=int, default=6, help="calls of every class (default 6)")
    evaluate.add_argument("--kind", choices=KINDS, action="append", default=[], help="this network alone")
    evaluate.add_argument(
        "--tuned",
        type=Path,
        metavar="DIR",
        help="what `tune` wrote, in a folder for each drone that has its name in mixes.held_out",
    )
    evaluate.add_argument(
        "--bearings",
        type=int,
        metavar="EVENTS",
        help="instead: the share of so many calls whose direction the whole pipeline finds with each; writes "
        "bearings.md, bearings.json and a figure (60: an hour of one core)",
    )
    evaluate.add_argument(
        "--repeated",
        type=int,
        metavar="CALLERS",
        help="with --bearings, besides: the share of so many callers, each of whom calls five times in a "
        "minute, whose direction is told at the end (20: a quarter of an hour of one core)",
    )
    evaluate.add_argument("--processes", type=int, default=1, help="processes for --bearings (default 1)")
    evaluate.set_defaults(command=_evaluate)

    tune = commands.add_parser(
        "tune", parents=[sounds], help="tune the mask to your own drone",
        description="Tune the installed mask network on a minute of your own drone's noise (a file or a "
        "folder, "
        "no calls in it). Part of it is held back and tells what the tuning is worth. Writes models/, "
        "flight.toml, "
        "report.md.",
    )  # fmt: skip
    tune.add_argument("noise", type=Path, help="recording of the drone, or a folder of them")
    tune.add_argument("--out", type=Path, default=Path("my-drone"), metavar="DIR", help="where to write")
    tune.add_argument("--steps", type=int, default=TUNE_STEPS, help=f"training steps (default {TUNE_STEPS})")
    tune.add_argument("--each", type=int, default=3, help="calls of every class in the judgement (default 3)")
    tune.set_defaults(command=_tune)


def _settings(arguments: argparse.Namespace, noise: Path | None) -> LabSettings:
    s = read(arguments.settings)
    given = {"calls": arguments.calls, "noise": noise}
    for name, folder in given.items():
        if folder is not None and not folder.exists():
            raise DatasetError(f"--{name}: {folder} is not there")
    mixes = dataclasses.replace(
        s.mixes, calls=str(arguments.calls or s.mixes.calls), noise=str(noise or s.mixes.noise)
    )
    return dataclasses.replace(s, mixes=mixes)


def _train(arguments: argparse.Namespace) -> int:
    s, out, kind = _settings(arguments, arguments.noise), arguments.out, arguments.kind
    _same_run(s, out)

    from locagen_edge.lab.denoise import fit, publish, report

    out.mkdir(parents=True, exist_ok=True)
    write(out / "settings.toml", sample(s))
    start = fit.network(kind, s, arguments.start).state_dict() if arguments.start else None
    net = fit.fit(kind, s, out, *fit.mixers(s), seconds=60.0 * arguments.minutes, start=start)
    history = json.loads((out / "curve.json").read_text()) if (out / "curve.json").exists() else []
    if history:
        report.curve(history, out / "curve.png")
    facts = publish.publish(f"denoise-{kind}", net, out / "models", s, publish.story(s, history))
    print(
        f"{facts['parameters']:,} parameters, {facts['call_ms']:.2f} ms a hop; file and network agree within "
        f"{facts['parity']:.0e}"
    )
    print(f"wrote {out / 'models'}; judge it with: locagen-lab denoise evaluate --kind {kind}, "
          f"models.directory = \"{out / 'models'}\" in its settings")  # fmt: skip
    return 0


def _same_run(s: LabSettings, out: Path) -> None:
    """Raises `DatasetError` where the folder's run has other settings."""
    path = out / "settings.toml"
    if path.exists() and (out / "checkpoint.pt").exists() and read(path) != s:
        there, asked = (sample(x).splitlines() for x in (read(path), s))
        differ = [f"{a} there, {b} asked for" for a, b in zip(there, asked, strict=False) if a != b]
        raise DatasetError(
            f"{out}: is a run with other settings: {'; '.join(differ[:3])}; choose another --out"
        )


def _evaluate(arguments: argparse.Namespace) -> int:
    s = _settings(arguments, arguments.noise)
    if arguments.bearings is None and arguments.repeated is not None:
        raise DatasetError("--repeated: goes with --bearings EVENTS")
    if arguments.bearings is not None:
        return _bearings(arguments, s)

    from locagen_edge.lab.denoise import evaluate, report
    from locagen_edge.lab.denoise.publish import models_in
    from locagen_edge.lab.denoise.tune import NAME

    makers = {
        "wave": lambda: evaluate.wave_method(s.denoise.wave, s),
        "mask": lambda: evaluate.mask_method(s.denoise.mask, s),
    }
    methods = {kind: makers[kind]() for kind in arguments.kind or KINDS}
    tuned = {}
    if arguments.tuned:
        for folder in sorted(path for path in arguments.tuned.iterdir() if (path / "models").is_dir()):
            tuned[folder.name] = evaluate.mask_method(NAME, models_in(s, folder / "models"))
    result = evaluate.evaluate(s, methods, tuned, max(arguments.each, 1))
    report.save(result, evaluate.examples(s, methods[list(methods)[-1]]), arguments.out)
    for name in result["ours"]:
        at_0 = result["by_snr"][name]["0"]
        print(f"{name}: noise removed at 0 dB {at_0['nr']:.1%}, gain on the call {at_0['gain']:.2f}")
    print(f"wrote {arguments.out / 'report.md'}")
    return 0


def _bearings(arguments: argparse.Namespace, s: LabSettings) -> int:
    from locagen_edge.lab.denoise import bearings, repeats, report

    processes = max(arguments.processes, 1)
    result = bearings.evaluate(s, max(arguments.bearings, 1), processes)
    if arguments.repeated is not None:
        result["repeated"] = repeats.evaluate(s, max(arguments.repeated, 1), processes)
    report.save_bearings(result, arguments.out)
    print(f"wrote {arguments.out / 'bearings.md'}")
    return 0


def _tune(arguments: argparse.Namespace) -> int:
    s = _settings(arguments, None)
    s = dataclasses.replace(
        s,
        mask=dataclasses.replace(
            s.mask, steps=arguments.steps, rate=1e-3, check=max(arguments.steps // 6, 1), patience=1
        ),
        mixes=dataclasses.replace(s.mixes, pool=min(s.mixes.pool, 150)),
    )

    from locagen_edge.lab.denoise import tune

    result = tune.tune(s, arguments.noise, arguments.out, max(arguments.each, 1))
    write(arguments.out / "report.json", json.dumps(result, indent=1) + "\n")
    write(arguments.out / "report.md", tune.markdown(result))
    print(tune.line(result))
    print(f"wrote {arguments.out / 'report.md'}; fly it with --settings {arguments.out / 'flight.toml'}")
    return 0
