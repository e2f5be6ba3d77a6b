"""What comes from outside and may be anything: settings files, WAV headers, the records beside a recording.

Three laws: one of our own errors in words or a result, never another exception; one line for each thing that
is wrong; and no more memory than the sound itself is worth, whatever a header promises.
"""

import json
import struct
import tracemalloc
from itertools import islice

import numpy as np
import pytest
import soundfile
from hypothesis import HealthCheck, given
from hypothesis import settings as examples
from hypothesis import strategies as st

from locagen_edge.errors import LocagenError, SettingsError, SourceError
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, from_table, load, sample
from locagen_edge.stages.mic import wav_frames
from locagen_edge.types import Frame

MOST_BYTES = 100e6
"""that may be taken beyond what was there: a thousand times the sound that lies on the disk here"""

fuzzed = examples(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def little_memory():
    tracemalloc.start()
    yield
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < MOST_BYTES


def one_line_each(error):
    assert "Traceback" not in str(error)
    assert all(line.strip() for line in str(error).splitlines())


# --- settings


SAMPLE = sample().encode()


@fuzzed
@given(
    changes=st.lists(st.tuples(st.integers(0, len(SAMPLE) - 1), st.integers(0, 255)), max_size=8),
    cut=st.integers(0, len(SAMPLE)),
)
def test_a_settings_file_with_wrong_bytes_is_read_or_refused_in_words(tmp_path, changes, cut):
    data = bytearray(SAMPLE)
    for at, byte in changes:
        data[at] = byte
    path = tmp_path / "s.toml"
    path.write_bytes(data[:cut])
    try:
        assert isinstance(load(path), Settings)
    except SettingsError as error:
        one_line_each(error)


NUMBERS = {
    ("audio", "rate_hz"): st.integers(4000, 96_000),
    ("audio", "frame"): st.sampled_from([256, 512, 1024, 2048, 4096]),
    ("audio", "hop"): st.integers(32, 4096),
    ("correlation", "oversample"): st.integers(4, 64),
    ("correlation", "floor_dbfs"): st.floats(-200, -1),
    ("correlation", "relative_floor_db"): st.floats(-120, -1),
    ("correlation", "band_hz"): st.tuples(st.floats(1, 3000), st.floats(1, 48_000)).map(list),
    ("array", "positions_m"): st.lists(
        st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3), min_size=3, max_size=3
    ),
    ("array", "tolerance_m"): st.floats(0, 0.1),
    ("array", "delays_s"): st.lists(st.floats(-0.005, 0.005), min_size=3, max_size=3),
    ("array", "gains_db"): st.lists(st.floats(-40, 40), min_size=3, max_size=3),
    ("environment", "temperature_c"): st.floats(-60, 60),
    ("bearing", "estimator"): st.sampled_from(["steered", "far-field", "hyperbolic", "two-mic"]),
    ("steered", "taper"): st.floats(0, 1),
    ("steered", "smooth_bins"): st.integers(0, 64),
    ("steered", "smear"): st.floats(0, 1),
    ("track", "most"): st.integers(1, 8),
}


@fuzzed
@given(
    values=st.fixed_dictionaries({}, optional=NUMBERS),
    loud=st.sampled_from([0.0, 1e-6, 0.1, 1.0, 1e6, np.inf, np.nan]),
)
def test_what_the_ranges_allow_makes_a_pipeline_that_bears_any_sound(values, loud):
    table = {}
    for (section, key), value in values.items():
        table.setdefault(section, {})[key] = value
    try:
        settings = from_table(table)
        pipeline = Pipeline(settings)
    except LocagenError as error:
        one_line_each(error)
        return
    audio = settings.audio
    noise = np.random.default_rng(0).standard_normal((3, audio.frame)).astype(np.float32)
    for number in range(3):
        with np.errstate(invalid="ignore"):
            samples = noise * np.float32(loud)
        start = number * audio.hop
        frame = Frame(samples, float(audio.rate_hz), round(start * 1e9 / audio.rate_hz), start)
        assert pipeline.process(frame).start == start


# --- recordings


def a_wav(path):
    soundfile.write(path, np.random.default_rng(0).uniform(-0.5, 0.5, (6000, 3)), 10_000, subtype="PCM_16")
    return bytearray(path.read_bytes())


def played(path):
    """What can be had of it: frames, or one line that names the file."""
    try:
        frames = list(islice(wav_frames(path, Settings()), 100))
    except SourceError as refused:
        message, frames = str(refused), None
    if frames is None:
        assert message.startswith(str(path.parent))
        assert "\n" not in message
        return None
    for frame in frames:
        assert frame.samples.shape == (3, 1024)
    return frames


FIELDS = {"H": [20, 22, 32, 34], "I": [4, 16, 24, 28, 40]}
"""of a plain WAV header: format, channels, block align, bits; sizes, rate, byte rate"""
EXTREMES = [0, 1, 2, 3, 7, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers that are none, converted
@fuzzed
@given(
    changes=st.lists(
        st.tuples(
            st.sampled_from([(kind, at) for kind, places in FIELDS.items() for at in places]),
            st.sampled_from(EXTREMES) | st.integers(0, 2**32 - 1),
        ),
        min_size=1,
        max_size=4,
    ),
    cut=st.integers(0, 36_044) | st.none(),
)
def test_a_header_that_lies_is_refused_or_played_as_far_as_it_goes(tmp_path, changes, cut):
    path = tmp_path / "a.wav"
    data = a_wav(path)
    for (kind, at), value in changes:
        size = struct.calcsize(kind)
        data[at : at + size] = struct.pack(f"<{kind}", value % 2 ** (8 * size))
    path.write_bytes(data[:cut])
    played(path)


@fuzzed
@given(st.lists(st.tuples(st.integers(0, 60), st.integers(0, 255)), min_size=1, max_size=12))
def test_a_header_with_wrong_bytes_is_refused_or_played(tmp_path, changes):
    path = tmp_path / "a.wav"
    data = a_wav(path)
    for at, byte in changes:
        data[at] = byte
    path.write_bytes(data)
    played(path)


@pytest.mark.parametrize("rate", [1_000_001, 2**31 - 1])
def test_a_rate_that_no_converter_has_is_refused(tmp_path, rate):
    path = tmp_path / "a.wav"
    data = a_wav(path)
    data[24:28] = struct.pack("<I", rate)
    path.write_bytes(data)
    assert played(path) is None


JSON_NUMBERS = (
    st.integers(-(2**70), 2**70)
    | st.floats()
    | st.sampled_from([None, True, "", "s", "2026-01-01T00:00:00Z"])
)
RECORDS = st.fixed_dictionaries(
    {"type": st.sampled_from(["part", "block", "gap", "pose", "bearing", 3, None])},
    optional={
        "rows": JSON_NUMBERS, "origin_ns": JSON_NUMBERS, "overruns": JSON_NUMBERS, "row": JSON_NUMBERS,
        "session": JSON_NUMBERS, "utc": JSON_NUMBERS, "t_ns": JSON_NUMBERS,
        "attitude": st.lists(JSON_NUMBERS, max_size=5),
    },
)  # fmt: skip


@fuzzed
@given(st.lists(RECORDS, max_size=8), st.booleans())
def test_records_beside_a_recording_may_be_anything(tmp_path, records, ours):
    path = tmp_path / "a.wav"
    a_wav(path)
    lines = [{"type": "part", "session": "s", "row": 0}, *records] if ours else records
    path.with_suffix(".blocks.jsonl").write_text("\n".join(map(json.dumps, lines)))
    played(path)
