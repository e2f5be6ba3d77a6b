"""The module for MAVProxy: what it draws and lists of what it hears, without a display."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from locagen_edge.mavlink import dialect
from locagen_edge.mavlink.records import BearingRecord, PositionRecord, bearing_message, position_message
from locagen_edge.types import Pose

pytestmark = pytest.mark.filterwarnings("ignore")  # of other people's code

pytest.importorskip("MAVProxy", reason="needs MAVProxy (extra: dev)")

from locagen_edge import mavproxy_locagen as ours  # noqa: E402

HERE = (47.0, 8.0)
BEARING = BearingRecord(
    time_us=1,
    autopilot_time=True,
    event_id=4,
    azimuth_true_rad=math.radians(90.0),
    azimuth_sigma_rad=math.radians(3.0),
    confidence=0.9,
    confirmed=True,
    pose=Pose(0, None, *HERE),
)
POSITION = PositionRecord(
    time_us=1,
    autopilot_time=True,
    event_id=4,
    latitude_deg=47.001,
    longitude_deg=8.002,
    altitude_m=None,
    covariance_m2=(100.0, 0.0, 25.0),
    age_s=1.0,
    looks=5,
)


class Map:
    def __init__(self) -> None:
        self.shapes: dict[str, Any] = {}
        self.map = SimpleNamespace(add_object=self._add)

    def _add(self, shape: Any) -> None:
        if hasattr(shape, "points"):
            self.shapes[shape.key] = shape
        else:
            self.shapes.clear()


def loaded(*, with_map: bool = True) -> tuple[ours.Locagen, Map]:
    drawn = Map()
    modules = {"map": drawn} if with_map else {}
    state = SimpleNamespace(
        public_modules=modules, module=modules.get, command_map={}, completions={}, multi_instance={}
    )
    return ours.init(state), drawn


def arrived(message: Any, *, tunnel: bool) -> Any:
    """As MAVProxy hands it on, with pymavlink's own dialect."""
    sender = dialect.Sender(7, 191)
    peer = common.MAVLink(None)
    (m,) = peer.parse_buffer(sender.pack(dialect.tunnel(message) if tunnel else message))
    return m


@pytest.mark.parametrize("tunnel", [True, False])
def test_a_bearing_is_a_line_with_its_sigma_and_an_event(tunnel: bool) -> None:
    module, drawn = loaded()
    module.mavlink_packet(arrived(bearing_message(BEARING), tunnel=tunnel))
    assert set(drawn.shapes) == {"bearing7.4", "bearing7.4left", "bearing7.4right"}
    (here, there) = drawn.shapes["bearing7.4"].points
    assert here == pytest.approx(HERE)
    assert there[0] == pytest.approx(47.0, abs=1e-7)
    east_m = math.radians(there[1] - 8.0) * ours.EARTH_M * math.cos(math.radians(47.0))
    assert east_m == pytest.approx(module.length_m, rel=1e-6)
    left, right = (drawn.shapes[f"bearing7.4{side}"].points[1] for side in ("left", "right"))
    assert left[0] > there[0] > right[0], "left of east is north"
    (line,) = module.lines()
    assert line.startswith("vehicle 7 call 4 confirmed: 090 deg true +-3, 1 bearings")


@pytest.mark.parametrize("tunnel", [True, False])
def test_a_position_is_an_ellipse(tunnel: bool) -> None:
    module, drawn = loaded()
    module.mavlink_packet(arrived(position_message(POSITION), tunnel=tunnel))
    points = np.array(drawn.shapes["place7.4"].points)
    assert np.allclose(points[0], points[-1], atol=1e-12)
    metres = np.radians(points - (47.001, 8.002)) * ours.EARTH_M * (1.0, math.cos(math.radians(47.001)))
    assert np.abs(metres).max(axis=0) == pytest.approx([2.448 * 10.0, 2.448 * 5.0], rel=1e-3)
    assert "at 47.001000 8.002000" in module.lines()[0]


@given(*[st.floats(0.1, 1e4)] * 2, st.floats(-0.99, 0.99))
def test_every_point_of_the_ellipse_is_as_likely(nn: float, ee: float, tilt: float) -> None:
    ne = tilt * math.sqrt(nn * ee)
    inverse = np.linalg.inv([[nn, ne], [ne, ee]])
    for latitude, longitude in ours.ellipse((0.0, 0.0), nn, ne, ee):
        at = np.radians([latitude, longitude]) * ours.EARTH_M
        assert at @ inverse @ at == pytest.approx(ours.SURE**2, rel=1e-3)


def test_what_has_no_place_or_no_direction_is_listed_and_not_drawn() -> None:
    for record in (
        BearingRecord(time_us=1, autopilot_time=True, event_id=4, azimuth_body_rad=1.0),
        BearingRecord(time_us=1, autopilot_time=True, event_id=4, azimuth_true_rad=1.0),
    ):
        module, drawn = loaded()
        module.mavlink_packet(arrived(bearing_message(record), tunnel=True))
        assert drawn.shapes == {}
        assert len(module.lines()) == 1


def test_what_two_microphones_hear_is_listed_as_ambiguous() -> None:
    module, _ = loaded()
    module.mavlink_packet(arrived(bearing_message(replace(BEARING, ambiguous=True)), tunnel=True))
    assert "090 deg true +-3 or its mirror image" in module.lines()[0]


def test_nothing_heard_and_other_messages_are_no_events() -> None:
    module, drawn = loaded()
    module.mavlink_packet(
        arrived(bearing_message(BearingRecord(time_us=1, autopilot_time=False, event_id=0)), tunnel=True)
    )
    module.mavlink_packet(arrived(dialect.heartbeat(4), tunnel=False))
    module.mavlink_packet(common.MAVLink_tunnel_message(0, 0, 59500, 255, bytes(128)))
    module.mavlink_packet(common.MAVLink_tunnel_message(0, 0, 7, 10, bytes(128)))
    assert module.lines() == []
    assert drawn.shapes == {}


def test_without_a_map_it_lists(capsys: pytest.CaptureFixture[str]) -> None:
    module, _ = loaded(with_map=False)
    module.command([])
    module.mavlink_packet(arrived(bearing_message(BEARING), tunnel=True))
    module.command(["events"])
    module.command(["clear"])
    module.command(["length", "none"])
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "no call so far"
    assert told[1] == "locagen: call 4 of vehicle 7"
    assert told[2].startswith("vehicle 7 call 4")
    assert told[3].startswith("Usage")
    assert module.lines() == []


def test_memory_is_bounded_and_clear_clears_the_map() -> None:
    module, drawn = loaded()
    module.command(["length", "50"])
    for number in range(1, 300):
        record = bearing_message(BearingRecord(time_us=1, autopilot_time=True, event_id=number))
        module.mavlink_packet(arrived(record, tunnel=True))
    assert len(module.lines()) == ours.EVENTS
    module.mavlink_packet(arrived(bearing_message(BEARING), tunnel=True))
    assert drawn.shapes
    assert module.length_m == 50.0
    module.command(["clear"])
    assert (module.lines(), drawn.shapes) == ([], {})
