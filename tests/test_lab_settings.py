"""The workshop's settings: read from one file, and impossible parameters refused all at once, by name."""

from __future__ import annotations

import dataclasses
import math

import pytest

from locagen_edge.errors import SettingsError
from locagen_edge.lab.settings import LabSettings, triangle
from locagen_edge.lab.twin import at_rate, noise_s, with_spacing, with_twin
from locagen_edge.settings import from_table, load, sample


def faults(table: dict) -> list[str]:
    with pytest.raises(SettingsError) as caught:
        from_table(table, LabSettings)
    return [line.partition(":")[0] for line in str(caught.value).splitlines()]


def test_the_sample_file_is_the_defaults(tmp_path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(sample(LabSettings()))
    assert load(path, LabSettings) == LabSettings()


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ({"array": {"positions_m": [[0.0, 0, 0], [0.1, 0, 0]]}}, "array.positions_m"),
        ({"array": {"positions_m": [[0.1, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]}}, "array.positions_m"),
        ({"array": {"positions_m": [[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]}}, "array.positions_m"),
        ({"audio": {"rate_hz": 8000}}, "correlation.band_hz"),  # the band ends at 4700 Hz
        ({"audio": {"rate_hz": 0}}, "audio.rate_hz"),
        ({"twin": {"snr_db": math.nan}}, "twin.snr_db"),
        ({"twin": {"snr_db": "loud"}}, "twin.snr_db"),
        ({"environment": {"temperature_c": -300.0}}, "environment.temperature_c"),
        ({"twin": {"rounding": "up"}}, "twin.rounding"),
        ({"twin": {"range_m": 0.0}}, "twin.range_m"),
        ({"twin": {"offset_samples": [0.0, 0.0]}}, "twin.offset_samples"),
        ({"twin": {"position_error_m": 0.06}}, "twin.position_error_m"),
        ({"forest": {"trees": 0}}, "forest.trees"),
        ({"forest": {"trees": 1.5}}, "forest.trees"),
        ({"mlp": {"rate": math.inf}}, "mlp.rate"),
        ({"siren": {"omega": -1.0}}, "siren.omega"),
        ({"twins": {}}, "twins"),
        ({"twin": {"colour": 1}}, "twin.colour"),
    ],
)
def test_what_cannot_be_is_refused_by_name(table, key) -> None:
    assert key in faults(table)


def test_all_faults_are_told_at_once() -> None:
    table = {
        "array": {"positions_m": [[0.0, 0, 0], [0.0, 0, 0]]},
        "audio": {"rate_hz": 100},
        "environment": {"temperature_c": -274.0},
        "twin": {"snr_db": math.nan, "phase": "lunar"},
        "mlp": {"width": 0},
    }
    wanted = {f"{section}.{key}" for section, keys in table.items() for key in keys}
    assert wanted <= set(faults(table))


def test_other_rates_and_spacings_keep_the_rest() -> None:
    s = with_spacing(at_rate(with_twin(LabSettings(), range_m=50.0), 48000), 1.0)
    assert (s.audio.rate_hz, s.twin.range_m) == (48000, 50.0)
    assert s.mic_array.spacing_m == pytest.approx(1.0)
    assert s.array.positions_m == triangle(1.0)


def test_noise_is_none_a_number_or_what_the_snr_leaves() -> None:
    def of(**keys: object) -> float:
        return noise_s(with_twin(LabSettings(), **keys))

    assert of() == 0.0
    assert of(noise="fixed", noise_us=4.0) == pytest.approx(4e-6)
    assert of(noise="snr", snr_db=10.0) > of(noise="snr", snr_db=20.0) > 0.0
    # at high SNR the bound goes with 1 / sqrt(SNR)
    ratio = of(noise="snr", snr_db=40.0) / of(noise="snr", snr_db=60.0)
    assert ratio == pytest.approx(10.0, rel=1e-3)


def test_settings_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        LabSettings().twin.range_m = 1.0  # type: ignore[misc]
