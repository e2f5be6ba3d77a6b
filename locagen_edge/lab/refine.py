"""Can a network correct the steered estimator where physics is not the free field?

The estimator `steered` is the best possible for one plane wave in known noise. Echoes, clipping, wind,
rotors, misplaced microphones and a second caller are not in its model, but may leave a mark in its map. A
network sees that map, turned so that the estimate is in the middle, with the estimate's elevation, sigmas and
score, and answers with a correction of azimuth and elevation and with new sigmas, all in units of the
estimator's own sigmas: in the free field "nothing to do" is zero.

It is judged against the estimator on the same calls, on seeds not trained on and, by a network that is
trained without it, on each kind of disturbance as one never met. Loss: the Gaussian's negative log-likelihood
with mean and variance both learnt (Nix & Weigend, "Estimating the mean and variance of the target
probability distribution", ICNN 1994).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from joblib import Parallel, delayed

from locagen_edge.errors import ModelError
from locagen_edge.geometry import wrap
from locagen_edge.lab.columns import waveforms
from locagen_edge.lab.settings import LabSettings
from locagen_edge.stages.bearing.steered import SteeredLocator
from locagen_edge.types import F32, F64, Array, Bearing, Frame, Tdoa

LEAD_S = 2.0
"""Noise alone before a call, for the estimator to learn."""
CALL_FRAMES = 8
TAKEN = (3, 5, 7)
"""Frames of a call that are learnt from; judged is the last one alone, so that all are independent."""
WORTH = 100.0
"""Score from which a bearing counts: a call at the default `detection.evidence`, in the stillest noise."""
FARTHEST = 30.0
"""Sigmas at which an error counts no more: gross errors have no size to be learnt."""
EPOCHS = 60
BATCH = 256
RATE = 2e-3
DECAY = 0.02
VALIDATION = 0.15
WIDTHS = (48, 24)
RESAMPLES = 1000
SIGMAS = (1.0, 2.0)


@dataclass(frozen=True)
class Kind:
    """A disturbance: what differs in [scene] and [twin], in turns of `CHUNK` calls where it is a list, and a
    second caller's level."""

    scene: dict[str, Any] = dataclasses.field(default_factory=dict)
    twin: dict[str, Any] = dataclasses.field(default_factory=dict)
    second_db: float | None = None

    def turn(self, number: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Of [scene] and [twin]."""
        scene, twin = (
            {k: v[number % len(v)] if isinstance(v, list) else v for k, v in keys.items()}
            for keys in (self.scene, self.twin)
        )
        return scene, PLACES[number // 2 % len(PLACES)] | twin


CHUNK = 25
PLACES: tuple[dict[str, Any], ...] = (
    {"range_m": 60.0, "height_m": 5.0, "height_span_m": 55.0},
    {"range_m": 15.0, "height_m": 2.0, "height_span_m": 4.0},
    {"range_m": 30.0, "height_m": 5.0, "height_span_m": 15.0},
)
"""Where callers are, in turns as well: far, near, between."""

KINDS: dict[str, Kind] = {
    "free field": Kind(),
    "ground": Kind({"ground": [0.4, 0.8]}),
    "wind": Kind({"wind_m_s": 8.0, "wind_dbfs": -10.0}),
    "clipping": Kind({"level_dbfs": [0.0, 6.0]}),
    "positions 1 mm": Kind(twin={"position_error_m": 0.001 * math.sqrt(3.0)}),
    "two callers": Kind(second_db=-6.0),
    "rotors": Kind({"rotors": 4, "rotor_snr_db": [0.0, 10.0]}),
}
"""All with the tolerance of the settings in the microphones' places, but for the one that has more."""

HOVER = {"range_m": 20.0, "height_m": 10.0, "height_span_m": 2.0}
ELSEWHERE: dict[str, Kind] = {
    "free field, 10 m high": Kind(twin=HOVER),
    "ground, 10 m high": Kind({"ground": 0.6}, HOVER),
    "ground, caller lying": Kind({"ground": 0.6, "mouth_m": 0.3}),
    "ground, negative": Kind({"ground": -0.6}),
    "ground and rotors": Kind({"ground": 0.6, "rotors": 4, "rotor_snr_db": 5.0}),
}
"""Never trained on, by anyone: other places and another ground, where what was learnt of the twin's own
places, and is no physics, does harm."""


@dataclass(frozen=True, eq=False)
class Calls:
    """What the estimator said of each call, and what was true; one row per frame."""

    x: F32
    """(n, features)"""
    off: F64
    """(n, 2) truth - estimate of azimuth and elevation, radians"""
    sigma: F64
    """(n, 2) the estimator's, radians"""
    offered: int
    """calls, with those of which it said nothing"""

    def of(self, rows: Array) -> Calls:
        return Calls(self.x[rows], self.off[rows], self.sigma[rows], self.offered)


def joined(parts: Iterable[Calls]) -> Calls:
    found = list(parts)
    return Calls(
        np.concatenate([p.x for p in found]),
        np.concatenate([p.off for p in found]),
        np.concatenate([p.sigma for p in found]),
        sum(p.offered for p in found),
    )


# --- calls --------------------------------------------------------------------------------------------


def features(azimuth_axis: F32, scores: F32, bearing: Bearing) -> F32:
    """(rows * columns + 6,): the map over its top, the estimate in its middle column, and the estimate."""
    assert bearing.azimuth_rad is not None
    assert bearing.elevation_rad is not None
    columns = scores.shape[1]
    top = max(float(scores.max()), 1e-6)
    at = (bearing.azimuth_rad - float(azimuth_axis[0])) * columns / (2.0 * math.pi)
    turned = np.roll(scores / top, columns // 2 - round(at), axis=1)
    told = [
        at - round(at),
        bearing.elevation_rad,
        math.log(top),
        math.log(bearing.azimuth_sigma_rad),
        math.log(bearing.elevation_sigma_rad),
        float(bearing.span_s > 0.0),
    ]
    return np.concatenate([turned.ravel(), told]).astype(np.float32)


def under(s: LabSettings, kind: Kind, number: int) -> LabSettings:
    """The settings of the disturbance's scenes, in their turn."""
    changed, places = kind.turn(number)
    lead = math.ceil(LEAD_S / s.hop_s)
    twin: dict[str, Any] = {
        "source": "disc", "noise": "snr", "snr_db": 0.0,
        "position_error_m": s.array.tolerance_m * math.sqrt(3.0), **places,
    }  # fmt: skip
    scene: dict[str, Any] = {
        "sounds": ("white", "speech", "scream"), "frames": lead + CALL_FRAMES,
        "lead_s": lead * s.hop_s, "snr_span_db": 30.0, **changed,
    }  # fmt: skip
    return dataclasses.replace(
        s,
        twin=dataclasses.replace(s.twin, **twin),
        scene=dataclasses.replace(s.scene, **scene),
        dataset=dataclasses.replace(s.dataset, level="waveforms", keep=()),
    )


def calls(s: LabSettings, kind: Kind, count: int, seed: int, taken: tuple[int, ...], workers: int) -> Calls:
    """`count` calls under a disturbance as the estimator hears them, each with a past of its own."""
    pieces = Parallel(n_jobs=workers)(
        delayed(_some)(s, kind, min(CHUNK, count - first), seed, first, taken)
        for first in range(0, count, CHUNK)
    )
    return joined(pieces)


def _some(s: LabSettings, kind: Kind, count: int, seed: int, first: int, taken: tuple[int, ...]) -> Calls:
    here = under(s, kind, first // CHUNK)
    drawn = waveforms(here, count, seed, first)
    sound = drawn.sound
    if kind.second_db is not None:
        other = dataclasses.replace(
            here,
            twin=dataclasses.replace(here.twin, noise="none"),
            scene=dataclasses.replace(
                here.scene, rotors=0, level_dbfs=here.scene.level_dbfs + kind.second_db, snr_span_db=0.0
            ),
        )
        sound = sound + waveforms(other, count, seed + 1_000_000, first).call
    x, off, sigma = [], [], []
    for samples, azimuth, elevation in zip(sound, drawn.azimuth_rad, drawn.elevation_rad, strict=True):
        for row, bearing in _heard(here, samples, taken):
            assert bearing.azimuth_rad is not None
            assert bearing.elevation_rad is not None
            x.append(row)
            off.append((wrap(float(azimuth) - bearing.azimuth_rad), float(elevation) - bearing.elevation_rad))
            sigma.append((bearing.azimuth_sigma_rad, bearing.elevation_sigma_rad))
    width = len(x[0]) if x else 0
    return Calls(
        np.array(x, np.float32).reshape(-1, width),
        np.array(off, np.float64).reshape(-1, 2),
        np.array(sigma, np.float64).reshape(-1, 2),
        count * len(taken),
    )


def _heard(s: LabSettings, samples: F32, taken: tuple[int, ...]) -> Iterable[tuple[F32, Bearing]]:
    """Features and bearings of the frames `taken` after the onset, of those that are a call's."""
    audio, locate = s.audio, SteeredLocator(s)
    nothing = Tdoa(np.zeros(0), np.zeros(0), np.zeros(0))
    onset = s.scene.frames - CALL_FRAMES
    for number in range(s.scene.frames):
        start = number * audio.hop
        frame = Frame(
            np.ascontiguousarray(samples[:, start : start + audio.frame]),
            audio.rate_hz,
            round(1e9 * start / audio.rate_hz),
            start,
        )
        bearing = locate(frame, nothing, s.hop_s)[0]
        locate.settle(number >= onset)
        if number - onset not in taken or bearing.azimuth_rad is None or bearing.elevation_rad is None:
            continue
        axis, scores = locate.scores(bearing)
        if scores.max() >= WORTH:
            yield features(axis, scores, bearing), bearing


# --- the network --------------------------------------------------------------------------------------


class Refiner(torch.nn.Module):
    """Features (n, features) to (n, 4): corrections of azimuth and elevation, and the logs of their sigmas,
    in units of the estimator's own sigmas."""

    mean: torch.Tensor
    scale: torch.Tensor
    wider: torch.Tensor
    """(4,) added to the answer: by what the sigmas are widened in the end"""

    def __init__(self, x: F32) -> None:
        super().__init__()
        # cells that never change would blow up what is strange in flight
        self.register_buffer("mean", torch.from_numpy(x.mean(axis=0)))
        self.register_buffer("scale", torch.from_numpy(1.0 / np.maximum(x.std(axis=0), 0.05)))
        self.register_buffer("wider", torch.zeros(4))
        first, second = WIDTHS
        last = torch.nn.Linear(second, 4)
        self.body = torch.nn.Sequential(
            torch.nn.Linear(x.shape[1], first), torch.nn.Tanh(),
            torch.nn.Linear(first, second), torch.nn.Tanh(), last,
        )  # fmt: skip
        torch.nn.init.zeros_(last.weight)  # begins as the estimator itself
        torch.nn.init.zeros_(last.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y: torch.Tensor = self.body(torch.clamp((x - self.mean) * self.scale, -8.0, 8.0))
        return y + self.wider


def fit(data: Calls, seed: int) -> Refiner:
    """Trained on these calls, with the pass that was best on a part of them kept apart.

    There the sigmas are widened or narrowed by one factor each, so that 68 % of the errors lie within one.
    """
    torch.set_num_threads(1)  # layers this small take longer on two threads than on one
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    # frames of one call stay together; kinds come one after the other, so every seventh block is held
    held = np.arange(len(data.x)) // 60 % round(1.0 / VALIDATION) == 0
    x = torch.from_numpy(data.x)
    wanted = torch.from_numpy(np.clip(data.off / data.sigma, -FARTHEST, FARTHEST).astype(np.float32))
    learn, check = torch.from_numpy(np.flatnonzero(~held)), torch.from_numpy(np.flatnonzero(held))
    net = Refiner(data.x)
    optimiser = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=DECAY)
    steps = math.ceil(len(learn) / BATCH) * EPOCHS
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=RATE, total_steps=steps)
    best, weights = math.inf, {k: v.clone() for k, v in net.state_dict().items()}
    for _ in range(EPOCHS):
        net.train()
        for rows in torch.split(learn[torch.randperm(len(learn), generator=generator)], BATCH):
            loss = _loss(net(x[rows]), wanted[rows])
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
        with torch.no_grad():
            now = float(_loss(net.eval()(x[check]), wanted[check]))
        if now < best:
            best, weights = now, {k: v.clone() for k, v in net.state_dict().items()}
    net.load_state_dict(weights)
    with torch.no_grad():
        y = net(x[check])
        ratio = torch.abs(wanted[check] - y[:, :2]) * torch.exp(-y[:, 2:])
        net.wider[2:] = torch.log(torch.quantile(ratio, 0.683, dim=0))
    return net


def _loss(y: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    return (0.5 * ((wanted - y[:, :2]) * torch.exp(-y[:, 2:])) ** 2 + y[:, 2:]).mean()


def refined(net: Refiner, data: Calls) -> Calls:
    """The same calls after the network."""
    with torch.no_grad():
        y = net.eval()(torch.from_numpy(data.x)).numpy().astype(np.float64)
    off = data.off - y[:, :2] * data.sigma
    off[:, 0] = (off[:, 0] + np.pi) % (2.0 * np.pi) - np.pi
    return dataclasses.replace(data, off=off, sigma=data.sigma * np.exp(y[:, 2:]))


# --- what it is worth ---------------------------------------------------------------------------------


def compare(
    s: LabSettings, train_each: int, judge_each: int, workers: int, kinds: dict[str, Kind] | None = None
) -> dict[str, Any]:
    """Trains on all kinds, and without each of them; judges on other seeds. Angles in degrees.

    Raises `ModelError` where too few calls are heard to learn anything from.
    """
    kinds = KINDS if kinds is None else kinds
    seed = s.data.seed
    learnt = {
        name: calls(s, kind, train_each, seed + 100 * n, TAKEN, workers)
        for n, (name, kind) in enumerate(kinds.items())
    }
    if sum(len(c.x) for c in learnt.values()) < 200:
        raise ModelError("too few of the calls are heard to learn from: raise --calls")
    whole = fit(joined(learnt.values()), seed)
    rows = []
    for n, (name, kind) in enumerate({**kinds, **ELSEWHERE}.items()):
        judged = calls(s, kind, judge_each, seed + 10_000_000 + 100 * n, TAKEN[-1:], workers)
        answers = {"refined": refined(whole, judged)}
        if name in kinds:
            others = fit(joined(c for other, c in learnt.items() if other != name), seed)
            answers["never met"] = refined(others, judged)
        rows.append(_row(name, judged, answers))
    return {
        "calls": {"trained_on": train_each, "judged": judge_each},
        "parameters": sum(p.numel() for p in whole.parameters()),
        "rows": rows,
    }


def _row(name: str, judged: Calls, answers: dict[str, Calls]) -> dict[str, Any]:
    row: dict[str, Any] = {"kind": name, "n": len(judged.x), "heard": len(judged.x) / judged.offered}
    for axis, angle in enumerate(("azimuth", "elevation")):
        row[angle] = {
            who: told(c.off[:, axis], c.sigma[:, axis]) for who, c in {"analytic": judged, **answers}.items()
        }
        for who, c in answers.items():
            low, high = _interval(np.abs(judged.off[:, axis]), np.abs(c.off[:, axis]))
            row[angle][who] |= {"change_low": low, "change_high": high, "verdict": verdict(low, high)}
    return row


def told(off: F64, sigma: F64) -> dict[str, Any]:
    """Median and 90th percentile of the error, degrees, and the shares within one and two sigmas."""
    size = np.degrees(np.abs(off))
    return {
        "median_deg": float(np.median(size)),
        "p90_deg": float(np.percentile(size, 90)),
        "median_sigma_deg": float(np.degrees(np.median(sigma))),
        "within": [float(np.mean(np.abs(off) <= k * sigma)) for k in SIGMAS],
    }


def _interval(before: F64, after: F64) -> tuple[float, float]:
    """95 % of the relative change of the median error, over the same calls drawn again (bootstrap)."""
    rng = np.random.default_rng(1)
    again = rng.integers(len(before), size=(RESAMPLES, len(before)))
    change = np.median(after[again], axis=1) / np.maximum(np.median(before[again], axis=1), 1e-9) - 1.0
    low, high = np.percentile(change, (2.5, 97.5))
    return float(low), float(high)


def verdict(low: float, high: float) -> str:
    return "better" if high < 0.0 else "worse" if low > 0.0 else "no different"


def _percent(value: float) -> str:
    return f"{100.0 * value:+.0f} %"


def table(result: dict[str, Any], angle: str) -> str:
    """Markdown of one angle's rows."""
    lines = [
        "| disturbance | n | median error | refined | never met | change (95 %) | verdict | never met | "
        "within 1 / 2 sigma | refined | never met |",
        "|" + " --- |" * 11,
    ]
    for row in result["rows"]:
        a, r, u = (row[angle].get(who) for who in ("analytic", "refined", "never met"))
        lines.append(
            f"| {row['kind']} | {row['n']} | {a['median_deg']:.2f}° | {r['median_deg']:.2f}° | "
            f"{_of(u, 'median_deg')} | {_percent(r['change_low'])} to {_percent(r['change_high'])} | "
            f"{r['verdict']} | {u['verdict'] if u else '-'} | {_within(a)} | {_within(r)} | {_within(u)} |"
        )
    return "\n".join(lines)


def _of(told: dict[str, Any] | None, key: str) -> str:
    return f"{told[key]:.2f}°" if told else "-"


def _within(told: dict[str, Any] | None) -> str:
    return " / ".join(f"{share:.0%}" for share in told["within"]) if told else "-"


def markdown(result: dict[str, Any]) -> str:
    """The report, from its numbers alone."""
    counts = result["calls"]
    return "\n".join([
        "# The steered estimator and a network behind it",
        "",
        f"{result['parameters']:,} parameters, trained on {counts['trained_on']} calls of each of "
        f"{len(KINDS)} disturbances, judged on {counts['judged']} others of each and on scenes of which none "
        "were trained on (`-`). *Never met*: the network that was trained without that disturbance. "
        "*Change*: of the median error, 95 % by bootstrap over the same calls; `better` and `worse` where it "
        "leaves zero out. Right sigmas hold 68 % / 95 %.",
        "",
        "## Azimuth",
        "",
        table(result, "azimuth"),
        "",
        "## Elevation",
        "",
        table(result, "elevation"),
        "",
    ])  # fmt: skip


def line(result: dict[str, Any]) -> str:
    """The result in one line."""
    words = []
    for angle in ("azimuth", "elevation"):
        verdicts = [row[angle]["refined"]["verdict"] for row in result["rows"]]
        words.append(f"{angle} better in {verdicts.count('better')}, worse in {verdicts.count('worse')}")
    return f"of {len(result['rows'])} kinds of scenes: " + "; ".join(words)
