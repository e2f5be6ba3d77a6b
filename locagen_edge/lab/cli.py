"""The workshop's command line. Exit codes: 0 done, 1 a failure said in one line, 2 wrong usage."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from locagen_edge.errors import LocagenError
from locagen_edge.lab.settings import LabSettings
from locagen_edge.settings import load


def main(argv: list[str] | None = None) -> None:
    """Entry point of `locagen-lab`."""
    arguments = _parser().parse_args(argv)
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

    train = commands.add_parser(
        "train",
        parents=[common],
        help="train a model of the paper and install it for the flight",
        description="Train a model of the paper and install it, with card and hash, into a directory. "
        'Fly it with bearing.estimator = "model:NAME" and models.directory.',
    )
    train.add_argument("name", metavar="NAME", help="a method's name; an unknown one lists them")
    train.add_argument("--directory", type=Path, required=True, metavar="DIR", help="where to install it")
    train.set_defaults(command=_train)
    return parser


def _settings(arguments: argparse.Namespace) -> LabSettings:
    return load(arguments.settings, LabSettings) if arguments.settings is not None else LabSettings()


def _paper(arguments: argparse.Namespace) -> int:
    settings = _settings(arguments)
    arguments.out.mkdir(parents=True, exist_ok=True)

    from tqdm import tqdm

    from locagen_edge.lab.experiments import EXPERIMENTS, QUICK, Scale, run
    from locagen_edge.lab.plots import draw_all
    from locagen_edge.lab.report import markdown

    with tqdm(
        total=len(EXPERIMENTS) + 1, unit="part", bar_format="{desc:<14} |{bar}| {n}/{total} {elapsed}"
    ) as bar:
        bar.set_description("by_rate")

        def step(name: str) -> None:
            if name != next(iter(EXPERIMENTS)):
                bar.update()
            bar.set_description(name)

        result = run(settings, QUICK if arguments.quick else Scale(), step)
        step("figures")
        draw_all(result, arguments.out)
        bar.update()
    (arguments.out / "report.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    (arguments.out / "report.md").write_text(markdown(result), encoding="utf-8")
    print(f"wrote {arguments.out / 'report.md'}")
    return 0


def _train(arguments: argparse.Namespace) -> int:
    from locagen_edge.lab.install import install_method

    line = install_method(arguments.name, _settings(arguments), arguments.directory)
    print(line)
    return 0


if __name__ == "__main__":
    main()
