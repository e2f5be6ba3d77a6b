"""Laws of parameters: limits hold, each SET is answered, and what was set outlives a restart."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common
from test_component import QUIET, decode, said, texts

from locagen_edge.errors import SettingsError
from locagen_edge.mavlink import parameters
from locagen_edge.mavlink.build_docs import with_tables
from locagen_edge.mavlink.component import Component, Hands
from locagen_edge.mavlink.parameters import (
    NAMES,
    TABLE,
    field_of,
    keep,
    kept,
    kept_file,
    value_of,
    with_value,
)
from locagen_edge.settings import MavlinkSettings, Settings, from_table

REAL32 = common.MAV_PARAM_TYPE_REAL32


def packed(message: Any, system: int = 255, component: int = 190) -> bytes:
    return bytes(message.pack(common.MAVLink(None, system, component)))


def setting(name: str, value: float, kind: int = REAL32, system: int = 1, component: int = 191) -> bytes:
    return packed(common.MAVLink_param_set_message(system, component, name.encode(), value, kind))


def answers(component: Component, link: int = 0) -> list[Any]:
    return decode(component.answers(link))


def test_names_fit_and_what_acts_on_flight_is_no_parameter() -> None:
    for name in NAMES:
        assert len(name.encode("ascii")) <= 16
        assert not TABLE[name].startswith("flight.")
        assert math.isfinite(value_of(Settings(), name))
        assert struct.unpack("<f", struct.pack("<f", value_of(Settings(), name)))[0] == pytest.approx(
            value_of(Settings(), name), rel=1e-6
        )
    assert len(set(TABLE.values())) == len(TABLE)


@given(st.sampled_from(NAMES), st.floats(width=32))
def test_a_set_is_answered_and_the_value_is_within_the_settings_limits(name: str, value: float) -> None:
    component = Component(MavlinkSettings())
    before = value_of(component.settings, name)
    component.receive(setting(name, value), 0.0)
    (answer,) = answers(component)
    assert (answer.get_type(), answer.param_id, answer.param_type) == ("PARAM_VALUE", name, REAL32)
    meta, default = field_of(name).metadata, value_of(Settings(), name)
    assert max(meta["least"], -1e30) <= value_of(component.settings, name) <= min(meta["most"], 1e30)
    assert answer.param_value == np.float32(value_of(component.settings, name))
    told = texts(said(component, QUIET, 1))
    if answer.param_value != np.float32(value):
        assert value_of(component.settings, name) == before == default
        assert told[0].startswith(name), "why it was refused"
        assert len("".join(told)) < 199
    else:
        assert told == []


def test_a_set_holds_as_the_shortest_decimal() -> None:
    component = Component(MavlinkSettings())
    component.receive(setting("LG_TRK_COAST", 0.1), 0.0)
    assert component.settings.track.coast_s == 0.1


def test_one_number_of_a_list_is_set_and_the_others_stay() -> None:
    settings = from_table({"array": {"mount_deg": [1.0, 2.0, 3.0]}})
    assert with_value(settings, "LG_ARRAY_YAW", -30.0).array.mount_deg == (1.0, 2.0, -30.0)


@pytest.mark.parametrize(("name", "value"), [("LG_TX_ADSB", 0.5), ("LG_TX_ADSB", 2), ("LG_TRK_MOST", 2.5)])
def test_switches_and_counts_are_whole(name: str, value: float) -> None:
    with pytest.raises(SettingsError):
        with_value(Settings(), name, value)


def test_a_type_that_is_not_float_is_refused() -> None:
    component = Component(MavlinkSettings())
    component.receive(setting("LG_TRK_MOST", 2.0, common.MAV_PARAM_TYPE_INT32), 0.0)
    assert answers(component)[0].param_value == 4.0


def test_who_asks_again_and_again_is_told_once() -> None:
    component = Component(MavlinkSettings())
    for k in range(6):
        component.receive(setting("LG_TRK_COAST", 1e6), 0.5 * k)
    assert len(answers(component)) == 6
    assert texts(said(component, QUIET, 5)) == ["LG_TRK_COAST: 1000000.0 s is outside 0.1 to 600 s"]


def test_only_our_own_ids_are_obeyed() -> None:
    component = Component(MavlinkSettings())
    for system, target in ((1, 1), (1, 0), (0, 191), (0, 0), (2, 191)):
        component.receive(setting("LG_TRK_COAST", 9.0, system=system, component=target), 0.0)
        read = common.MAVLink_param_request_read_message(system, target, b"LG_TRK_COAST", -1)
        component.receive(packed(read), 0.0)
    assert answers(component) == []
    assert component.settings == Settings()


def test_read_by_name_and_by_index_give_the_same_and_unknown_ones_nothing() -> None:
    component = Component(MavlinkSettings())
    for index, name in enumerate(NAMES):
        component.receive(packed(common.MAVLink_param_request_read_message(1, 191, name.encode(), -1)), 0.0)
        component.receive(packed(common.MAVLink_param_request_read_message(1, 191, b"", index)), 0.0)
        one, other = answers(component)
        assert str(one) == str(other)
        assert (one.param_id, one.param_index, one.param_count) == (name, index, len(NAMES))
    for name, index in ((b"NONE", -1), (b"", len(NAMES)), (b"\xff\xfe", -1)):
        component.receive(packed(common.MAVLink_param_request_read_message(1, 191, name, index)), 0.0)
    assert answers(component) == []


@pytest.mark.parametrize("target", [191, 0])
def test_the_list_is_whole_paced_and_goes_to_the_link_that_asked(target: int) -> None:
    component = Component(MavlinkSettings())
    component.receive(packed(common.MAVLink_param_request_list_message(1, target)), 0.0, link=2)
    got: list[tuple[float, Any]] = []
    for tick in range(100):
        now_s = 0.1 * tick
        component.due(now_s, QUIET)
        got += [(now_s, m) for m in answers(component, 2)]
        assert answers(component, 0) == []
    assert [m.param_index for _, m in got] == list(range(len(NAMES)))
    assert got[-1][0] >= (len(NAMES) - 8) / parameters.PER_S, "not faster than a slow link bears"
    assert got[-1][0] <= 1.0 + len(NAMES) / parameters.PER_S


def test_a_list_for_another_component_is_not_ours() -> None:
    component = Component(MavlinkSettings())
    for system, target in ((1, 1), (7, 0), (0, 0)):
        component.receive(packed(common.MAVLink_param_request_list_message(system, target)), 0.0)
    component.due(1.0, QUIET)
    assert answers(component) == []


@given(st.integers(0, 65535), st.integers(0, 255), st.integers(0, 255))
def test_files_are_refused_and_refusals_are_not(sequence: int, session: int, opcode: int) -> None:
    component = Component(MavlinkSettings())
    payload = struct.pack("<HBB", sequence, session, opcode).ljust(251, b"\0")
    component.receive(packed(common.MAVLink_file_transfer_protocol_message(0, 1, 191, payload)), 0.0)
    got = answers(component)
    if opcode >= 128:  # an answer: two who refuse each other's refusals would never end
        assert got == []
        return
    (answer,) = got
    assert (answer.target_system, answer.target_component) == (255, 190)
    head = struct.unpack_from("<HBBBB", bytes(answer.payload))
    assert head == ((sequence + 1) % 65536, session, 129, 1, opcode)


def test_the_daemon_is_told_once_of_each_change_and_of_nothing_else() -> None:
    told: list[Settings] = []
    component = Component(MavlinkSettings(), hands=Hands(apply=told.append))
    for value in (3.0, 3.0, 1e9, 4.0):
        component.receive(setting("LG_TRK_COAST", value), 0.0)
    assert [s.track.coast_s for s in told] == [3.0, 4.0]


def test_what_cannot_be_applied_is_put_back_and_told() -> None:
    component = Component(MavlinkSettings())
    before = component.settings
    component.receive(setting("LG_RATE", 5.0), 0.0)
    answers(component)
    component.put_back(before, "Not applied: no reason")
    (answer,) = answers(component)
    assert (answer.param_id, answer.param_value) == ("LG_RATE", 2.0)
    assert texts(said(component, QUIET, 1)) == ["Not applied: no reason"]


def test_the_rate_of_values_follows_at_once() -> None:
    from test_component import CALLING

    component = Component(MavlinkSettings())
    component.receive(setting("LG_RATE", 5.0), 0.0)
    rates = [m for m in said(component, CALLING, 10) if m.get_type() == "NAMED_VALUE_FLOAT"]
    assert len([m for m in rates if m.name == "LG_AZB"]) == 50


def test_the_tables_in_the_documentation_are_made_from_the_code() -> None:
    document = (ROOT / "docs/mavlink.md").read_text(encoding="utf-8")
    assert with_tables(document) == document, "make format"
    assert all(f"`{name}`" in document for name in NAMES)
    with pytest.raises(SystemExit, match="the document has no"):
        with_tables("no marks")


# --- kept over restarts -------------------------------------------------------------------------------


@given(st.dictionaries(st.sampled_from(NAMES), st.floats(0, 1, width=32)))
def test_what_is_kept_is_what_comes_back(tmp_path_factory, values: dict[str, float]) -> None:
    base = from_table({"mavlink": {"state_directory": str(tmp_path_factory.mktemp("state"))}})
    component = Component(base.mavlink, whole=base)
    for name, value in values.items():
        component.receive(setting(name, value), 0.0)
    keep(kept_file(base), component.parameters.changed)
    settings, told, faults = kept(base)
    assert settings == component.settings
    assert len(told) == len(component.parameters.changed)
    assert faults == []
    assert kept_file(base).exists() == bool(component.parameters.changed), "nothing changed, nothing kept"


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"LG_TRK_COAST = ", "cannot be understood"),
        (b"\xff", "cannot be understood"),
        (b"LG_TRK_COAST = 1e9\n", "outside"),
        (b"LG_TRK_COAST = nan\n", "not a finite"),
        (b"LG_TRK_COAST = 1e400\n", "not a finite"),
        (b"LG_TRK_COAST = 'x'\n", "no number"),
        (b"LG_TX_ADSB = true\n", "no number"),
        (b"[flight]\nroi = true\n", "no parameter"),
        (b'"flight.roi" = 1\n', "no parameter"),
    ],
)
def test_a_damaged_file_is_told_and_changes_nothing(tmp_path, content: bytes, fault: str) -> None:
    base = from_table({"mavlink": {"state_directory": str(tmp_path)}})
    kept_file(base).write_bytes(content)
    settings, told, faults = kept(base)
    assert settings == base
    assert told == []
    assert len(faults) == 1
    assert fault in faults[0]
    assert "delete" in faults[0]


def test_what_may_not_be_read_is_told_with_what_to_do(tmp_path, monkeypatch) -> None:
    """The service's file, by hand as another user."""
    base = from_table({"mavlink": {"state_directory": str(tmp_path)}})

    def refused(self: Path, encoding: str) -> str:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "read_text", refused)
    settings, told, (fault,) = kept(base)
    assert (settings, told) == (base, [])
    assert "what was set over MAVLink does not hold here: as root, or the user locagen-edge" in fault


def test_a_good_line_counts_beside_a_bad_one(tmp_path) -> None:
    base = from_table({"mavlink": {"state_directory": str(tmp_path)}})
    kept_file(base).write_text("LG_OLD = 1\nLG_TRK_COAST = 3\n")
    settings, told, faults = kept(base)
    assert settings.track.coast_s == 3.0
    assert told == [f"track.coast_s is 3, not 2: LG_TRK_COAST in {tmp_path}/parameters.toml"]
    assert len(faults) == 1
