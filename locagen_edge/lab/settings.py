"""The workshop's settings: those of the flight, the twin, and the hyper-parameters of every model.

One file holds them all, so a model is trained for the array, the air and the rate that will fly. The sample
file is `python -m locagen_edge.lab.settings`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from locagen_edge.errors import SettingsError
from locagen_edge.geometry import MicArray, equilateral
from locagen_edge.settings import Settings, from_table, sample, setting
from locagen_edge.sim.arrivals import TwinSettings
from locagen_edge.sim.rotors import hubs_m
from locagen_edge.sim.waveforms import RECORDED, SceneSettings

NEAREST_HUB_M = 0.02
"""A hub is not a point: nearer than this, 1 / r means nothing."""


@dataclass(frozen=True)
class DataSettings:
    """How much data the models are trained and tested on, drawn from the twin."""

    samples: int = setting(24000, "Samples; the paper's number.", unit="samples", least=100, most=100_000_000)
    train_share: float = setting(0.8, "Share to train on; the rest tests.", least=0.1, most=0.95)
    validation_share: float = setting(
        0.1,
        "Share of the training samples that decides when a network stops, and is not trained on.",
        least=0.01, most=0.5,
    )  # fmt: skip
    seed: int = setting(1, "Same seed, same data.", least=0, most=2**31 - 1)


@dataclass(frozen=True)
class DatasetSettings:
    """Data sets on disk."""

    level: str = setting(
        "arrivals",
        "What is simulated. `arrivals`: times alone, under [twin]. `waveforms`: sound, under [twin] and "
        "[scene], from which the flight's own correlation makes the delays.",
        choices=("arrivals", "waveforms"),
    )
    shard: int = setting(
        4096,
        "Samples in a file: what an interrupted run may lose, and what has to fit into memory at once.",
        unit="samples", least=1, most=10_000_000,
    )  # fmt: skip
    keep: tuple[str, ...] = setting(
        (),
        "What is kept of waveforms beside delays and truth. `correlation`: of all pairs, at all lags. "
        "`sound`: what the microphones recorded. `call`: the same without any noise.",
        choices=("correlation", "sound", "call"),
    )


@dataclass(frozen=True)
class ForestSettings:
    """Random forests: classifiers of azimuth bins, and the regression of cosine and sine."""

    trees: int = setting(100, "Trees.", least=1, most=10000)
    leaf: int = setting(
        3,
        "Fewest samples in a leaf. A cell of whole-sample delays is one point for a tree, so a small leaf "
        "costs nothing there; without rounding it is what smooths.",
        unit="samples", least=1, most=10000,
    )  # fmt: skip
    depth: int = setting(24, "Deepest tree.", unit="levels", least=1, most=64)
    samples_per_tree: int = setting(
        100_000, "Samples that one tree sees at most.", unit="samples", least=10, most=100_000_000
    )
    bins_deg: float = setting(
        0.0,
        "Where the first azimuth bin begins. The paper does not say; its figures ask for -15 with 12 bins.",
        unit="degrees",
        least=-180,
        most=180,
    )
    seed: int = setting(1, "Of bootstraps and splits.", least=0, most=2**31 - 1)


@dataclass(frozen=True)
class MlpSettings:
    """Multilayer perceptron from the features to the azimuth's cosine and sine."""

    width: int = setting(64, "Neurons in each hidden layer.", least=1, most=4096)
    layers: int = setting(2, "Hidden layers.", least=1, most=16)
    rate: float = setting(5e-3, "Highest learning rate of AdamW.", least=1e-7, most=1)
    batch: int = setting(512, "Samples in a step.", unit="samples", least=1, most=1_000_000)
    epochs: int = setting(60, "Passes over the data at most.", least=1, most=10000)
    patience: int = setting(
        15, "Passes without a better validation error before it stops.", unit="passes", least=1, most=10000
    )
    seed: int = setting(1, "Of weights and order.", least=0, most=2**31 - 1)


@dataclass(frozen=True)
class SirenSettings(MlpSettings):
    """SIREN: a perceptron whose activation is a sine (Sitzmann et al., NeurIPS 2020)."""

    rate: float = setting(2e-3, "Highest learning rate of AdamW.", least=1e-7, most=1)
    omega: float = setting(
        1.0,
        "Factor inside the first sine, for standardised inputs. The article's 30 is for the pixels of an "
        "image, whose detail is a thousandth of the input's range; bearings have none that fine.",
        least=0.01, most=10000,
    )  # fmt: skip
    omega_hidden: float = setting(
        1.0, "Factor inside the other sines; the weights start smaller by it.", least=0.01, most=10000
    )


@dataclass(frozen=True)
class FilterSettings:
    """The filter before the MLP after FFT filtering: bins of the frame's spectrum outside are set to zero."""

    band_hz: tuple[float, ...] = setting(
        (300.0, 4700.0), "Lowest and highest frequency that is kept.", unit="Hz", least=0, most=48000
    )


@dataclass(frozen=True)
class MixesSettings:
    """What denoisers learn from: calls and noise, mixed anew for every step."""

    calls: str = setting(
        "", "Folder of clean sounds, one folder below it for each class; empty: all classes are synthesised."
    )
    noise: str = setting("", "Folder of noise without calls; empty: rotors that follow throttle.")
    drones: tuple[str, ...] = setting(
        ("*",), "Patterns of the noise recordings that are drones; others are background to be added to them."
    )
    held_out: tuple[str, ...] = setting(
        (),
        "Patterns of noise recordings that are kept for evaluation, one pattern for each drone. Empty: every "
        "fifth recording, by name. Of calls every fifth recording of a class is kept.",
    )
    unheard: tuple[str, ...] = setting((), "Classes of calls that are for evaluation only.")
    snr_db: tuple[float, ...] = setting(
        (-15.0, 15.0), "Lowest and highest level of the call over the noise.", unit="dB", least=-60, most=60
    )
    clip_s: float = setting(2.25, "Length of a clip; the paper's.", unit="s", least=0.5, most=60)
    before_s: float = setting(
        2.5, "Noise alone before it, from which its spectrum is known.", unit="s", least=0.1, most=60
    )
    alter: float = setting(
        1.0,
        "How much noise recordings are altered in speed, colour and loudness: 1 makes other drones of "
        "them, for "
        "a network that has to meet unknown ones; less keeps known drones as they are.",
        least=0, most=1,
    )  # fmt: skip
    pool: int = setting(
        500, "Clips of each kind in memory; every step replaces some.", unit="clips", least=4, most=100_000
    )
    seed: int = setting(1, "Same seed, same mixes.", least=0, most=2**31 - 1)


@dataclass(frozen=True)
class FitSettings:
    """How a denoiser is trained: AdamW, and a smaller rate where the validation loss stands still."""

    width: int = setting(64, "Features between the layers.", least=4, most=1024)
    rate: float = setting(2e-3, "First learning rate of AdamW.", least=1e-7, most=1)
    batch: int = setting(16, "Clips in a step.", unit="clips", least=1, most=4096)
    steps: int = setting(4000, "Steps at most.", unit="steps", least=0, most=10_000_000)
    check: int = setting(100, "Steps between two validations.", unit="steps", least=1, most=1_000_000)
    patience: int = setting(
        3, "Validations without a better one before the rate is halved.", least=1, most=1000
    )
    threads: int = setting(1, "Threads to train with.", unit="threads", least=1, most=256)
    seed: int = setting(1, "Of the weights.", least=0, most=2**31 - 1)


@dataclass(frozen=True)
class WaveSettings(FitSettings):
    """The paper's denoiser, from waveform to waveform."""

    si_snr_share: float = setting(
        0.2,
        "Share of the SI-SNR in the loss, the paper's; the rest is the mean absolute error. SI-SNR counts in "
        "dB, the error in units of the clean sound's mean absolute value.",
        least=0, most=1,
    )  # fmt: skip


@dataclass(frozen=True)
class MaskSettings(FitSettings):
    """The denoiser that serves the bearing: one mask for all microphones, told the noise's spectrum."""

    width: int = setting(40, "Numbers that describe a band.", least=4, most=1024)
    blocks: int = setting(
        2, "Pairs of a recurrent layer over time and a dense one over bands.", least=1, most=8
    )
    batch: int = setting(12, "Clips in a step.", unit="clips", least=1, most=4096)
    rate: float = setting(3e-3, "First learning rate of AdamW.", least=1e-7, most=1)
    gain_weight: float = setting(
        4.0,
        "Weight of (1 - gain on the call)^2, times the call's share of the mixture, beside the SI-SDR in "
        "units of 10 dB.",
        least=0,
        most=1000,
    )


@dataclass(frozen=True)
class LabSettings(Settings):
    """All settings of the flight and of the workshop. Every section and every key may be left out."""

    twin: TwinSettings = TwinSettings()  # noqa: RUF009 - frozen
    scene: SceneSettings = SceneSettings()  # noqa: RUF009 - frozen
    data: DataSettings = DataSettings()
    dataset: DatasetSettings = DatasetSettings()
    forest: ForestSettings = ForestSettings()
    mlp: MlpSettings = MlpSettings()
    siren: SirenSettings = SirenSettings()
    filter: FilterSettings = FilterSettings()
    mixes: MixesSettings = MixesSettings()
    wave: WaveSettings = WaveSettings()
    mask: MaskSettings = MaskSettings()

    def __post_init__(self) -> None:
        faults: list[str] = []
        try:
            super().__post_init__()
        except SettingsError as error:
            faults += str(error).splitlines()
        faults += _faults_of_twin(self)
        faults += _faults_of_scene(self)
        faults += _faults_of_mixes(self)
        if faults:
            raise SettingsError("\n".join(faults))


def _faults_of_twin(s: LabSettings) -> Iterator[str]:
    mics = len(s.array.positions_m)
    flat = [row[:2] for row in s.array.positions_m if len(row) == 3]
    if mics < 3:
        yield f"array.positions_m: {mics} microphones, but a full azimuth needs three that are not in line"
    elif len(flat) == mics and np.isfinite(flat).all():
        across = np.linalg.matrix_rank(np.array(flat) - flat[0], tol=1e-3)
        if across < 2 and s.bearing.estimator not in ("far-field", "hyperbolic"):  # the others say so above
            yield "array.positions_m: the microphones are in line, and a full azimuth needs a plane"
    if len(s.twin.offset_samples) != mics:
        yield (
            f"twin.offset_samples: {len(s.twin.offset_samples)} offsets, "
            f"but array.positions_m has {mics} microphones"
        )
    largest = 0.5 * _smallest_spacing(s)
    if 0.0 < largest <= s.twin.position_error_m:
        yield (
            f"twin.position_error_m: {s.twin.position_error_m:g} m could put two microphones, "
            f"{2 * largest:.3g} m apart, at the same place"
        )


def _faults_of_scene(s: LabSettings) -> Iterator[str]:
    scene = s.scene
    if s.dataset.level == "waveforms" and s.twin.noise == "fixed":
        yield "twin.noise: `fixed` is an error of arrivals; dataset.level = waveforms knows `none` and `snr`"
    if not scene.sounds:
        yield "scene.sounds: is empty"
    if RECORDED in scene.sounds and not scene.recordings:
        yield "scene.recordings: is empty, but scene.sounds names recorded"
    if len(scene.throttle) != 2 or not scene.throttle[0] <= scene.throttle[1]:
        yield f"scene.throttle: {list(scene.throttle)} is not a lowest and a highest throttle"
    if len(scene.gain_db) != len(s.array.positions_m):
        yield (
            f"scene.gain_db: {len(scene.gain_db)} gains, "
            f"but array.positions_m has {len(s.array.positions_m)} microphones"
        )
    if len(s.filter.band_hz) != 2 or not s.filter.band_hz[0] < s.filter.band_hz[1]:
        yield f"filter.band_hz: {list(s.filter.band_hz)} is not a lowest and a highest frequency"
    seconds = (s.audio.frame + (scene.frames - 1) * s.audio.hop) / max(s.audio.rate_hz, 1)
    if scene.lead_s >= seconds:
        yield f"scene.lead_s: {scene.lead_s:g} s of noise alone, but a sample lasts {seconds:.3g} s"
    if scene.rotors and _smallest_spacing(s) > 0.0:
        places = np.array(s.array.positions_m)
        hubs = hubs_m(scene.rotors, scene.rotor_arm_m, scene.rotor_z_m)
        nearest = np.linalg.norm((places - places.mean(axis=0))[:, None] - hubs, axis=2).min()
        if nearest < NEAREST_HUB_M + s.twin.position_error_m:
            yield f"scene.rotor_arm_m: puts a hub {nearest:.3g} m from a microphone"


def _faults_of_mixes(s: LabSettings) -> Iterator[str]:
    snr_db = s.mixes.snr_db
    if len(snr_db) != 2 or not snr_db[0] <= snr_db[1]:
        yield f"mixes.snr_db: {list(snr_db)} is not a lowest and a highest SNR"
    if not s.mixes.drones:
        yield "mixes.drones: is empty"


def _smallest_spacing(s: LabSettings) -> float:
    """Metres; 0 where the positions are not such that it can be told."""
    positions = s.array.positions_m
    if len(positions) < 2 or any(len(row) != 3 for row in positions) or not np.isfinite(positions).all():
        return 0.0
    return float(MicArray(np.array(positions)).spacing_m.min())


def triangle(spacing_m: float) -> tuple[tuple[float, ...], ...]:
    """`array.positions_m` of an equilateral triangle of this side."""
    return tuple(tuple(float(x) for x in row) for row in equilateral(spacing_m).positions_m)


# --- reading ------------------------------------------------------------------------------------------

PAPER: dict[str, dict[str, Any]] = {}
"""What a file that leaves a key out asks for: the defaults, which are the paper's."""

OWN: dict[str, dict[str, Any]] = {
    "twin": {"noise": "snr", "snr_db": 0.0, "height_span_m": 60.0},
    "scene": {"snr_span_db": 30.0},
    "data": {"samples": 100_000},
    "dataset": {"level": "waveforms"},
    "mlp": {"patience": 40},
}
"""The same for a model that is to fly: sound of 0 to 30 dB from a disc below, more of it, and passes enough
for the learning rate to come down again, which is where the last tenths of a degree are."""


def read(path: Path | None, defaults: dict[str, dict[str, Any]] = PAPER) -> LabSettings:
    """Settings of a TOML file over `defaults`; None: the defaults alone.

    Lists with one item per microphone that the file leaves out are as long as array.positions_m. Raises
    `SettingsError` with one line per fault, each beginning with `section.key`.
    """
    table: dict[str, Any] = {}
    if path is not None:
        try:
            table = tomllib.loads(path.read_bytes().decode("utf-8"))
        except OSError as error:
            raise SettingsError(f"{path}: cannot be read: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise SettingsError(f"{path}: is not TOML: {error}") from error
    return from_table(_over(_per_microphone(table), _over(table, defaults)), LabSettings)


def _per_microphone(table: dict[str, Any]) -> dict[str, dict[str, Any]]:
    array = table.get("array")
    positions = array.get("positions_m") if isinstance(array, dict) else None
    if not isinstance(positions, list):
        return {}
    mics = len(positions)
    lists: dict[str, dict[str, Any]] = {
        "audio": {"channel_map": list(range(mics))},
        "twin": {"offset_samples": [0.0] * mics},
        "scene": {"gain_db": [0.0] * mics},
    }
    given = {name: content for name, content in table.items() if isinstance(content, dict)}
    return {
        name: {key: value for key, value in keys.items() if key not in given.get(name, {})}
        for name, keys in lists.items()
        if name not in table or name in given
    }


def _over(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """Sections of both; where both have a key, the first one's."""
    merged = dict(second)
    for name, content in first.items():
        below = second.get(name, {})
        both = isinstance(content, dict) and isinstance(below, dict)
        merged[name] = {**below, **content} if both else content
    return merged


if __name__ == "__main__":
    print(sample(LabSettings()), end="")
