"""The workshop's command line. Exit codes: 0 done, 1 a failure said in one line, 2 wrong usage."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path

from locagen_edge.errors import LocagenError, SettingsError
from locagen_edge.files import write
from locagen_edge.lab import dataset_cli, refine_cli
from locagen_edge.lab.denoise import cli as denoise_cli
from locagen_edge.lab.settings import OWN, PAPER, read


def main(argv: list[str] | None = None) -> None:
    """Entry point of `locagen-lab`."""
    words = sys.argv[1:] if argv is None else argv
    arguments = _parser().parse_args(words, argparse.Namespace(words=words))
    try:
        code = arguments.command(arguments)
    except LocagenError as error:
        for line in str(error).splitlines():
            print(f"locagen-lab: {line}", file=sys.stderr)
        code = 1
    except OSError as error:
        print(f"locagen-lab: {error.filename}: {error.strerror}", file=sys.stderr)
        code = 1
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="locagen-lab",
        description="The workshop of locagen-edge: trains models on the digital twin and repeats the paper.",
        epilog="Exit codes: 0 done, 1 a failure said in one line, 2 wrong usage.",
    )
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument(
        "--settings",
        type=Path,
        metavar="FILE",
        help="TOML settings with the workshop's sections (default: built in; "
        "`python -m locagen_edge.lab.settings` prints them)",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    paper = commands.add_parser(
        "paper",
        parents=[common],
        help="repeat the paper's experiments",
        description="Repeat the paper's experiments. Writes report.md, report.json and the figures as PNG. "
        "Takes some minutes.",
    )
    paper.add_argument("--out", type=Path, default=Path("paper-report"), metavar="DIR",
                       help="where to write (default: paper-report)")  # fmt: skip
    paper.add_argument("--quick", action="store_true", help="small data and few passes: shows that it works")
    paper.set_defaults(command=_paper)

    paper.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="NAME",
        help="this experiment alone, e.g. `waveforms`; may be given several times; an unknown one lists them",
    )

    train = commands.add_parser(
        "train",
        parents=[common],
        help="train a model for your own array, and all that it takes to fly it",
        description="Make the data for the array of the settings, train, evaluate on other seeds, export, "
        "install with card and hash. Writes report.md, report.json, error.png and flight.toml, the settings "
        "that fly the model. What the settings leave out: sound (dataset.level = waveforms) of 0 to 30 dB "
        "from 0 to 60 m below, 100,000 samples.",
    )
    train.add_argument("method", nargs="?", default="mlp-pairs", metavar="METHOD",
                       help="a method's name (default mlp-pairs); an unknown one lists them")  # fmt: skip
    train.add_argument("--out", type=Path, default=Path("my-model"), metavar="DIR",
                       help="where to write (default: my-model)")  # fmt: skip
    train.add_argument("--name", default="", help="of the model (default: the method's)")
    train.add_argument("--models", type=Path, metavar="DIR",
                       help="models directory to install into (default: models in --out)")  # fmt: skip
    train.add_argument("--data", type=Path, metavar="FOLDER",
                       help="learn from this data set, which `locagen-lab dataset` made of the same settings",
                       )  # fmt: skip
    train.add_argument("--level", help="arrivals or waveforms (default: dataset.level)")
    train.add_argument("--samples", type=int, help="how many to make (default: data.samples)")
    train.add_argument("--workers", type=int, default=1, help="processes that make data (default 1)")
    train.set_defaults(command=_train)
    evaluate = commands.add_parser(
        "evaluate",
        parents=[common],
        help="hold field recordings against the twin",
        description="Run labelled recordings through the pipeline that flies, and tell angle and distance "
        "differences beside what the twin predicts. Writes report.md, report.json and error.png. The folder "
        "holds recordings and labels.csv or labels.jsonl with the columns file, time_s, azimuth_deg (or lat, "
        "lon, array_lat, array_lon, heading_deg), and if known range_m, snr_db.",
    )
    evaluate.add_argument("--recordings", type=Path, required=True, metavar="FOLDER",
                          help="WAV or FLAC files, and their labels")  # fmt: skip
    evaluate.add_argument("--out", type=Path, default=Path("field-report"), metavar="DIR",
                          help="where to write (default: field-report)")  # fmt: skip
    evaluate.set_defaults(command=_evaluate)
    dataset_cli.add_command(commands)
    denoise_cli.add_command(commands, common)
    refine_cli.add_command(commands)
    return parser


def _paper(arguments: argparse.Namespace) -> int:
    settings = read(arguments.settings)

    from tqdm import tqdm

    from locagen_edge.lab.experiments import EXPERIMENTS, QUICK, Scale, run
    from locagen_edge.lab.plots import draw_all
    from locagen_edge.lab.report import markdown

    names = list(dict.fromkeys(arguments.only)) or list(EXPERIMENTS)
    unknown = [name for name in names if name not in EXPERIMENTS]
    if unknown:
        raise SettingsError(f"--only {unknown[0]}: is no experiment; there are {', '.join(EXPERIMENTS)}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tqdm(
        total=len(names) + 1, unit="part", bar_format="{desc:<14} |{bar}| {n}/{total} {elapsed}"
    ) as bar:
        bar.set_description(names[0])

        def step(name: str) -> None:
            if name != names[0]:
                bar.update()
            bar.set_description(name)

        result = run(settings, QUICK if arguments.quick else Scale(), step, names)
        step("figures")
        draw_all(result, arguments.out)
        bar.update()
    write(arguments.out / "report.json", json.dumps(result, indent=1) + "\n")
    write(arguments.out / "report.md", markdown(result))
    print(f"wrote {arguments.out / 'report.md'}")
    return 0


def _train(arguments: argparse.Namespace) -> int:
    # a data set that is there was made by `dataset`, whose defaults are the paper's
    settings = read(arguments.settings, PAPER if arguments.data else OWN)
    changed = {"samples": arguments.samples} if arguments.samples is not None else {}
    level = {"level": arguments.level} if arguments.level is not None else {}
    settings = dataclasses.replace(
        settings,
        data=dataclasses.replace(settings.data, **changed),
        dataset=dataclasses.replace(settings.dataset, **level),
    )

    from locagen_edge.lab import train
    from locagen_edge.lab.plots import draw, training

    result = train.fulfil(
        train.Order(
            method=arguments.method,
            name=arguments.name or arguments.method,
            settings=settings,
            out=arguments.out,
            data=arguments.data,
            models=arguments.models or arguments.out / "models",
            workers=max(arguments.workers, 1),
            made_by=" ".join(["locagen-lab", *arguments.words]),
        )
    )
    if result["by_snr"]:
        draw(arguments.out / "error.png", lambda axes: training(axes, result), (7, 4.2))
    write(arguments.out / "report.json", json.dumps(result, indent=1) + "\n")
    write(arguments.out / "report.md", train.markdown(result))
    print(train.line(result))
    print(f"wrote {arguments.out / 'report.md'}; fly it with --settings {arguments.out / 'flight.toml'}")
    return 0


def _evaluate(arguments: argparse.Namespace) -> int:
    settings = read(arguments.settings)

    from locagen_edge.lab import evaluate
    from locagen_edge.lab.plots import draw, field

    result = evaluate.evaluate(arguments.recordings, settings)
    arguments.out.mkdir(parents=True, exist_ok=True)
    if "bias_deg" in result["statistics"]:
        draw(arguments.out / "error.png", lambda axes: field(axes, result), (8, 4.2))
    write(arguments.out / "report.json", json.dumps(result, indent=1) + "\n")
    write(arguments.out / "report.md", evaluate.markdown(result))
    print(evaluate.line(result))
    print(f"wrote {arguments.out / 'report.md'}")
    return 0


if __name__ == "__main__":
    main()
