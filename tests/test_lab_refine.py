"""The network on the steered estimator's map: what it starts from, what it learns, and how it is judged."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from locagen_edge.geometry import wrap
from locagen_edge.lab import refine
from locagen_edge.lab.cli import main
from locagen_edge.lab.export import answers_of, to_onnx
from locagen_edge.lab.settings import LabSettings
from locagen_edge.types import Bearing

ROWS, COLUMNS = 4, 40
AXIS = np.arange(COLUMNS, dtype=np.float32) * np.float32(2.0 * math.pi / COLUMNS)


def bearing(azimuth: float) -> Bearing:
    return Bearing(azimuth, 0.02, -0.4, 0.05, 0.0, "steered")


@given(st.integers(-80, 80), st.floats(-3.0, 3.0), st.integers(0, 2**31))
def test_features_do_not_know_which_way_the_array_looks(steps: int, azimuth: float, seed: int) -> None:
    scores = np.random.default_rng(seed).random((ROWS, COLUMNS), dtype=np.float32) * 500.0
    step = 2.0 * math.pi / COLUMNS
    if abs(abs(azimuth / step % 1.0 - 0.5)) < 1e-3:  # between two columns either may be the middle one
        return
    here = refine.features(AXIS, scores, bearing(azimuth))
    there = refine.features(AXIS, np.roll(scores, steps, axis=1), bearing(wrap(azimuth + steps * step)))
    np.testing.assert_allclose(here, there, atol=1e-4)


def made(n: int, seed: int) -> refine.Calls:
    """An estimator that is off by twice its sigma where the first feature is 1, and else as it says."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, 12)).astype(np.float32)
    x[:, 0] = rng.integers(2, size=n)
    sigma = rng.uniform(0.01, 0.03, (n, 2))
    off = sigma * (2.0 * x[:, :1] + rng.standard_normal((n, 2)))
    return refine.Calls(x, off, sigma, n)


def test_untrained_it_is_the_estimator_itself() -> None:
    data = made(50, 1)
    after = refine.refined(refine.Refiner(data.x), data)
    np.testing.assert_allclose(after.off, data.off, atol=1e-12)
    np.testing.assert_allclose(after.sigma, data.sigma, rtol=1e-12)


def test_it_learns_a_bias_that_shows_and_says_how_sure_it_is() -> None:
    after = refine.refined(refine.fit(made(4000, 1), 1), asked := made(2000, 2))
    before, now = (refine.told(c.off[:, 0], c.sigma[:, 0]) for c in (asked, after))
    # |N(0 or 2, 1)| has the median 1.25, |N(0, 1)| 0.67; both are measured on 2000
    assert now["median_deg"] < 0.65 * before["median_deg"]
    assert now["within"][0] == pytest.approx(0.683, abs=0.05)
    assert now["within"][1] == pytest.approx(0.954, abs=0.03)


def test_the_file_answers_as_the_network_does() -> None:
    data = made(600, 3)
    net = refine.fit(data, 3)
    content = to_onnx(net, torch.from_numpy(data.x[:1]), "features", "correction")
    with torch.no_grad():
        wanted = net.eval()(torch.from_numpy(data.x[:40])).numpy()
    np.testing.assert_allclose(answers_of(content, data.x[:40]), wanted, atol=1e-5)


def test_a_verdict_needs_more_than_chance() -> None:
    rng = np.random.default_rng(4)
    error = np.abs(rng.standard_normal(400))
    assert refine.verdict(*refine._interval(error, error)) == "no different"
    assert refine.verdict(*refine._interval(error, 0.7 * error)) == "better"
    assert refine.verdict(*refine._interval(error, 1.4 * error)) == "worse"


def test_calls_are_of_their_seed_and_a_free_field_is_found_within_its_sigmas() -> None:
    s = LabSettings()
    some, again, others = (
        refine.calls(s, refine.KINDS["free field"], 12, seed, (7,), 1) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(some.x, again.x)
    assert not np.array_equal(some.off, others.off)
    assert some.offered == 12
    assert len(some.x) >= 10
    assert np.median(np.abs(some.off[:, 0]) / some.sigma[:, 0]) < 1.5


def test_a_second_caller_is_another_sound_from_elsewhere() -> None:
    s = LabSettings()
    alone = refine.calls(s, refine.KINDS["free field"], 6, 1, (7,), 1)
    together = refine.calls(s, dataclasses.replace(refine.KINDS["two callers"], second_db=0.0), 6, 1, (7,), 1)
    shared = min(len(alone.x), len(together.x))
    assert not np.allclose(alone.off[:shared], together.off[:shared])


def test_too_few_calls_are_refused(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["refine", "--calls", "3", "--out", str(tmp_path)])
    assert ended.value.code == 1
    assert "--calls 3: at least 50" in capsys.readouterr().err
