"""`locagen-lab paper --quick` writes everything, with sane numbers; the analysis of variance is sound."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from locagen_edge.lab.anova import two_way
from locagen_edge.lab.cli import main
from locagen_edge.lab.plots import FIGURES


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> tuple:
    folder = tmp_path_factory.mktemp("paper") / "out"
    with pytest.raises(SystemExit) as ended:
        main(["paper", "--quick", "--out", str(folder)])
    assert ended.value.code == 0
    return folder, json.loads((folder / "report.json").read_text())


def test_all_files_are_there(report) -> None:
    folder, _ = report
    names = {path.name for path in folder.iterdir()}
    assert names == {"report.md", "report.json", *(f"{name}.png" for name in FIGURES)}
    for name in FIGURES:
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    text = (folder / "report.md").read_text()
    for name in FIGURES:
        assert f"({name}.png)" in text
    assert "nan" not in text


def test_numbers_are_sane(report) -> None:
    _, result = report
    slow, fast = result["by_rate"]["10000"], result["by_rate"]["48000"]
    assert slow["best possible"]["mae_deg"] == pytest.approx(6.7, rel=0.05)
    assert fast["best possible"]["mae_deg"] == pytest.approx(1.44, rel=0.05)
    for row in (slow, fast):
        best = row["best possible"]["mae_deg"]
        # the table of 200,000 draws and the test of 20,000 leave 1 % between them
        assert all(method["mae_deg"] > best * 0.99 for method in row.values())
    assert slow["minimiser"]["mae_deg"] > 25.0
    assert slow["siren-unscaled"]["mae_deg"] == pytest.approx(90.0, abs=6.0)
    assert set(result["paper"]["mae_deg"]["10000"]) <= set(slow)


def test_half_the_spacing_gives_the_paper_s_angles(report) -> None:
    _, result = report
    half = result["assumptions"]["readings"]["half the spacing"]
    told = result["paper"]
    assert half["distinct_angles"] == told["distinct_angles"]
    assert half["forest-12"] == pytest.approx(told["mae_deg"]["10000"]["forest-12"], rel=0.05)
    assert half["best_48k_deg"] == pytest.approx(told["mae_deg"]["48000"]["mlp"], rel=0.05)
    assert result["assumptions"]["readings"]["as described, common clock"]["best_10k_deg"] < 7.0


def test_distributions_add_up(report) -> None:
    _, result = report
    for share in result["distribution"]["histogram"].values():
        assert sum(share) == pytest.approx(1.0, abs=1e-6)
    for curve in result["distribution"]["cdf_deg"].values():
        assert np.all(np.diff(curve) >= 0.0)


def test_wrong_usage_and_faults_are_told_in_words(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["paint"])
    assert ended.value.code == 2
    settings = tmp_path / "lab.toml"
    settings.write_text("[twin]\nsnr_db = nan\nrange_m = -1.0\n")
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(["paper", "--settings", str(settings), "--out", str(tmp_path / "out")])
    assert ended.value.code == 1
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(":")[1].strip() for line in lines] == ["twin.range_m", "twin.snr_db"]
    assert not (tmp_path / "out").exists()
    with pytest.raises(SystemExit) as ended:
        main(["paper", "--only", "waves", "--out", str(tmp_path / "out")])
    assert ended.value.code == 1
    assert "there are by_rate, waveforms," in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_one_experiment_alone(tmp_path) -> None:
    """Sub-sample delays from sound at 10 kHz and 10 dB; the full run has 0.49 degrees from 24,000 frames."""
    settings = tmp_path / "lab.toml"
    settings.write_text("[mlp]\nrate = 0.01\nbatch = 64\n")
    options = ["--settings", str(settings), "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        main(["paper", "--quick", "--only", "waveforms", *options])
    assert ended.value.code == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"report.md", "report.json", "from-waveforms.png"}
    plain, windy = json.loads((tmp_path / "out" / "report.json").read_text())["waveforms"]["mae_deg"].values()
    assert plain["MLP, all pairs, sub-sample"] < 0.6
    assert plain["MLP, whole-sample delays"] > 4.5
    # 0.13 by the bound's formula, 0.40 with microphones 1 mm off
    assert (
        plain["bound, sound alone"]
        < plain["bound, microphones displaced"]
        < plain["least squares, sub-sample"]
    )
    assert windy["MLP, whole-sample, filtered"] < 0.6 * windy["MLP, whole-sample delays"]
    # the flight's correlation has its own band
    for row in (plain, windy):
        assert row["MLP, sub-sample, filtered"] == pytest.approx(row["MLP, sub-sample delays"], rel=0.25)


def test_analysis_of_variance_finds_what_is_there_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    y = rng.standard_normal((4, 5, 50))
    y += np.arange(4)[:, None, None]
    first, second, both = two_way(y)
    assert first < 1e-10
    assert second > 0.01
    assert both > 0.01
    # with one level of the second factor left out of account it is the one-way analysis of the means
    one_way = stats.f_oneway(*y.reshape(4, -1)).pvalue
    assert one_way < 1e-10


def test_p_values_of_nothing_are_uniform() -> None:
    rng = np.random.default_rng(2)
    p = np.array([two_way(rng.standard_normal((3, 4, 6))) for _ in range(500)])
    # Kolmogorov-Smirnov for each of three; a fixed seed, so no test in a hundred fails
    for column in p.T:
        assert stats.kstest(column, "uniform").pvalue > 0.01
