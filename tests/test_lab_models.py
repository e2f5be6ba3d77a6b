"""The paper's models: features, readings of bins, nearness to the best possible, parity, use by name."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import onnxruntime
import pytest
import torch

from locagen_edge.errors import ModelError
from locagen_edge.geometry import direction
from locagen_edge.lab.bound import best_table, look_up, mae_deg
from locagen_edge.lab.export import answers_of, install
from locagen_edge.lab.features import Features, normalised
from locagen_edge.lab.forest import Forest
from locagen_edge.lab.methods import METHODS, split, take, train
from locagen_edge.lab.nets.siren import siren
from locagen_edge.lab.settings import LabSettings
from locagen_edge.lab.triangulation import fixed_start, flight, least_squares, over_cells
from locagen_edge.lab.twin import at_rate, sample, with_twin
from locagen_edge.stages.bearing import make_estimator
from locagen_edge.stages.bearing.hyperbolic import hyperbolic
from locagen_edge.types import Tdoa

SMALL = dataclasses.replace(
    LabSettings(),
    forest=dataclasses.replace(LabSettings().forest, trees=8),
    mlp=dataclasses.replace(LabSettings().mlp, epochs=2, width=16),
    siren=dataclasses.replace(LabSettings().siren, epochs=2, width=16),
)


def feature_rows(delays: list[list[float]]) -> np.ndarray:
    features = Features(3, np.zeros(2, np.float32), np.full(2, 0.5, np.float32))
    return features(torch.tensor(delays)).numpy()


def test_features_are_standardised_base_delays_and_their_ratio() -> None:
    found = feature_rows([[0.5, 0.25, -0.25], [-0.1, 0.2, 0.3]])
    np.testing.assert_allclose(found, [[1.0, 0.5, 0.5], [-0.2, 0.4, -2.0]], rtol=1e-6)


def test_a_ratio_to_zero_is_zero_and_one_to_almost_zero_is_bounded() -> None:
    found = feature_rows([[0.0, 0.7, 0.7], [0.0, 0.0, 0.0], [1e-4, 0.7, 0.7], [-1e-4, 0.7, 0.7]])
    np.testing.assert_allclose(found[:, 2], [0.0, 0.0, 10.0, -10.0])


def test_normalised_delays_are_shares_of_the_longest() -> None:
    s = LabSettings()
    along = s.mic_array.delays_s(
        direction(math.pi / 2), s.speed_m_s
    )  # microphones 1 and 2 stand left and right
    found = normalised(along.astype(np.float32)[:, None], s.mic_array, s.speed_m_s)
    np.testing.assert_allclose(found, [[-0.5, 0.5, 1.0]], atol=1e-5)  # positions are rounded to 1 um


@pytest.mark.parametrize("rate", [10_000, 48_000])
def test_forest_and_networks_come_within_2_percent_of_the_best_possible(rate) -> None:
    s = at_rate(LabSettings(), rate)
    learned, _ = split(sample(s, s.data.samples, 1), s.data.train_share)
    large, test = sample(s, 1_000_000, 5), sample(s, 100_000, 2)
    best = mae_deg(
        look_up(best_table(large.delay_s, large.azimuth_rad, rate), test.delay_s, rate), test.azimuth_rad
    )
    for name in ("forest", "mlp", "siren"):
        azimuths = over_cells(train(name, s, learned).azimuths, rate)
        assert mae_deg(azimuths(test.delay_s), test.azimuth_rad) < best * 1.02, name


def test_bins_lose_half_a_bin_and_their_mean_direction_gets_it_back_at_10_khz() -> None:
    s = LabSettings()
    learned, test = sample(s, 19_200, 1), sample(s, 100_000, 2)
    mae = {}
    for name in ("forest-24", "forest-24-mean", "forest-24-median", "forest"):
        azimuths = over_cells(train(name, s, learned).azimuths, 10_000)
        mae[name] = mae_deg(azimuths(test.delay_s), test.azimuth_rad)
    assert mae["forest-24"] > 7.3
    for name in ("forest-24-mean", "forest-24-median"):
        assert mae[name] == pytest.approx(mae["forest"], rel=0.02)


def test_readings_of_known_probabilities() -> None:
    probability = np.array([[0.0, 1.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.5]])  # bins of 90 degrees from 0

    def degrees(reading: str) -> np.ndarray:
        forest = Forest(LabSettings().forest, 4, reading)
        forest._model = type("Fitted", (), {"classes_": np.arange(4)})()
        y = forest._read(probability)
        return np.degrees(np.arctan2(y[:, 1], y[:, 0]))

    assert degrees("centre")[0] == pytest.approx(135.0)
    np.testing.assert_allclose(degrees("mean"), [135.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(degrees("median"), [135.0, 0.0], atol=0.25)


def test_unscaled_siren_is_off_by_a_right_angle() -> None:
    s = LabSettings()
    learned, test = sample(s, 5_000, 1), sample(s, 5_000, 2)
    azimuths = train("siren-unscaled", s, learned).azimuths
    assert mae_deg(azimuths(test.delay_s), test.azimuth_rad) == pytest.approx(90.0, abs=5.0)


def test_sines_begin_with_arguments_of_unit_spread() -> None:
    torch.manual_seed(1)
    s = dataclasses.replace(LabSettings().siren, width=512, layers=3, omega=30.0, omega_hidden=30.0)
    model = siren(3, s)
    x = 2.0 * torch.rand(4096, 3) - 1.0
    for number, layer in enumerate(model[:-1]):
        argument = layer.omega * layer.linear(x)
        if number:  # the article's figure 2: the arguments of hidden sines are normal with spread 1
            assert argument.std().item() == pytest.approx(1.0, rel=0.15)
        x = layer(x)


def test_same_seed_same_model() -> None:
    learned = sample(SMALL, 2_000, 1)
    for name in ("mlp", "siren", "forest-12"):
        first, second = (train(name, SMALL, learned).azimuths(learned.delay_s) for _ in range(2))
        np.testing.assert_array_equal(first, second)


def test_training_stops_early_and_keeps_the_best_pass() -> None:
    s = dataclasses.replace(SMALL, mlp=dataclasses.replace(SMALL.mlp, epochs=200, patience=2))
    history = train("mlp", s, sample(s, 500, 1)).history
    assert history is not None
    assert len(history.validation_deg) < 200
    assert history.validation_deg[history.best_epoch] == min(history.validation_deg)


@pytest.mark.parametrize("name", list(METHODS))
@pytest.mark.parametrize("rounding", ["nearest", "none"])
def test_exported_models_say_what_the_trained_ones_say(name, rounding) -> None:
    s = with_twin(SMALL, rounding=rounding)
    learned, test = sample(s, 2_000, 1), sample(s, 100, 2)
    trained = train(name, s, learned)
    x = normalised(test.delay_s, s.mic_array, s.speed_m_s)
    answers = answers_of(trained.onnx(), x)
    assert answers.shape == (100, 2)
    found = np.arctan2(answers[:, 1], answers[:, 0].astype(np.float64))
    off = np.abs(np.angle(np.exp(1j * (found - trained.azimuths(test.delay_s)))))
    off *= np.minimum(np.hypot(*answers.T), 1.0)  # to the error of the components, which an angle magnifies
    # equally good angles of a median may be told apart by the last bit: its grid is 0.25 degrees
    assert off.max() < (0.009 if name.endswith("median") else 1e-5)


def test_trees_decide_alike_right_on_their_thresholds() -> None:
    """scikit-learn's are double precision, ONNX's single: the next numbers on both sides go the same ways."""
    rng = np.random.default_rng(1)
    x = rng.standard_normal((2_000, 3)).astype(np.float32)
    forest = Forest(SMALL.forest, 12).fit(x, rng.uniform(-3.0, 3.0, 2_000).astype(np.float32))
    rows = []
    for tree in (fitted.tree_ for fitted in forest._model.estimators_):
        for node in np.flatnonzero(tree.feature >= 0)[:60]:
            at = np.float32(tree.threshold[node])
            for value in (at, np.nextafter(at, np.float32(9)), np.nextafter(at, np.float32(-9))):
                row = x[len(rows)].copy()
                row[tree.feature[node]] = value
                rows.append(row)
    seen = np.array(rows)
    content = forest._trees(3).SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    found = np.concatenate([session.run(None, {"features": row[None]})[1] for row in seen])
    np.testing.assert_allclose(found, forest._model.predict_proba(seen), atol=1e-5)


def test_installed_model_flies_by_its_name(tmp_path) -> None:
    s = LabSettings()
    learned, _ = split(sample(s, s.data.samples, 1), s.data.train_share)
    install("forest", train("forest", s, learned).onnx(), s.mic_array.positions_m, "# forest\n", tmp_path)
    s = dataclasses.replace(
        LabSettings(),
        models=dataclasses.replace(LabSettings().models, directory=str(tmp_path)),
        bearing=dataclasses.replace(LabSettings().bearing, estimator="model:forest"),
    )
    estimate = make_estimator(s)
    test = sample(s, 200, 9)
    off = []
    for delay, truth in zip(test.delay_s.T, test.azimuth_rad, strict=True):
        bearing = estimate(Tdoa(delay.astype(np.float64), np.full(3, 4e-5), np.ones(3)))
        assert bearing.estimator == "model:forest"
        off.append(abs(math.remainder(bearing.azimuth_rad - float(truth), 2 * math.pi)))
    assert math.degrees(np.mean(off)) < 8.0  # 6.7 and three standard errors of 200 samples


def test_an_unknown_method_is_refused_with_the_names_of_all() -> None:
    with pytest.raises(ModelError, match="forest-24-mean"):
        train("oracle", SMALL, sample(SMALL, 100, 1))


# --- methods that learn nothing -----------------------------------------------------------------------


def test_least_squares_finds_plane_waves_from_everywhere() -> None:
    s = LabSettings()
    azimuth = np.linspace(-3.1, 3.1, 50)
    delays = np.array([s.mic_array.delays_s(direction(a), s.speed_m_s) for a in azimuth]).T.astype(np.float32)
    np.testing.assert_allclose(least_squares(s)(delays), azimuth, atol=1e-5)


def test_minimiser_from_the_middle_agrees_with_the_flight_s_solver() -> None:
    s = with_twin(LabSettings(), rounding="none", position_error_m=0.0, range_m=2.0)
    data = sample(s, 40, 4)
    data = take(data, np.hypot(*data.position_m) > 0.2)  # outside the array, where the solver looks
    solved = flight(s, hyperbolic(s))(data.delay_s)
    wrong = np.abs(np.angle(np.exp(1j * (solved[0] - data.azimuth_rad))))
    # two hyperbolas may cross twice: near the array a second place can explain the same two delays
    assert np.quantile(wrong, 0.9) < 1e-5
    found = fixed_start(s, (0.0, 0.0))(data.delay_s)
    off = np.abs(np.angle(np.exp(1j * (found[0] - solved[0]))))
    # BFGS ends where the gradient is below 1e-5 m, some degrees early for a source that it has to walk to
    assert np.degrees(np.median(off)) < 1.0


def test_a_minimiser_from_afar_misses_what_stands_behind_its_start() -> None:
    s = LabSettings()
    data = sample(s, 20_000, 4)
    mae = {}
    for start in (0.0, 10.0):
        solve = over_cells(fixed_start(s, (start, start)), 10_000)
        mae[start] = mae_deg(solve(data.delay_s)[0], data.azimuth_rad)
    assert mae[0.0] < 8.0
    assert mae[10.0] > 25.0


def test_cells_are_asked_once() -> None:
    s = LabSettings()
    asked = []

    def count(delay_s: np.ndarray) -> np.ndarray:
        asked.append(delay_s.shape[1])
        return least_squares(s)(delay_s)

    once = over_cells(count, 10_000)
    data = sample(s, 50_000, 1)
    np.testing.assert_allclose(once(data.delay_s), least_squares(s)(data.delay_s), atol=1e-12)
    once(take(data, slice(0, 1000)).delay_s)
    assert sum(asked) < 40
