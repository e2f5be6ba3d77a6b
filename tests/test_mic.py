"""Microphones and recordings: every sample once and in order, faults in words, the clock kept.

With the real libraries: tests/test_alsa.py.
"""

import asyncio
import json
import logging
import struct
import subprocess
import sys

import numpy as np
import pytest
import soundfile

from locagen_edge.errors import SourceError
from locagen_edge.sampleclock import LOSS_S, SampleClock
from locagen_edge.settings import from_table
from locagen_edge.stages import mic
from locagen_edge.stages.mic import (
    LATEST_S,
    Device,
    _choose,
    _Mailbox,
    capture,
    wav,
    wav_duration_s,
    wav_frames,
)
from locagen_edge.types import Frame

FRAME, HOP = 1024, 512


def make(**audio):
    return from_table({"audio": audio})


# --- recordings ---------------------------------------------------------------------------------------


def sines(rate, channels, seconds=0.5):
    """(n, channels): channel c is a sine of its own pitch."""
    hz = 400.0 + 250.0 * np.arange(channels)
    return 0.5 * np.sin(2 * np.pi * hz * np.arange(round(rate * seconds))[:, np.newaxis] / rate)


@pytest.mark.parametrize("subtype", ["PCM_16", "PCM_24", "FLOAT"])
@pytest.mark.parametrize("rate", [8000, 10_000, 16_000, 44_100, 48_000, 96_000])
@pytest.mark.parametrize("channels", [3, 4, 8])
def test_a_recording_of_any_kind_gives_the_sound_at_its_time(tmp_path, subtype, rate, channels):
    path = tmp_path / "a.wav"
    soundfile.write(path, sines(rate, channels), rate, subtype=subtype)
    # a band that 8 kHz can carry
    table = {"audio": {"channel_map": [2, 0, 1]}, "correlation": {"band_hz": [300.0, 3700.0]}}
    settings = from_table(table)
    frames = list(wav_frames(path, settings))
    assert len(frames) == (5000 - FRAME) // HOP + 1
    expected = sines(10_000, 3)[:, [2, 0, 1]].T
    for k, frame in enumerate(frames):
        assert (frame.start, frame.t_ns, frame.overruns) == (HOP * k, 51_200_000 * k, 0)
        assert frame.samples.dtype == np.float32
        if 0 < k < len(frames) - 1:  # at the ends of the file the resampler's filter sees half a sine
            # 16 bit round by 1.5e-5; the resampler errs below 1e-4
            got = frame.samples - expected[:, HOP * k : HOP * k + FRAME]
            assert np.abs(got).max() < 2e-4
    assert wav_duration_s(path, settings) == pytest.approx(0.5)


def test_a_long_recording_is_read_in_pieces_and_whole(tmp_path):
    path = tmp_path / "a.wav"
    sound = np.random.default_rng(0).uniform(-1, 1, (50_000, 3)).astype(np.float32)
    soundfile.write(path, sound, 10_000, subtype="FLOAT")
    frames = list(wav_frames(path, make()))
    assert [f.start for f in frames] == list(range(0, 50_000 - FRAME + 1, HOP))
    for frame in frames:
        np.testing.assert_array_equal(frame.samples, sound.T[:, frame.start : frame.start + FRAME])


@pytest.mark.parametrize("fault", [np.nan, np.inf, -np.inf, 40.0])
def test_what_is_not_sound_is_kept_as_it_is(tmp_path, fault):
    path = tmp_path / "a.wav"
    sound = np.zeros((3000, 3), dtype=np.float32)
    sound[1500, 1] = fault
    soundfile.write(path, sound, 10_000, subtype="FLOAT")
    frames = list(wav_frames(path, make()))
    np.testing.assert_array_equal(frames[1].samples[1, 1500 - HOP], np.float32(fault))
    assert not frames[1].samples[[0, 2]].any()


def test_more_channels_than_used_are_told_once(tmp_path, caplog):
    path = tmp_path / "a.wav"
    soundfile.write(path, sines(10_000, 6), 10_000)
    with caplog.at_level(logging.INFO):
        list(wav_frames(path, make(channel_map=[5, 1, 2])))
    assert [r.message for r in caplog.records] == [f"{path}: channels [5, 1, 2] of 6 are used"]


def cut_short(path, keep):
    path.write_bytes(path.read_bytes()[:keep])


def test_a_cut_recording_plays_what_is_there_and_says_so(tmp_path, caplog):
    path = tmp_path / "a.wav"
    sound = np.random.default_rng(0).uniform(-0.9, 0.9, (20_000, 3))
    soundfile.write(path, sound, 10_000, subtype="PCM_16")
    cut_short(path, path.stat().st_size // 2)
    frames = list(wav_frames(path, make()))
    assert len(frames) == (10_000 - FRAME) // HOP + 1
    assert [r.message for r in caplog.records] == [
        f"{path}: cut short: 50 % of what its header promises is there"
    ]


def test_a_damaged_recording_gives_what_comes_before(tmp_path):
    path = tmp_path / "a.flac"
    soundfile.write(path, np.random.default_rng(0).uniform(-0.9, 0.9, (30_000, 3)), 10_000)
    cut_short(path, path.stat().st_size // 2)
    frames = wav_frames(path, make())
    assert next(frames).start == 0
    with pytest.raises(SourceError, match=r"a\.flac: damaged after 0\.8 s|a\.flac: damaged after 1\.6 s"):
        list(frames)


def write_nothing(path):
    path.touch()


def write_text(path):
    path.write_text("not sound at all\n" * 100, encoding="utf-8")


def write_header_only(path):
    soundfile.write(path, sines(10_000, 3), 10_000)
    cut_short(path, 44)


def write_part_of_a_header(path):
    soundfile.write(path, sines(10_000, 3), 10_000)
    cut_short(path, 20)


def write_absurd_rate(path):
    soundfile.write(path, sines(10_000, 3), 10_000)
    data = bytearray(path.read_bytes())
    data[24:28] = struct.pack("<I", 100)
    path.write_bytes(data)


UNREADABLE = {
    "missing": (lambda _: None, "there is no such file"),
    "directory": (lambda path: path.mkdir(), "is not a file"),
    "empty": (write_nothing, "is empty (0 bytes)"),
    "text": (write_text, "is not audio that can be read: Format not recognised."),
    "header cut": (write_part_of_a_header, "is not audio that can be read: "),
    "no data": (write_header_only, "holds 0 s, less than one frame (0.102 s)"),
    "short": (lambda p: soundfile.write(p, sines(10_000, 3, 0.05), 10_000), "holds 0.05 s, less than one"),
    "mono": (lambda p: soundfile.write(p, sines(10_000, 1), 10_000), "has 1 channel, but audio.channel_map"),
    "stereo": (lambda p: soundfile.write(p, sines(10_000, 2), 10_000), "names channel 2 (counted from 0)"),
    "slow": (
        lambda p: soundfile.write(p, sines(8000, 3), 8000),
        "8000 Hz carries sound up to 4000 Hz, but correlation.band_hz goes to 4700 Hz: use a faster rate",
    ),
    "absurd": (write_absurd_rate, "100 Hz carries sound up to 50 Hz"),
}


@pytest.mark.parametrize("kind", UNREADABLE)
def test_a_recording_that_cannot_be_used_says_why_in_one_line(tmp_path, kind):
    write, words = UNREADABLE[kind]
    path = tmp_path / "a.wav"
    write(path)
    for use in (lambda: list(wav_frames(path, make())), lambda: wav_duration_s(path, make())):
        with pytest.raises(SourceError) as caught:
            use()
        message = str(caught.value)
        assert message.startswith(str(path))
        assert words in message
        assert "\n" not in message


def test_a_recording_in_real_time_loops_without_a_frame_across_the_seam(tmp_path):
    path = tmp_path / "a.wav"
    sound = np.random.default_rng(0).uniform(-0.9, 0.9, (1200, 3)).astype(np.float32)
    soundfile.write(path, sound, 10_000, subtype="FLOAT")

    async def listen(loop):
        source = wav(make(source="wav", file=str(path), loop=loop))
        frames = []
        async for frame in source:
            frames.append(frame)
            if len(frames) == 3:
                break
        await source.aclose()
        return frames

    assert len(asyncio.run(listen(loop=False))) == 1
    frames = asyncio.run(listen(loop=True))
    assert [f.start for f in frames] == [0, 1200, 2400]
    assert [f.overruns for f in frames] == [0, 0, 0]
    assert frames[1].t_ns - frames[0].t_ns == 120_000_000
    for frame in frames:
        np.testing.assert_array_equal(frame.samples, sound[:FRAME].T)


# --- reading a card, in made-up time -------------------------------------------------------------------


class FakeCard:
    """A stream whose clock the test holds. Channel c of row n is n + c / 4."""

    def __init__(self, rate_hz=10_000.0, channels=4, polls=100):
        self.rate_hz = rate_hz
        self.channels = channels
        self.polls = polls
        self.now = 5_000_000_000
        self.begin = self.now
        self.lost = 0  # rows that never come
        self.done = 0
        self.flag = False
        self.script = {}  # poll number: what happens then
        self.latency = 4 * LATEST_S

    def now_ns(self):
        return self.now

    def wait(self, seconds):
        self.now += round(seconds * 1e9)
        self.polls -= 1
        self.script.get(self.polls, lambda: None)()
        return self.polls < 0

    @property
    def read_available(self):
        return max(round((self.now - self.begin) * 1e-9 * self.rate_hz) - self.lost - self.done, 0)

    def read(self, rows):
        number = self.done + np.arange(rows)[:, np.newaxis]
        self.done += rows
        flag, self.flag = self.flag, False
        return (number + np.arange(self.channels) / 4).astype(np.float32), flag

    def frames(self, **audio):
        settings = make(device_rate_hz=10_000, device_channels=4, channel_map=[3, 0, 1], **audio)
        return list(capture(self, settings, self.wait, self.now_ns))


def test_a_card_gives_every_row_in_order_and_maps_channels():
    card = FakeCard()
    frames = card.frames()
    assert [f.start for f in frames] == list(range(0, card.done - FRAME + 1, HOP))
    assert 90 <= len(frames) <= 100  # of 100 questions to the card nearly all were in time for a frame
    for frame in frames:
        assert frame.overruns == 0
        assert frame.t_ns == card.begin + frame.start * 100_000
        number = frame.start + np.arange(FRAME)
        np.testing.assert_array_equal(frame.samples, np.stack([number + 0.75, number, number + 0.25]))


def test_a_late_reader_changes_no_time_stamp():
    card = FakeCard()
    card.script = {50: lambda: setattr(card, "now", card.now + 150_000_000)}
    for frame in card.frames():
        assert frame.t_ns == card.begin + frame.start * 100_000
        assert frame.overruns == 0


def test_an_overrun_travels_with_the_next_frame_and_none_spans_it():
    card = FakeCard()

    def overrun():
        card.done += 50  # these rows nobody will read
        card.flag = True

    card.script = {60: overrun}
    frames = card.frames()
    assert sum(f.overruns for f in frames) == 1
    assert all((np.diff(f.samples) == 1).all() for f in frames)
    at = next(k for k, f in enumerate(frames) if f.overruns)
    assert frames[at].samples[1, 0] - frames[at - 1].samples[1, -1] > 50


def test_sound_lost_in_silence_is_seen_against_the_clock():
    card = FakeCard()
    card.script = {60: lambda: setattr(card, "lost", round(2 * LOSS_S * card.rate_hz))}
    frames = card.frames()
    assert sum(f.overruns for f in frames) == 1
    after = [f for f in frames if f.start > frames[0].start + 30_000]
    assert after
    for frame in after:  # by then the clock has been set anew
        heard_ns = card.begin + (frame.samples[1, 0] + card.lost) * 100_000
        assert frame.t_ns == pytest.approx(heard_ns, abs=1_000_000)


@pytest.mark.parametrize("ppm", [-100, 100])
def test_a_wrong_crystal_is_followed_and_never_taken_for_a_loss(ppm):
    card = FakeCard(rate_hz=10_000 * (1 + ppm * 1e-6), polls=60_000)  # 20 minutes: 120 ms apart by the end
    frames = card.frames(frame=4096, hop=4096)
    assert sum(f.overruns for f in frames) == 0
    last = frames[-1]
    heard_ns = card.begin + last.start * 1e9 / card.rate_hz
    assert last.t_ns == pytest.approx(
        heard_ns, abs=2_000_000
    )  # 100 ppm of the clock's memory of 10 s is 1 ms


def test_a_card_that_stands_still_is_given_up_after_stall_s():
    card = FakeCard(polls=1000)
    stopped_ns = []

    def stop():
        stopped_ns.append(card.now)
        card.lost = round(1e9)  # a pointer that does not move any more

    card.script = {900: stop}
    heard = []
    settings = make(device_rate_hz=10_000, device_channels=4)
    with pytest.raises(SourceError, match="the default device: no sound for 2 s"):
        heard.extend(capture(card, settings, card.wait, card.now_ns))
    assert (card.now - stopped_ns[0]) * 1e-9 == pytest.approx(2.0, abs=LATEST_S)


def test_int16_is_scaled_to_full_scale_one():
    class Loud(FakeCard):
        def read(self, rows):
            self.done += rows
            return np.full((rows, 4), [-32768, 0, 16384, 32767], dtype=np.int16), False

    samples = Loud().frames()[0].samples
    np.testing.assert_array_equal(samples[:, 0], np.float32([32767 / 32768, -1.0, 0.0]))


def test_jitter_of_the_cards_pointer_is_no_loss():
    clock = SampleClock(48_000)
    rng = np.random.default_rng(0)
    for poll in range(5000):
        now = poll * 20_000_000
        samples = now * 48e3 / 1e9 - rng.uniform(0, 0.04) * 48e3  # a pointer that is up to 40 ms behind
        assert clock.update(max(0, round(samples)), now)
    assert 0 < clock.origin_ns < 40_000_000


# --- hand-over, choice ---------------------------------------------------------------------------------


def test_a_full_mailbox_drops_the_oldest_and_tells():
    async def fill():
        box = _Mailbox(asyncio.get_running_loop(), 3)
        for k in range(6):
            box.put(Frame(np.zeros((1, 4), dtype=np.float32), 1e4, 0, k, overruns=int(k == 1)))
        box.end(SourceError("gone"))
        frames = [await box.get() for _ in range(3)]
        with pytest.raises(SourceError, match="gone"):
            await box.get()
        await box.ended.wait()
        return [(f.start, f.overruns) for f in frames]

    assert asyncio.run(fill()) == [(3, 1), (4, 0), (5, 0)]


FOUND = [
    Device(1, "USB array: 4 mics", 4, 48_000.0, "ALSA"),
    Device(2, "USB headset", 1, 44_100.0, "ALSA"),
    Device(5, "default", 32, 44_100.0, "ALSA"),
]


@pytest.mark.parametrize(("wanted", "index"), [("array", 1), ("usb head", 2), ("", 5), ("USB headset", 2)])
def test_a_device_is_chosen_by_part_of_its_name(wanted, index):
    assert _choose(FOUND, make(device=wanted)).index == index


@pytest.mark.parametrize(
    ("found", "wanted", "words"),
    [
        (FOUND, "none", 'audio.device: "none" is not there; there are "USB array: 4 mics", "USB headset"'),
        (FOUND, "USB", 'audio.device: "USB" fits more than one'),
        ([], "", "audio.device: no device that can record is there"),
    ],
)
def test_a_device_that_cannot_be_chosen_is_told(found, wanted, words):
    with pytest.raises(SourceError) as caught:
        _choose(found, make(device=wanted))
    assert words in str(caught.value)


def run_python(code):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], text=True, capture_output=True, check=True
    ).stdout


def test_importing_the_sources_starts_no_audio_library():
    code = """
import sys, asyncio
from locagen_edge.sources import open_source
from locagen_edge.settings import Settings
asyncio.run(anext(open_source(Settings())))
print([m for m in ("sounddevice", "soundfile") if m in sys.modules])
import locagen_edge.stages.mic
print("sounddevice" in sys.modules)
"""
    assert run_python(code).split("\n")[:2] == ["[]", "False"]


def test_a_missing_portaudio_is_told():
    code = """
import sys, ctypes.util, asyncio, json
ctypes.util.find_library = lambda name: None
from locagen_edge.errors import SourceError
from locagen_edge.sampleclock import LOSS_S, SampleClock
from locagen_edge.settings import from_table
from locagen_edge.sources import open_source
from locagen_edge.stages.mic import devices
told = []
for use in (devices, lambda: asyncio.run(anext(open_source(from_table({"audio": {"source": "alsa"}}))))):
    try:
        use()
    except SourceError as error:
        told.append(str(error))
print(json.dumps(told))
"""
    assert json.loads(run_python(code)) == ["PortAudio is missing: install the package libportaudio2"] * 2


def test_a_card_is_found_by_its_id_whatever_its_number(tmp_path, monkeypatch):
    """Two arrays of one make, which only the kernel's ids tell apart."""
    twins = [Device(n, f"Array: USB Audio (hw:{n},0)", 4, 48_000.0, "ALSA") for n in (1, 2)]
    monkeypatch.setattr(mic, "CARDS", tmp_path)
    for number, name in ((1, "Array"), (2, "Array_1")):
        (tmp_path / f"card{number}").mkdir()
        (tmp_path / f"card{number}" / "id").write_text(f"{name}\n")
    assert [device.stable_name for device in twins] == ["hw:CARD=Array,DEV=0", "hw:CARD=Array_1,DEV=0"]
    for wanted, index in (("hw:CARD=Array_1", 2), ("hw:CARD=Array,DEV=0", 1), (twins[1].name, 2)):
        assert _choose(twins, make(device=wanted)).index == index
    with pytest.raises(SourceError, match='"hw:CARD=Array,DEV=1" is not there'):
        _choose(twins, make(device="hw:CARD=Array,DEV=1"))
    assert [device.stable_name for device in FOUND] == [device.name for device in FOUND]


@pytest.mark.parametrize("gain_db", [0.0, 12.0])
def test_a_converter_at_its_end_is_seen_before_filters_round_it_off(tmp_path, gain_db):
    """At 48 kHz, and where array.gains_db takes the sound down again."""
    path = tmp_path / "a.wav"
    sound = sines(48_000, 3)
    sound[:, 1] = np.clip(5 * sound[:, 1], -1, 1)
    soundfile.write(path, sound, 48_000)
    settings = from_table({"array": {"gains_db": [0.0, gain_db, 0.0]}})
    assert next(iter(wav_frames(path, settings))).clipped == 0b010
