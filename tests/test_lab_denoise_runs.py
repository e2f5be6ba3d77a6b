"""Denoisers in the workshop: small runs from sounds to a model, its report, and its tuning."""

from __future__ import annotations

import json

import numpy as np
import pytest
import soundfile
import torch
from conftest import SMALL

from locagen_edge.lab.cli import main
from locagen_edge.lab.denoise import bearings, evaluate, repeats
from locagen_edge.lab.denoise.callers import CALLERS
from locagen_edge.lab.denoise.publish import weights_of
from locagen_edge.lab.settings import read
from locagen_edge.settings import load
from locagen_edge.stages.denoise import MaskDenoiser

pytestmark = pytest.mark.usefixtures("few_sounds")
KINDS = ("wave", "mask")


def lab(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


@pytest.fixture(scope="module")
def runs(small, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    for kind in KINDS:
        assert lab("denoise", "train", kind, "--settings", small, "--out", out / kind) == 0
    return out


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_leaves_settings_curve_and_a_model_that_flies(kind: str, runs) -> None:
    names = {path.name for path in (runs / kind).iterdir()}
    assert names == {"settings.toml", "checkpoint.pt", "curve.json", "curve.png", "models"}
    curve = json.loads((runs / kind / "curve.json").read_text())
    assert [row["step"] for row in curve] == [3, 6]
    assert all(np.isfinite([row["training"], row["validation"]]).all() for row in curve)
    assert read(runs / kind / "settings.toml").mixes.pool == 8


def test_a_run_is_gone_on_with_and_others_are_refused(runs, small, tmp_path, capsys) -> None:
    more = tmp_path / "more.toml"
    more.write_text(SMALL.replace("pool = 8", "pool = 9"))
    assert lab("denoise", "train", "wave", "--settings", more, "--out", runs / "wave") == 1
    assert "pool = 8 there, pool = 9 asked for" in capsys.readouterr().err
    assert lab("denoise", "train", "wave", "--settings", small, "--out", runs / "wave") == 0
    assert len(json.loads((runs / "wave" / "curve.json").read_text())) == 2  # it was at its end
    out = tmp_path / "again"
    start = ("--start", runs / "wave", "--minutes", 0)
    assert lab("denoise", "train", "wave", "--settings", small, "--out", out, *start) == 0
    first, second = (weights_of("denoise-wave", x / "models") for x in (runs / "wave", out))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert lab("denoise", "train", "mask", "--settings", small, "--out", runs / "wave") == 1
    assert "is of a wave network" in capsys.readouterr().err


def test_training_lowers_the_loss(small, tmp_path) -> None:
    settings_ = tmp_path / "longer.toml"
    settings_.write_text(SMALL.replace("steps = 6\ncheck = 3", "steps = 60\ncheck = 20"))
    assert lab("denoise", "train", "wave", "--settings", settings_, "--out", tmp_path / "run") == 0
    curve = json.loads((tmp_path / "run" / "curve.json").read_text())
    assert curve[-1]["validation"] < curve[0]["validation"] - 0.02


def test_the_evaluation_tells_all(runs, small, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(evaluate, "SNRS_DB", (-5.0, 0.0))
    flown = tmp_path / "s.toml"
    flown.write_text(SMALL + f'[models]\ndirectory = "{runs / "wave" / "models"}"\n')
    out = tmp_path / "report"
    words = ("--settings", flown, "--kind", "wave", "--each", 1, "--out", out)
    assert lab("denoise", "evaluate", *words) == 0
    names = {path.name for path in out.iterdir()}
    assert names == {"report.md", "report.json", "by-snr.png", "waveforms.png", "spectra.png"}
    result = json.loads((out / "report.json").read_text())
    assert set(result["by_class"]["wave"]) == set(CALLERS)
    text = (out / "report.md").read_text()
    assert "nan" not in text
    assert all(f"({name})" in text for name in names if name.endswith(".png"))


def test_the_bearings_are_told(small, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(bearings, "BEFORE_S", 2.0)
    monkeypatch.setattr(bearings, "SNRS_DB", (30.0,))
    monkeypatch.setattr(repeats, "SNRS_DB", (30.0,))
    monkeypatch.setattr(repeats, "MINUTE_S", 20.0)
    out = tmp_path / "report"
    words = ("--settings", small, "--out", out, "--repeated", 1)
    assert lab("denoise", "evaluate", *words) == 1
    assert "goes with --bearings" in capsys.readouterr().err
    assert lab("denoise", "evaluate", *words, "--bearings", 1) == 0
    assert {path.name for path in out.iterdir()} == {"bearings.md", "bearings.json", "bearings.png"}
    result = json.loads((out / "bearings.json").read_text())
    fields = result["fields"]
    assert set(fields) == set(bearings.FIELDS)
    assert all(
        set(table) == set(bearings.METHODS) for lengths in fields.values() for table in lengths.values()
    )
    # no drone is as loud as this call, and PHAT needs no noise before
    assert all(lengths["1"]["PHAT"]["30"]["right"] == 1.0 for lengths in fields.values())
    assert all(
        table[method]["30"]["right"] == 1.0
        for lengths in result["repeated"]["fields"].values()
        for table in lengths.values()
        for method in repeats.METHODS
    )
    assert "nan" not in (out / "bearings.md").read_text()


def test_own_drone(runs, small, tmp_path, capsys) -> None:
    rng = np.random.default_rng(1)
    soundfile.write(tmp_path / "drone.wav", 0.1 * rng.standard_normal((80_000, 2)), 16_000)
    flown = tmp_path / "s.toml"
    flown.write_text(SMALL + f'[models]\ndirectory = "{runs / "mask" / "models"}"\n')
    words = ("--settings", flown, "--out", tmp_path / "own", "--steps", 3, "--each", 1)
    assert lab("denoise", "tune", tmp_path / "drone.wav", *words) == 0
    assert "held back" in capsys.readouterr().out
    names = {path.name for path in (tmp_path / "own").iterdir()}
    assert {"models", "flight.toml", "report.md", "report.json"} <= names
    flight = load(tmp_path / "own" / "flight.toml")
    assert (flight.denoise.kind, flight.denoise.mask) == ("mask", "denoise-mask-own")
    MaskDenoiser(flight)
    soundfile.write(tmp_path / "other.wav", 0.1 * rng.standard_normal(80_000), 16_000)
    soundfile.write(tmp_path / "muted.wav", np.zeros(80_000), 16_000)
    (tmp_path / "empty").mkdir()
    refused = {
        "none.wav": "neither a recording nor a folder",
        "s.toml": "cannot be read",
        "other.wav": "is tuned to other recordings",
        "muted.wav": "nothing but silence",
        "empty": "holds no .wav",
    }
    for noise, says in refused.items():
        assert lab("denoise", "tune", tmp_path / noise, *words) == 1
        assert says in capsys.readouterr().err
