"""New settings between two frames: what was learnt stays, what follows from the settings changes at once."""

from __future__ import annotations

import asyncio
import socket
from dataclasses import replace

import numpy as np
import pytest
from pymavlink.dialects.v20 import common
from scenes import cut, heard
from test_daemon import running, source, until, with_link

from locagen_edge.check import check
from locagen_edge.daemon import Daemon
from locagen_edge.errors import ModelError, SettingsError
from locagen_edge.geometry import compass_deg
from locagen_edge.mavlink.framer import Framer
from locagen_edge.mavlink.parameters import keep, kept, kept_file
from locagen_edge.pipeline import Pipeline
from locagen_edge.settings import Settings, from_table
from locagen_edge.store.journal import records
from locagen_edge.types import Frame

STEERED = from_table({"bearing": {"estimator": "steered"}})
FAR_FIELD = from_table({"bearing": {"estimator": "far-field"}})


def noise(settings: Settings, seconds: float, seed: int = 0) -> np.ndarray:
    shape = (3, round(seconds * settings.audio.rate_hz))
    return (0.005 * np.random.default_rng(seed).standard_normal(shape)).astype(np.float32)


def with_call(settings: Settings, quiet_s: float = 4.0, call_s: float = 1.0) -> list[Frame]:
    call = heard(settings, 1.0, -0.3, 20.0, round(call_s * settings.audio.rate_hz))
    return cut(settings, np.concatenate([noise(settings, quiet_s), call], axis=1))


def changed(settings: Settings, **sections: dict[str, object]) -> Settings:
    return replace(
        settings, **{name: replace(getattr(settings, name), **keys) for name, keys in sections.items()}
    )


def test_a_threshold_changes_no_learnt_noise() -> None:
    pipeline, untouched = Pipeline(STEERED), Pipeline(STEERED)
    for frame in cut(STEERED, noise(STEERED, 4.0)):
        pipeline.process(frame)
        untouched.process(frame)
    other = changed(
        STEERED,
        detection={"snr_db": 3.0, "background_s": 5.0},
        steered={"span_s": 1.0, "forget_s": 2.0, "weigh": False},
        track={"coast_s": 1.0, "most": 2},
        pose={"compass_deg": 5.0},
        mavlink={"rate_hz": 5.0},
    )
    pipeline.apply(other)
    learnt, before = pipeline._locate._search.noise(), untouched._locate._search.noise()
    assert np.array_equal(learnt, before)
    assert np.abs(learnt).max() > 0
    assert pipeline._detect._minima == untouched._detect._minima


def test_a_limit_holds_from_the_next_frame_on() -> None:
    frames = with_call(FAR_FIELD)
    pipeline = Pipeline(FAR_FIELD)
    for frame in frames[:-4]:
        estimate = pipeline.process(frame)
    assert estimate.detection.call
    assert estimate.track is not None
    number = estimate.track.id
    pipeline.apply(changed(FAR_FIELD, detection={"snr_db": 60.0}))
    deaf = pipeline.process(frames[-4])
    assert not deaf.detection.call
    pipeline.apply(FAR_FIELD)
    again = pipeline.process(frames[-3])
    assert again.detection.call
    assert again.detection.snr_db == pytest.approx(deaf.detection.snr_db, abs=1.0), "the background stayed"
    assert again.track is not None
    assert again.track.id == number


@pytest.mark.parametrize("estimator", ["far-field", "hyperbolic", "two-mic", "steered"])
def test_the_arrays_yaw_turns_the_bearing(estimator: str) -> None:
    settings = from_table({"bearing": {"estimator": estimator}})
    turned = changed(settings, array={"mount_deg": (0.0, 0.0, 20.0)})
    frames = with_call(settings)
    fresh, applied = Pipeline(turned), Pipeline(settings)
    applied.apply(turned)
    for frame in frames:
        want, got = fresh.process(frame), applied.process(frame)
    assert (got.bearing.azimuth_rad, got.bearing.elevation_rad) == (
        want.bearing.azimuth_rad,
        want.bearing.elevation_rad,
    )
    plain = Pipeline(settings)
    for frame in frames:
        straight = plain.process(frame)
    assert straight.bearing.azimuth_rad is not None
    assert got.bearing.azimuth_rad is not None
    if estimator != "two-mic":  # which sees a line and not a circle
        by = compass_deg(got.bearing.azimuth_rad - straight.bearing.azimuth_rad)
        assert by == pytest.approx(20.0, abs=1.0)


def test_a_caller_keeps_its_number_when_the_array_is_turned() -> None:
    frames = with_call(FAR_FIELD)
    pipeline = Pipeline(FAR_FIELD)
    for frame in frames[:-1]:
        before = pipeline.process(frame)
    assert before.track is not None
    pipeline.apply(changed(FAR_FIELD, array={"mount_deg": (0.0, 0.0, 1.0)}))
    after = pipeline.process(frames[-1])
    assert after.track is not None
    assert after.track.id == before.track.id


def test_sound_of_another_shape_is_refused_and_nothing_changes() -> None:
    pipeline = Pipeline(FAR_FIELD)
    with pytest.raises(SettingsError, match="audio"):
        pipeline.apply(changed(FAR_FIELD, audio={"hop": 256}, detection={"snr_db": 60.0}))
    for frame in with_call(FAR_FIELD):
        estimate = pipeline.process(frame)
    assert estimate.detection.call


def test_what_cannot_be_made_changes_nothing() -> None:
    pipeline = Pipeline(FAR_FIELD)
    with pytest.raises(ModelError):
        pipeline.apply(changed(FAR_FIELD, bearing={"estimator": "model:none"}, detection={"snr_db": 60.0}))
    for frame in with_call(FAR_FIELD):
        estimate = pipeline.process(frame)
    assert estimate.detection.call
    assert estimate.bearing.estimator == "far-field"


def test_forgotten_noise_is_learnt_anew() -> None:
    pipeline = Pipeline(STEERED)
    frames = cut(STEERED, noise(STEERED, 4.0))
    for frame in frames:
        pipeline.process(frame)
    pipeline.forget_noise()
    assert np.abs(pipeline._locate._search.noise()).max() == 0
    assert pipeline.process(with_call(STEERED)[-1]).bearing.azimuth_rad is None, "nothing to whiten by yet"
    for frame in frames:
        pipeline.process(frame)
    assert np.abs(pipeline._locate._search.noise()).max() > 0


def test_noise_that_cannot_be_learnt_anew_is_not_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses(_: Settings) -> None:
        raise ModelError("model denoise-mask: the file is gone")

    kept, untouched = Pipeline(STEERED), Pipeline(STEERED)
    frames = cut(STEERED, noise(STEERED, 4.0))
    for frame in frames:
        kept.process(frame)
        untouched.process(frame)
    monkeypatch.setattr("locagen_edge.pipeline._made_denoiser", refuses)
    with pytest.raises(ModelError):
        kept.forget_noise()
    assert np.array_equal(kept._locate._search.noise(), untouched._locate._search.noise())
    assert kept._detect._minima == untouched._detect._minima


# --- in the daemon ------------------------------------------------------------------------------------


class Operator:
    """A ground station on a socket, that sets parameters and gives commands."""

    def __init__(self, server: socket.socket) -> None:
        self._server, self._mav, self._framer = server, common.MAVLink(None, 255, 190), Framer()
        self._peer: tuple[str, int] | None = None
        self.heard: list = []
        server.setblocking(False)

    def read(self) -> list:
        from locagen_edge.mavlink import dialect

        while True:
            try:
                data, self._peer = self._server.recvfrom(2048)
            except BlockingIOError:
                return self.heard
            self.heard += [dialect.decode(packet.raw) for packet in self._framer.feed(data)]

    def send(self, message) -> None:
        assert self._peer is not None
        self._server.sendto(message.pack(self._mav), self._peer)

    def set(self, name: str, value: float) -> None:
        self.send(common.MAVLink_param_set_message(1, 191, name.encode(), value, 9))

    def command(self, number: int, *given: float) -> None:
        seven = [*given, *[0.0] * 7][:7]
        self.send(common.MAVLink_command_long_message(1, 191, number, 0, *seven))

    def of(self, kind: str) -> list:
        return [message for message in self.read() if message.get_type() == kind]


@pytest.fixture
def operator():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        yield Operator(server)


def settings_of(operator: Operator, tmp_path, **sections) -> Settings:
    settings = with_link(operator._server.getsockname()[1], **sections)
    return changed(settings, mavlink={"state_directory": str(tmp_path)})


def test_a_parameter_is_applied_live_and_holds_after_a_restart(operator, tmp_path) -> None:
    settings = settings_of(operator, tmp_path)

    async def fly(first: bool) -> Daemon:
        async with running(settings, sources=source(settings)) as daemon:
            await until(lambda: operator.of("HEARTBEAT") and daemon.estimate)
            if first:
                operator.set("LG_TRK_COAST", 7.5)
                operator.set("LG_DET_EVIDENCE", 1000.0)
                await until(lambda: len(operator.of("PARAM_VALUE")) == 2)
                await until(lambda: daemon._applied.track.coast_s == 7.5 and daemon._applying is None)
            assert daemon.pipeline._track._settings.coast_s == 7.5
            assert daemon.pipeline._detect._settings.evidence == 1000.0
            estimates = daemon.counters.estimates
            await until(lambda: daemon.counters.estimates > estimates + 3)
            assert not daemon.estimate.detection.call
        return daemon

    asyncio.run(fly(True))
    assert "LG_TRK_COAST = 7.5" in kept_file(settings).read_text()
    operator.heard.clear()
    asyncio.run(fly(False))
    found = [text for good, what, text in check(settings, 0.1) if what == "parameters" and good]
    assert any(text.startswith("track.coast_s is 7.5, not 2") for text in found)


def test_recording_and_log_tell_what_is_flown(operator, tmp_path) -> None:
    """What was kept from the flight before, and what is set in this one."""
    settings = settings_of(operator, tmp_path, log={"directory": str(tmp_path / "log")})
    keep(kept_file(settings), {"LG_ARRAY_YAW": 30.0})
    flown: list[Settings] = []

    async def test() -> None:
        arguments = {"sources": source(settings), "on_settings": flown.append}
        async with running(settings, **arguments) as daemon:
            assert [s.array.mount_deg[2] for s in flown] == [30.0]
            await until(lambda: operator.of("HEARTBEAT") and daemon.estimate)
            operator.set("LG_TRK_COAST", 7.5)
            operator.command(common.MAV_CMD_USER_1, 0.0)
            await until(lambda: len(flown) == 2)
            assert daemon.black_box._settings is flown[1]
            states = daemon._states()
            assert states["parameters"] == {"LG_ARRAY_YAW": 30.0, "LG_TRK_COAST": 7.5}
            await until(lambda: not daemon.component.listening)
            assert daemon._states()["listening"] == {"on": False}

    asyncio.run(test())
    assert flown[1].track.coast_s == 7.5
    assert flown[1].array.mount_deg[2] == 30.0
    start = next(records(tmp_path / "log"))
    assert start["settings"]["array"]["mount_deg"] == [0.0, 0.0, 30.0]


def test_setting_it_back_leaves_nothing_behind(operator, tmp_path) -> None:
    settings = settings_of(operator, tmp_path)

    async def test() -> None:
        for value in (7.5, 2.0):
            async with running(settings, sources=source(settings)) as daemon:
                await until(lambda: operator.of("HEARTBEAT"))
                operator.set("LG_TRK_COAST", value)
                await until(lambda value=value, daemon=daemon: daemon._applied.track.coast_s == value)
            assert kept_file(settings).exists() == (value != 2.0)
            operator.heard.clear()

    asyncio.run(test())
    assert kept(settings) == (settings, [], [])


def test_what_the_pipeline_cannot_do_is_put_back_and_told(operator, tmp_path, monkeypatch) -> None:
    settings = settings_of(operator, tmp_path)

    def refuses(*_: object) -> None:
        raise ModelError("model x: was trained for another array")

    async def test() -> None:
        async with running(settings, sources=source(settings)) as daemon:
            await until(lambda: operator.of("HEARTBEAT") and daemon.estimate)
            monkeypatch.setattr(daemon.pipeline, "apply", refuses)
            operator.set("LG_ARRAY_YAW", 30.0)
            await until(lambda: [m.param_value for m in operator.of("PARAM_VALUE")] == [30.0, 0.0])
            await until(lambda: any("Not applied: model x" in m.text for m in operator.of("STATUSTEXT")))
            assert daemon.settings == settings
        assert not kept_file(settings).exists()

    asyncio.run(test())


@pytest.mark.parametrize("error", [ModelError("model x: it is gone"), MemoryError("no room")])
def test_noise_that_is_not_learnt_anew_is_told(operator, tmp_path, monkeypatch, caplog, error) -> None:
    settings = settings_of(operator, tmp_path)

    def refuses() -> None:
        raise error

    async def test() -> None:
        async with running(settings, sources=source(settings)) as daemon:
            await until(lambda: operator.of("HEARTBEAT") and daemon.estimate)
            monkeypatch.setattr(daemon.pipeline, "forget_noise", refuses)
            operator.command(common.MAV_CMD_USER_2)
            told = f"Noise is not learnt anew: {error}"
            await until(lambda: any(m.text == told for m in operator.of("STATUSTEXT")))
            estimates = daemon.counters.estimates
            await until(lambda: daemon.counters.estimates > estimates + 3)

    asyncio.run(test())
    (line,) = [r for r in caplog.records if "not learnt anew" in r.getMessage()]
    assert bool(line.exc_info) == isinstance(error, MemoryError), "what nobody expected, with its way"


def test_a_folder_that_cannot_be_written_is_told(operator, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    settings = settings_of(operator, tmp_path / "file" / "folder")

    async def test() -> None:
        async with running(settings, sources=source(settings)):
            await until(lambda: operator.of("HEARTBEAT"))
            operator.set("LG_TRK_COAST", 7.5)
            await until(lambda: any("Parameters are not kept" in m.text for m in operator.of("STATUSTEXT")))

    asyncio.run(test())


def test_listening_stops_and_starts_by_command_and_the_heartbeat_goes_on(operator, tmp_path) -> None:
    settings = settings_of(operator, tmp_path)

    async def test() -> None:
        async with running(settings, sources=source(settings)) as daemon:
            await until(lambda: operator.of("HEARTBEAT") and daemon.counters.estimates > 3)
            operator.command(common.MAV_CMD_USER_1, 0.0)
            await until(lambda: operator.of("COMMAND_ACK"))
            assert operator.of("COMMAND_ACK")[0].result == common.MAV_RESULT_ACCEPTED
            frames, estimates = daemon.counters.frames, daemon.counters.estimates
            await until(lambda: daemon.counters.frames > frames + 20)
            assert daemon.counters.estimates <= estimates + 1, "one may have been on its way"
            assert daemon.hearing
            await until(lambda: operator.of("HEARTBEAT")[-1].system_status == common.MAV_STATE_STANDBY)
            operator.command(common.MAV_CMD_USER_1, 1.0)
            operator.command(common.MAV_CMD_USER_2)
            await until(lambda: daemon.counters.estimates > estimates + 3)
            await until(lambda: len(operator.of("COMMAND_ACK")) == 3)

    asyncio.run(test())
