"""Capture through the real PortAudio and ALSA libraries: from a virtual card (tests/alsa), through ALSA's own
plugins, and from a real sound server; all paced in real time."""

import numpy as np
import pytest
from alsa import server
from alsa.card import ROWS, VirtualCard, build, ramp, row_of

from locagen_edge.settings import Settings

HOP = 512


@pytest.fixture(scope="session")
def library(tmp_path_factory):
    return build(tmp_path_factory.mktemp("plugin"))


@pytest.fixture
def card(library, tmp_path):
    return VirtualCard(library, tmp_path)


MAP = (2, 0, 3)


def rows_of(frame, channels=MAP):
    """(n,) row numbers, which must agree between the microphones."""
    rows = np.stack([row_of(s, channel) for s, channel in zip(frame["samples"], channels, strict=True)])
    assert (rows == rows[0]).all()
    return rows[0]


def assert_whole(frame):
    """Every row once and in order."""
    assert (np.diff(rows_of(frame)) % ROWS == 1).all()


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


def test_an_overrun_of_a_card_travels_and_no_frame_spans_it(card):
    frames = card.play("overrun")["frames"]
    assert sum(f["overruns"] for f in frames) == 1
    for frame in frames:
        assert_whole(frame)
    at = next(k for k, f in enumerate(frames) if f["overruns"])
    gap_rows = (rows_of(frames[at])[0] - rows_of(frames[0])[0]) % ROWS
    gap_ns = frames[at]["t_ns"] - frames[0]["t_ns"]
    # Rows that were lost still take their time. What the card loses between its stop and its start anew
    # counts in time, not in rows: some ms.
    assert gap_ns * 1e-5 == pytest.approx(gap_rows, abs=500)


def test_a_silent_loss_of_a_card_is_an_overrun(card):
    frames = card.play("skip")["frames"]
    assert sum(f["overruns"] for f in frames) == 1
    # the rows that were skipped took their time: 0.2 s, known to a few ms once the clock is set anew
    rows = (rows_of(frames[-1])[0] - rows_of(frames[0])[0]) % ROWS
    assert (frames[-1]["t_ns"] - frames[0]["t_ns"]) * 1e-5 == pytest.approx(rows, abs=100)


@pytest.mark.parametrize(
    ("scenario", "words", "absent"),
    [
        ("stalled", 'device "array": no sound for 0.3 s', 'device "array": no sound for 0.3 s'),
        ("ended", 'device "array": No such device', "audio.device: "),
        ("removed", 'device "array": No such device', "audio.device: "),
    ],
)
def test_a_card_that_goes_is_missed_in_time_and_found_again(card, scenario, words, absent):
    found = card.play(scenario)
    assert found["error"] == words
    assert found["absent"].startswith(absent)
    # 0.3 s to the stall and up to 8 frames that still waited; the rest is the machine's
    assert found["seconds"] < 2.0
    for frame in found["frames"]:
        assert_whole(frame)
    assert found["closing_s"] < 0.5


def test_a_cancelled_reader_closes_the_card(card):
    found = card.play("cancelled")
    assert found["opened"] == found["closed"] > 0
    assert found["seconds"] < 0.7


def test_a_driver_that_hangs_is_given_up_and_not_touched_again(card):
    found = card.play("hung")
    first, second = found["errors"]
    assert first[:2] == ["SourceHungError", 'device "array": the driver hangs: restart the service']
    assert second[:2] == ["SourceHungError", 'device "array": the driver still hangs: restart the service']
    assert first[2] < 1.0
    assert second[2] < 0.1
    assert found["tries"] == 1  # PortAudio was left to the thread that hangs
    assert found["after"] == 1  # and used again when it had come back


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


# --- a device that goes and comes back


def test_a_card_plugged_in_again_is_opened_by_the_next_try(card):
    """Tries are a second apart at most, so it is heard within two of its return."""
    found = card.play("replugged")
    assert Settings().daemon.backoff_s <= 1.0
    assert found["tries"] <= 1  # one may have been under way when it came
    assert found["fault"] == 'device "array": No such device'
    away, back = found["status"]
    assert away.startswith("no sound: audio.device: ")
    assert back.startswith("listening")
    assert found["lost_s"] > 1.0
    assert f"{found['lost_s']:.1f} s of sound lost" in back


@pytest.fixture
def sound_server(library, tmp_path):
    """A virtual card's folder, with a server's devices in its configuration."""
    server.needed()
    for channels in (3, 4):
        (tmp_path / f"rows{channels}").write_bytes(ramp(channels).tobytes())
    return VirtualCard(
        library, tmp_path, name="none", rate_hz=server.RATE, more=server.SoundServer(tmp_path).alsa()
    )


UNTOUCHED = {"rate_hz": 48_000, "frame": 4096, "hop": 2048}  # no resampler between


@pytest.mark.parametrize(("channels", "channel_map"), [(3, [0, 1, 2]), (4, [2, 0, 3])])
def test_a_sound_server_gives_every_row_once_and_in_order(sound_server, channels, channel_map):
    found = sound_server.play(
        "from_server",
        stall_s=2.0,
        device=f"array{channels}",
        device_channels=channels,
        channel_map=channel_map,
        **UNTOUCHED,
    )
    # the players' first rows may come after silence; ever after no row is missing
    first = None
    for frame in found["frames"]:
        row = rows_of(frame, channel_map)
        assert (np.diff(row) % ROWS == 1).all()
        assert frame["overruns"] == 0
        first = row[0] - frame["start"] if first is None else first
        assert (row[0] - frame["start"] - first) % ROWS == 0
    assert found["closing_s"] < 0.5


def test_a_sound_server_that_is_killed_and_started_again_is_heard_again(sound_server):
    found = sound_server.play("server_killed", stall_s=1.0, device="array4")
    away, back = found["status"]
    assert away.startswith("no sound: ")
    assert back.startswith("listening")
    assert found["lost_s"] > 1.0
    assert found["tries"] <= 3  # the server takes its time to start
