"""Own array, own twin: one command from settings to a model that flies by the settings that go with it."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import soundfile
from scenes import heard

from locagen_edge import cli
from locagen_edge.lab.cli import main
from locagen_edge.lab.samples import best_deg, draw, mean_error_deg, of_columns
from locagen_edge.lab.settings import OWN, LabSettings, read
from locagen_edge.lab.triangulation import least_squares
from locagen_edge.lab.twin import with_twin
from locagen_edge.models import read_manifest
from locagen_edge.settings import load

SQUARE = """
[array]
positions_m = [[0.03, 0.03, 0], [-0.03, 0.03, 0], [-0.03, -0.03, 0], [0.03, -0.03, 0]]

[environment]
temperature_c = -5.0

[audio]
rate_hz = 16000

[mlp]
width = 16
epochs = 25
rate = 0.01
"""


def lab(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    (folder / "square.toml").write_text(SQUARE)
    code = lab(
        "train", "--settings", folder / "square.toml", "--out", folder / "out", "--name", "square",
        "--samples", 6000,
    )  # fmt: skip
    assert code == 0
    return folder


def test_another_array_has_its_model_report_and_settings(own) -> None:
    out = own / "out"
    names = {path.name for path in out.iterdir()}
    assert names == {"data", "models", "report.md", "report.json", "error.png", "flight.toml"}
    result = json.loads((out / "report.json").read_text())
    assert result["parity"] <= 1e-5
    assert result["trained_on"] == 6000
    at_10 = result["by_snr"]["10"]
    # of 6,000 samples: not far from least squares, which nothing beats by much
    assert at_10["best possible"] < at_10["least squares"] < at_10["model"] < 2.0 * at_10["least squares"]
    text = (out / "report.md").read_text()
    assert "nan" not in text
    assert "(error.png)" in text
    (entry,) = read_manifest(out / "models").values()
    card = (out / "models" / entry["card"]).read_text()
    assert "at 16000 Hz" in card
    assert "height_span_m 60.0" in card


def test_its_flight_settings_replay_at_once(own, tmp_path, capsys) -> None:
    flight = load(own / "out" / "flight.toml")
    assert flight.bearing.estimator == "model:square"
    assert (flight.audio.rate_hz, flight.environment.temperature_c) == (16000, -5.0)
    sound = heard(flight, np.radians(57.0), -0.3, 20.0, 32_000)
    soundfile.write(tmp_path / "call.wav", sound.T, 16_000, subtype="PCM_16")
    with pytest.raises(SystemExit) as ended:
        cli.main(["replay", str(tmp_path / "call.wav"), "--settings", str(own / "out" / "flight.toml")])
    assert not ended.value.code
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {line["estimator"] for line in lines} == {"model:square"}
    assert np.median([line["azimuth_deg"] for line in lines]) == pytest.approx(57.0, abs=1.5)


def test_its_data_are_kept_and_gone_on_with(own, capsys) -> None:
    before = {path: path.stat().st_mtime_ns for path in (own / "out" / "data").iterdir()}
    options = ("--settings", own / "square.toml", "--out", own / "out", "--samples", 6000)
    assert lab("train", "forest-12", *options, "--name", "trees") == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert set(read_manifest(own / "out" / "models")) == {"square", "trees"}
    capsys.readouterr()
    # the same folder with other settings: refused by name
    assert lab("train", *options[:-1], 7000) == 1
    assert "data.samples: 6000 there, 7000 asked for" in capsys.readouterr().err


def test_a_data_set_of_other_settings_is_refused_by_key(own, tmp_path, capsys) -> None:
    options = ("--settings", own / "square.toml", "--level", "arrivals", "--samples", 1000)
    assert lab("dataset", tmp_path / "set", *options) == 0
    ours = (*options, "--data", tmp_path / "set", "--out", tmp_path / "out")
    assert lab("train", "forest-12", *ours) == 0
    (tmp_path / "warm.toml").write_text(SQUARE.replace("-5.0", "30.0"))
    capsys.readouterr()
    assert lab("train", "--settings", tmp_path / "warm.toml", *ours[2:]) == 1
    errors = capsys.readouterr().err.splitlines()
    assert errors[1:] == ["locagen-lab: environment.temperature_c: -5.0 there, 30.0 asked for"]
    assert lab("train", *ours[:2], *ours[4:]) == 0  # dataset.level is arrivals by default there


def test_a_model_of_another_array_does_not_fly(own, tmp_path, capsys) -> None:
    flight = (own / "out" / "flight.toml").read_text().replace("0.03, 0.03, 0.0", "0.05, 0.03, 0.0")
    (tmp_path / "flight.toml").write_text(flight)
    soundfile.write(tmp_path / "call.wav", np.zeros((16_000, 4)), 16_000)
    with pytest.raises(SystemExit):
        cli.main(["replay", str(tmp_path / "call.wav"), "--settings", str(tmp_path / "flight.toml")])
    assert "trained for another array" in capsys.readouterr().err


def test_what_cannot_be_trained_is_refused_before_any_work(tmp_path, capsys) -> None:
    for words, says in (
        (("oracle",), "method oracle: is unknown; there are forest-12"),
        (("--name", "No Good"), "bearing.estimator: 'model:No Good'"),
        (("--samples", "3"), "data.samples: 3 samples is outside"),
        (("--settings", str(tmp_path / "none.toml")), "none.toml: cannot be read"),
    ):
        assert lab("train", *words, "--out", tmp_path / "out") == 1
        assert says in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_file_has_its_own_defaults_and_its_keys_go_first(tmp_path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text("[twin]\nsnr_db = 3.0\n")
    assert read(path, OWN).twin.snr_db == 3.0
    assert read(path, OWN).twin.noise == "snr"
    assert read(path).twin.noise == "none"
    assert read(None) == LabSettings()
    path.write_text(SQUARE + "[twin]\noffset_samples = [0.0, 0.1, 0.2, 0.3]\n")
    found = read(path)
    assert found.audio.channel_map == (0, 1, 2, 3)
    assert found.scene.gain_db == (0.0,) * 4
    assert found.twin.offset_samples == (0.0, 0.1, 0.2, 0.3)


@pytest.mark.parametrize("level", ["arrivals", "waveforms"])
def test_heights_over_a_span_are_heard_at_both_levels(level) -> None:
    """Delays shrink with the elevation's cosine, which tells how high the array was."""
    s = with_twin(read(None, OWN), height_span_m=100.0, position_error_m=0.0, rounding="none", noise="none")
    s = dataclasses.replace(s, dataset=dataclasses.replace(s.dataset, level=level))
    data = draw(s, 1500, 3)
    longest = s.mic_array.longest_delay_s(s.speed_m_s)
    horizontal = np.hypot(*data.position_m)
    # over the pairs sum tau^2 = 1.5 (d cos(el) / c)^2 for the equilateral triangle
    cosine = np.sqrt((data.true_delay_s.astype(float) ** 2).sum(axis=0) / 1.5) / longest
    height = horizontal * np.sqrt(np.maximum(1.0 / cosine**2 - 1.0, 0.0))
    far = horizontal > 20.0
    assert 0.0 <= height[far].min() < 5.0
    assert 95.0 < height[far].max() < 101.0
    assert np.median(height[far]) == pytest.approx(50.0, abs=6.0)


def test_frames_before_the_call_and_silence_are_not_learned_from() -> None:
    read_ = {
        "delay_s": np.arange(12.0, dtype=np.float32).reshape(2, 2, 3),
        "true_delay_s": np.zeros((2, 3), np.float32),
        "position_m": np.array([[1.0, 2, 3], [4, 5, 6]], np.float32),
        "azimuth_rad": np.array([0.1, 0.2], np.float32),
        "calling": np.array([[False, True], [True, True]]),
    }
    found = of_columns(read_)
    assert found.delay_s.T.tolist() == [[3, 4, 5], [6, 7, 8], [9, 10, 11]]
    assert found.azimuth_rad.tolist() == pytest.approx([0.1, 0.2, 0.2])
    assert found.position_m.T.tolist() == [[1, 2], [4, 5], [4, 5]]


def test_no_answer_counts_as_a_guess() -> None:
    s = read(None)
    data = draw(s, 400, 1)
    data.delay_s[:, :200] = np.nan
    assert 45.0 < mean_error_deg(least_squares(s), data) < 55.0


def test_least_squares_is_close_to_the_best_possible_where_nothing_is_rounded() -> None:
    s = with_twin(read(None), rounding="none", noise="snr", snr_db=10.0)
    data = draw(s, 20_000, 1)
    best, found = best_deg(s, data), mean_error_deg(least_squares(s), data)
    # of three independent arrivals least squares of a plane wave is the best there is, but for callers within
    # a few metres; 20,000 samples tell 1 %
    assert found == pytest.approx(best, rel=0.03)
