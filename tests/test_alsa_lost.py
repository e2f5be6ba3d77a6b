"""Cards that lose sound, fail, go and come back; and a real sound server, killed and started again."""

import numpy as np
import pytest
from alsa import server
from alsa.card import ROWS, VirtualCard, assert_whole, ramp, rows_of

from locagen_edge.settings import Settings


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
    # the player's first rows come after silence, and others may where the machine is busy: it is the
    # server's own; between it no row is missing
    whole, before = 0, None
    for frame in found["frames"]:
        assert frame["overruns"] == 0
        if not np.any(frame["samples"], axis=0).all():
            before = None
            continue
        row = rows_of(frame, channel_map)
        assert (np.diff(row) % ROWS == 1).all()
        shift = row[0] - frame["start"]
        assert before is None or (shift - before) % ROWS == 0
        whole, before = whole + 1, shift
    assert whole >= 3
    assert found["closing_s"] < 0.5


def test_a_sound_server_that_is_killed_and_started_again_is_heard_again(sound_server):
    found = sound_server.play("server_killed", stall_s=1.0, device="array4")
    away, back = found["status"]
    assert away.startswith("no sound: ")
    assert back.startswith("listening")
    assert found["lost_s"] > 1.0
    assert found["tries"] <= 3  # the server takes its time to start
