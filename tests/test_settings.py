"""Settings: what is refused, and that the sample file is the truth."""

from __future__ import annotations

import dataclasses
import tomllib

import pytest
from conftest import ROOT
from hypothesis import example, given, reject
from hypothesis import strategies as st

from locagen_edge.errors import SettingsError
from locagen_edge.settings import Settings, from_table, load, sample


def faults(table: dict) -> list[str]:
    with pytest.raises(SettingsError) as caught:
        from_table(table)
    return str(caught.value).splitlines()


def test_the_sample_file_is_the_defaults_and_up_to_date():
    path = ROOT / "systemd" / "locagen-edge.toml"
    assert path.read_text() == sample()
    assert load(path) == Settings()


def test_every_key_of_the_sample_is_explained():
    lines = sample().splitlines()
    for number, line in enumerate(lines):
        if " = " in line and not line.startswith(("#", " ")):
            assert lines[number - 1].startswith("# "), line


def test_the_sample_of_changed_settings_reads_back_as_those():
    changed = from_table({"audio": {"hop": 256, "loop": True}, "array": {"tolerance_m": 0}})
    assert from_table(tomllib.loads(sample(changed))) == changed


FREE = [
    (section.name, key.name)
    for section in dataclasses.fields(Settings)
    for key in dataclasses.fields(section.default)
    if type(key.default) is str and not (key.metadata["pattern"] or key.metadata["choices"])
]


@given(
    st.dictionaries(st.sampled_from(FREE), st.text()),
    st.lists(st.from_regex(r"udpout:[^:\s]+:14550", fullmatch=True), min_size=1, max_size=8, unique=True),
)
@example({("audio", "device"): 'Mic "A" \\ b\r\n\x7f\x85\u2028'}, ['udpout:a"\\:14550'])
def test_the_sample_of_any_text_reads_back_as_it(texts, links):
    table: dict = {"mavlink": {"link": links}}
    for (section, key), text in texts.items():
        table.setdefault(section, {})[key] = text
    try:
        settings = from_table(table)
    except SettingsError:
        reject()
    assert from_table(tomllib.loads(sample(settings))) == settings


TRIANGLE = [[0.05, 0, 0], [-0.03, 0.05, 0], [-0.03, -0.05, 0]]
BAD = {
    "unknown section": ({"arrya": {}}, "arrya: unknown section"),
    "unknown key": ({"audio": {"hopp": 1}}, "audio.hopp: unknown key"),
    "old key": (
        {"mavlink": {"signing_state": "/tmp"}},
        "mavlink.signing_state: is called mavlink.state_directory now",
    ),
    "section as value": ({"audio": 3}, "audio: is a section"),
    "text for number": ({"audio": {"hop": "512"}}, "audio.hop: '512' is not a whole number"),
    "float for int": ({"audio": {"hop": 512.0}}, "audio.hop: 512.0 is not a whole number"),
    "bool for int": ({"audio": {"hop": True}}, "audio.hop: True is not a whole number"),
    "number for list": ({"audio": {"channel_map": 1}}, "audio.channel_map: 1 is not a list"),
    "out of range": ({"audio": {"rate_hz": 100}}, "audio.rate_hz: 100 Hz is outside 4000 to 96000 Hz"),
    "not a number": ({"environment": {"temperature_c": float("nan")}}, "environment.temperature_c: nan"),
    "infinite": ({"sim": {"distance_m": float("inf")}}, "sim.distance_m: inf"),
    "choice": ({"audio": {"source": "mic"}}, "audio.source: 'mic' is none of alsa, wav, sim"),
    "estimator": ({"bearing": {"estimator": "best"}}, "bearing.estimator: 'best'"),
    "link": ({"mavlink": {"link": "udp:14550"}}, "mavlink.link: 'udp:14550'"),
    "frame": ({"audio": {"frame": 1000}}, "audio.frame: 1000 is not a power of two"),
    "hop over frame": ({"audio": {"hop": 2048}}, "audio.hop: 2048 is longer than audio.frame"),
    "channel twice": ({"audio": {"channel_map": [0, 1, 1]}}, "audio.channel_map: [0, 1, 1] names a channel"),
    "channel count": ({"audio": {"channel_map": [0, 1]}}, "audio.channel_map: 2 channels, but array"),
    "channel beyond device": (
        {"audio": {"source": "alsa", "channel_map": [0, 1, 3]}},
        "audio.channel_map: names channel 3, but audio.device_channels is 3",
    ),
    "wav without file": ({"audio": {"source": "wav"}}, "audio.file: is empty"),
    "band upside down": ({"correlation": {"band_hz": [4000, 300]}}, "correlation.band_hz: [4000.0, 300.0]"),
    "band of three": ({"correlation": {"band_hz": [300, 400, 500]}}, "correlation.band_hz:"),
    "band over Nyquist": ({"correlation": {"band_hz": [300, 6000]}}, "correlation.band_hz: 6000 Hz"),
    "band too narrow": (
        {"correlation": {"band_hz": [300, 320]}},
        "correlation.band_hz: [300.0, 320.0]",
    ),
    "two coordinates": ({"array": {"positions_m": [[0, 0], [0, 1], [1, 0]]}}, "array.positions_m: every row"),
    "mount": ({"array": {"mount_deg": [0, 90]}}, "array.mount_deg: [0.0, 90.0] is not roll, pitch, yaw"),
    "mount on its side": ({"array": {"mount_deg": [90, 0, 0]}}, "array.positions_m: seen from above"),
    "mount of no number": ({"array": {"mount_deg": [0, 0, float("nan")]}}, "array.mount_deg: nan"),
    "one microphone": (
        {"array": {"positions_m": [[0, 0, 0]]}, "audio": {"channel_map": [0]}},
        "array.positions_m: 1 microphones; 2 to 8",
    ),
    "taken for 0 dB": ({"correlation": {"floor_dbfs": 0}}, "correlation.floor_dbfs: 0.0 dBFS is outside"),
    "Nyquist to rounding": ({"correlation": {"band_hz": [300, 4999.9999]}}, "correlation.band_hz: 5000 Hz"),
    "coarse grid": ({"correlation": {"oversample": 2}}, "correlation.oversample: 2 points is outside"),
    "a number without end": ({"sim": {"distance_m": 10**400}}, "sim.distance_m: inf is not"),
    "port": ({"mavlink": {"link": "tcp:127.0.0.1:99999"}}, "mavlink.link: port 99999 is not"),
    "port 0": ({"mavlink": {"link": "udpin:0.0.0.0:0"}}, "mavlink.link: port 0 is not"),
    "no link": ({"mavlink": {"link": []}}, "mavlink.link: 0 links; 1 to 8"),
    "a link twice": (
        {"mavlink": {"link": ["tcp:a:1", "tcp:a:1"]}},
        "mavlink.link: 'tcp:a:1' is there twice",
    ),
    "one link of two": ({"mavlink": {"link": ["tcp:a:1", "udp:b"]}}, "mavlink.link: 'udp:b'"),
    "baud": ({"mavlink": {"link": "serial:/dev/ttyS0:99999999"}}, "mavlink.link: baud rate 99999999"),
    "stall under a hop": (
        {
            "audio": {"rate_hz": 4000, "frame": 4096, "hop": 4096},
            "daemon": {"stall_s": 0.5},
            "correlation": {"band_hz": [300, 1900]},
        },
        "daemon.stall_s: 0.5 s is less than two hops",
    ),
    "delays for others": ({"array": {"delays_s": [0, 1e-5]}}, "array.delays_s: 2 numbers for 3 microphones"),
    "gains for others": ({"array": {"gains_db": [1]}}, "array.gains_db: 1 numbers for 3 microphones"),
    "later than can be": ({"array": {"delays_s": [0, 0, 1]}}, "array.delays_s: 1.0 s is outside"),
    "upright pair": (
        {
            "array": {"positions_m": [[0, 0, 0], [0, 0, 0.1]]},
            "audio": {"channel_map": [0, 1]},
            "bearing": {"estimator": "two-mic"},
        },
        "array.positions_m: the first two stand one above the other",
    ),
    "learned on a line": (
        {
            "array": {"positions_m": [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]},
            "bearing": {"estimator": "model:x"},
        },
        "array.positions_m: seen from above",
    ),
    "same place": (
        {"array": {"positions_m": [TRIANGLE[0], TRIANGLE[1], TRIANGLE[1]]}},
        "array.positions_m: microphones 1 and 2 are at the same place",
    ),
    "on a line": (
        {"array": {"positions_m": [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]}},
        "array.positions_m: seen from above the microphones are on one line",
    ),
    "upright plane": (
        {"array": {"positions_m": [[0, 0, 0], [0.1, 0, 0], [0, 0, 0.1]]}},
        "array.positions_m: seen from above the microphones are on one line",
    ),
    "array too large": (
        {"array": {"positions_m": [[0, 0, 0], [10, 0, 0], [0, 10, 0]]}},
        "array.positions_m: a longest delay of",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_settings_are_refused_by_name(name):
    table, beginning = BAD[name]
    assert any(line.startswith(beginning) for line in faults(table)), faults(table)


def test_all_faults_are_told_at_once():
    found = faults({"audio": {"hop": "a", "frame": 1000}, "zzz": {}, "sim": {"rotors": 99}})
    assert {line.split(":")[0] for line in found} == {"audio.hop", "audio.frame", "zzz", "sim.rotors"}


def test_two_microphones_on_a_line_are_fine_for_the_two_microphone_estimator():
    settings = from_table(
        {
            "array": {"positions_m": [[0, -0.05, 0], [0, 0.05, 0]]},
            "audio": {"channel_map": [0, 1]},
            "bearing": {"estimator": "two-mic"},
        }
    )
    assert settings.mic_array.mics == 2


JSONISH = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
KEYS = [
    (section, key) for section, keys in tomllib.loads(sample()).items() for key in keys
]  # every key of the sample


@given(st.dictionaries(st.sampled_from(KEYS), JSONISH, max_size=4))
def test_any_value_is_taken_or_refused_in_words(values):
    table: dict = {}
    for (section, key), value in values.items():
        table.setdefault(section, {})[key] = value
    try:
        settings = from_table(table)
    except SettingsError as refused:
        lines = str(refused).splitlines()
    else:
        lines = []
        assert isinstance(settings, Settings)
    assert all(": " in line for line in lines)


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"[audio\n", "is not TOML"), (b"\xff\xfe", "is not TOML"), (None, "cannot be read")],
)
def test_unreadable_files_are_told_in_one_line(tmp_path, content, says):
    path = tmp_path / "s.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SettingsError, match=says) as caught:
        load(path)
    assert len(str(caught.value).splitlines()) == 1
    assert str(path) in str(caught.value)


def test_one_link_may_be_written_without_brackets():
    one, many = "udpin:0.0.0.0:14550", ["udpin:0.0.0.0:14550", "serial:/dev/ttyAMA0:921600"]
    assert from_table({"mavlink": {"link": one}}).mavlink.link == (one,)
    assert from_table({"mavlink": {"link": many}}).mavlink.link == tuple(many)


def test_a_mounted_array_is_where_the_vehicle_has_it():
    """Turned a quarter clockwise, what the array has ahead is on the right; leaning back, it is up."""
    ahead = [[0.1, 0, 0], [0, 0.1, 0], [0, -0.1, 0]]
    clockwise = from_table({"array": {"positions_m": ahead, "mount_deg": [0, 0, 90]}}).mic_array
    assert clockwise.positions_m[0] == pytest.approx([0.0, 0.1, 0.0])
    assert clockwise.positions_m[1] == pytest.approx([-0.1, 0.0, 0.0])
    back = from_table({"array": {"positions_m": ahead, "mount_deg": [0, 30, 0]}}).mic_array
    assert back.positions_m[0] == pytest.approx([0.0866, 0.0, -0.05], abs=1e-4)
