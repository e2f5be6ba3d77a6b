"""Capture through the real PortAudio and ALSA libraries: a virtual card (tests/alsa), paced in real time."""

import os
import subprocess
import sys

import numpy as np
import pytest
import soundfile
from alsa.card import ROWS, VirtualCard, assert_whole, rows_of
from conftest import ROOT

from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import load
from locagen_edge.stages.mic import wav_frames
from locagen_edge.store.journal import records
from locagen_edge.store.plain import plain

HOP = 512


# Not int16 from a card of more bits: PortAudio rounds there.
@pytest.mark.parametrize(
    ("sample", "sample_format"),
    [
        ("S16_LE", "int16"),
        ("S16_LE", "float32"),
        ("S24_3LE", "int24"),
        ("S32_LE", "int24"),
        ("FLOAT_LE", "float32"),
    ],
)
def test_every_row_of_a_card_arrives_once_and_in_order(library, tmp_path, sample, sample_format):
    found = VirtualCard(library, tmp_path, sample=sample).play("listen", sample_format=sample_format)
    first = rows_of(found["frames"][0])[0]
    for k, frame in enumerate(found["frames"]):
        assert_whole(frame)
        assert (rows_of(frame)[0] - first) % ROWS == HOP * k == frame["start"]
        assert frame["overruns"] == 0
        assert found["before_ns"] < frame["t_ns"] < found["after_ns"]
    assert found["closing_s"] < 0.5
    assert found["opened"] == found["closed"]


HZ = 400.0 * np.arange(1, 9)  # of channel c: whole periods in a tenth of a second, at any rate


def tones(rate, channels):
    """(n, channels): a sine in each channel, which comes round without a seam."""
    return 0.5 * np.sin(2 * np.pi * HZ[:channels] * np.arange(rate // 10)[:, np.newaxis] / rate)


def assert_tones(found, channels, rate=10_000):
    """The last frame holds the sine of each channel, all of one moment."""
    samples = np.array(found["frames"][-1]["samples"])
    assert len(samples) == len(channels)
    t = np.arange(samples.shape[1]) / rate
    moments = np.arange(0, 2.5e-3, 1e-6)  # all tones come round in it
    off = np.zeros(len(moments))
    for row, hz in zip(samples, HZ[channels], strict=True):
        turning = np.exp(2j * np.pi * hz * t)
        a, b = np.linalg.lstsq(np.stack([turning.imag, turning.real], axis=1), row, rcond=None)[0]
        assert np.hypot(a, b) == pytest.approx(0.5, rel=2e-3)
        assert np.abs(row - a * turning.imag - b * turning.real).max() < 2e-3
        off = np.maximum(off, np.abs(2 * (a + 1j * b) - np.exp(2j * np.pi * hz * moments)))
    assert off.min() < 0.02  # 1 us of 3200 Hz, there and back


@pytest.mark.parametrize(
    ("channels", "rate", "sample", "sample_format", "channel_map"),
    [
        (4, 16_000, "S16_LE", "int16", [0, 1, 2]),
        (4, 44_100, "S24_3LE", "int24", [3, 1, 0]),
        (6, 48_000, "S32_LE", "int24", [5, 0, 2]),
        (6, 96_000, "FLOAT_LE", "float32", [1, 2, 3]),
        (8, 44_100, "S16_LE", "float32", [7, 4, 1]),
        (8, 96_000, "S24_3LE", "int16", [6, 0, 3]),
        (3, 48_000, "S16_LE", "int16", [2, 1, 0]),
    ],
)
def test_three_of_many_channels_at_any_rate(
    library, tmp_path, channels, rate, sample, sample_format, channel_map
):
    card = VirtualCard(library, tmp_path, rate_hz=rate, sample=sample, rows=tones(rate, channels))
    found = card.play(
        "listen", sample_format=sample_format, device_channels=channels, channel_map=channel_map
    )
    assert sum(frame["overruns"] for frame in found["frames"]) == 0
    assert_tones(found, channel_map)


PLUGINS = """
pcm.routed { type route slave { pcm "card" channels 4 }
    ttable { 0 { 3 1 } 1 { 2 1 } 2 { 0 1 } } }
pcm.plugged { type plug slave { pcm "card" } }
pcm.linear { type linear slave { pcm "card" format S32_LE } }
"""


@pytest.mark.parametrize(
    ("device", "more", "channels"),
    [
        ("routed", {"device_channels": 3, "channel_map": [0, 1, 2]}, [3, 2, 0]),
        ("plugged", {"sample_format": "float32"}, [2, 0, 3]),
        ("linear", {}, [2, 0, 3]),
    ],
)
def test_alsas_plugins_stand_between_and_keep_every_channel(library, tmp_path, device, more, channels):
    sample = "S32_LE" if device == "linear" else "S16_LE"
    card = VirtualCard(
        library, tmp_path, name="card", rate_hz=48_000, sample=sample, rows=tones(48_000, 4), more=PLUGINS
    )
    assert_tones(card.play("listen", device=device, **more), channels)


@pytest.mark.parametrize(
    ("audio", "words"),
    [
        (
            {"device_channels": 6},
            'audio.device_channels: 6 in settings, device "array4" offers 4',
        ),
        (
            {"device_rate_hz": 44_100},
            'audio.device_rate_hz: 44100 in settings, device "array4" refuses it (its own is 10000)',
        ),
        (
            {"device_rate_hz": 8000},
            "audio.device_rate_hz: 8000 Hz carries sound up to 4000 Hz, but correlation.band_hz goes to "
            "4700 Hz: use a faster rate or lower the band",
        ),
        ({"device": "hw:7"}, 'audio.device: "hw:7" is not there; there are "array4"'),
    ],
)
def test_a_card_that_does_not_fit_is_told(card, audio, words):
    assert card.play("refused", **audio)["error"] == words


def test_devices_are_listed(card):
    assert card.play("list_devices")["devices"] == [["array4", 4, 10_000.0, "ALSA"]]


# --- from the card to the disk and back


def test_a_live_run_from_a_card_of_24_bits_replays_bit_for_bit(library, tmp_path):
    rng = np.random.default_rng(3)
    sound = 0.1 * rng.standard_normal((48_000, 4))
    sound[:, 2] = np.roll(sound[:, 0], 7)
    sound[:, 3] = np.roll(sound[:, 0], -5)
    card = VirtualCard(library, tmp_path, rate_hz=48_000, sample="S24_3LE", rows=sound)
    path = tmp_path / "s.toml"
    path.write_text(
        '[audio]\nsource = "alsa"\ndevice = "array4"\ndevice_channels = 4\nsample_format = "int24"\n'
        'channel_map = [0, 2, 3]\n[bearing]\nestimator = "far-field"\n[detection]\nsnr_db = -20\n'
        '[mavlink]\nlink = "udpout:127.0.0.1:9"\n[record]\nfree_mb = 0\n[daemon]\nqueue_frames = 1000\n'
        f'[log]\ndirectory = "{tmp_path}/log"\n'
    )
    command = ["run", "--quiet", "--seconds", "4", "--settings", path, "--record", tmp_path / "parts"]
    done = subprocess.run(
        [sys.executable, "-m", "locagen_edge", *map(str, command)],
        env=os.environ | {"PYTHONPATH": str(ROOT), "ALSA_CONFIG_PATH": str(card.directory / "asound.conf")},
        text=True, capture_output=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    parts = sorted((tmp_path / "parts").glob("*.wav"))
    whole = soundfile.read(parts[0])[0] * 2**23
    assert np.array_equal(whole, np.rint(whole))  # every bit of the 24 is there, and none beside
    live = [r for r in records(tmp_path / "log") if r["type"] == "bearing"]
    settings = load(path)
    pipeline = Pipeline(settings)
    again = {f.start: plain(pipeline.process(f)) for f in wav_frames(parts, settings)}
    assert len(live) > 3
    for bearing in live:
        for what in ("tdoa", "bearing", "detection", "track", "faults"):
            assert bearing[what] == again[bearing["start"]][what]
