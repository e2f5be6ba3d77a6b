"""The daemon, with real sockets and sources that behave and misbehave."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from itertools import count

import numpy as np
import pytest
from conftest import ROOT
from peers import WITHIN_S, free_port, mavsdk
from pymavlink.dialects.v20 import common
from scenes import cut, heard

from locagen_edge.daemon import Daemon
from locagen_edge.errors import LinkError, ModelError, SourceError, SourceHungError
from locagen_edge.geometry import quaternion, wrap
from locagen_edge.mavlink import dialect, signing
from locagen_edge.mavlink.framer import Framer
from locagen_edge.mavlink.signing import Guard
from locagen_edge.settings import Settings, from_table
from locagen_edge.types import Drift, Frame, Pose

Sources = Callable[[Settings], AsyncGenerator[Frame, None]]


def with_link(port: int, **sections) -> Settings:
    return from_table({"mavlink": {"link": f"udpout:127.0.0.1:{port}"}, **sections})


@asynccontextmanager
async def running(settings: Settings, **arguments) -> AsyncGenerator[Daemon, None]:
    daemon = Daemon(settings, **arguments)
    await daemon.startup()
    main = asyncio.create_task(daemon.main_loop())
    try:
        yield daemon
    finally:
        daemon.stop()
        await asyncio.gather(main, return_exceptions=True)
        await daemon.shutdown()


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(WITHIN_S):
        while not condition():
            await asyncio.sleep(0.01)


def steady(settings: Settings, seconds: float = 1.0) -> list[Frame]:
    return cut(settings, heard(settings, 1.0, -0.3, 20.0, round(seconds * settings.audio.rate_hz)))


def source(settings: Settings, *, pace_s: float = 0.01, fail_after: int | None = None) -> Sources:
    """Endless sound, faster than real time; fails after so many frames each time it is opened."""
    frames = steady(settings)

    async def frames_from(_: Settings) -> AsyncGenerator[Frame, None]:
        for number in count():
            if fail_after is not None and number >= fail_after:
                raise SourceError("the cable is out")
            frame = frames[number % len(frames)]
            yield Frame(frame.samples, frame.rate_hz, time.monotonic_ns() - 102_400_000, frame.start)
            await asyncio.sleep(pace_s)

    return frames_from


def messages(server: socket.socket) -> list:
    """All that has arrived, decoded."""
    framer, found = Framer(), []
    server.setblocking(False)
    while True:
        try:
            found += [dialect.decode(packet.raw) for packet in framer.feed(server.recv(2048))]
        except BlockingIOError:
            return found


def datagrams(server: socket.socket) -> list[bytes]:
    found = []
    with contextlib.suppress(BlockingIOError):
        while True:
            found.append(server.recv(2048))
    return found


@pytest.fixture
def ground() -> socket.socket:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        yield server


def port_of(server: socket.socket) -> int:
    return int(server.getsockname()[1])


# --- the way


def test_sound_goes_in_and_a_bearing_comes_out(ground):
    settings = with_link(port_of(ground), detection={"snr_db": -20}, bearing={"estimator": "far-field"})

    async def call_after_noise(_: Settings) -> AsyncGenerator[Frame, None]:
        quiet = 1e-4 * np.random.default_rng(0).standard_normal((3, 1024)).astype(np.float32)
        frames = [Frame(quiet, 10_000.0, 0, 0)] * 5 + steady(settings)
        for number in count():
            frame = frames[min(number, len(frames) - 1)]
            yield Frame(frame.samples, frame.rate_hz, number * 51_200_000, number * 512)
            await asyncio.sleep(0.02)

    async def test() -> None:
        async with running(settings, sources=call_after_noise) as daemon:
            await until(lambda: daemon.component.sent["STATUSTEXT"] and daemon.component.sent["LG_AZB"] > 2)
            assert daemon.estimate is not None
            assert abs(wrap(daemon.estimate.track.azimuth_rad - 1.0)) < math.radians(2)
            assert daemon.counters.dropped == 0

    asyncio.run(test())
    arrived = messages(ground)
    values = [m.value for m in arrived if m.get_type() == "NAMED_VALUE_FLOAT" and m.name == "LG_AZB"]
    assert values
    assert values[-1] == pytest.approx(math.degrees(1.0), abs=2.0)
    assert any(m.get_type() == "HEARTBEAT" and m.system_status == 4 for m in arrived)


def test_with_an_autopilot_on_the_link_the_bearing_is_from_true_north(ground):
    """The autopilot answers what it is asked for: nose to the west, level, 20 m over the ground."""
    settings = with_link(port_of(ground), detection={"snr_db": -20}, bearing={"estimator": "far-field"})
    frames = steady(settings)
    quiet = 1e-4 * np.random.default_rng(0).standard_normal((3, 1024)).astype(np.float32)

    async def in_real_time(_: Settings) -> AsyncGenerator[Frame, None]:
        for number in count():
            samples = frames[number % len(frames)].samples if number > 10 else quiet
            await asyncio.sleep(0.0512)
            yield Frame(samples, 10_000.0, time.monotonic_ns() - 102_400_000, number * 512)

    async def autopilot() -> None:
        """Says what it has been asked for, and nothing before."""
        mav, wanted, framer, client = common.MAVLink(None, 7, 1), set(), Framer(), None
        ground.setblocking(False)
        boot_s = time.monotonic() - 60.0
        for tick in count():
            with contextlib.suppress(BlockingIOError):
                while True:
                    data, client = ground.recvfrom(2048)
                    decoded = [dialect.decode(packet.raw) for packet in framer.feed(data)]
                    commands = [m for m in decoded if m.get_type() == "COMMAND_LONG"]
                    wanted |= {m.param1 for m in commands if (m.target_system, m.command) == (7, 511)}
                    arrived.extend(decoded)
            ms = round((time.monotonic() - boot_s) * 1000)
            messages = {
                0: common.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3),
                31: common.MAVLink_attitude_quaternion_message(
                    ms, *quaternion(0.0, 0.0, -math.pi / 2), 0, 0, 0
                ),
                33: common.MAVLink_global_position_int_message(
                    ms, 47 * 10**7, 8 * 10**7, 0, 20_000, *[0] * 4
                ),
            }
            due = [m for id, m in messages.items() if id in wanted or (id == 0 and tick % 10 == 0)]
            if client:
                for message in due:
                    ground.sendto(bytes(message.pack(mav)), client)
            await asyncio.sleep(0.05)

    arrived: list = []

    async def test() -> None:
        async with running(settings, sources=in_real_time) as daemon:
            task = asyncio.create_task(autopilot())
            try:
                await until(lambda: daemon.component.sent["LG_AZ"] > 1)
            finally:
                task.cancel()
            assert daemon.estimate is not None
            assert daemon.estimate.pose.height_m == pytest.approx(20.0)
            assert abs(wrap(daemon.estimate.track.azimuth_rad - 1.0)) < math.radians(2)

    asyncio.run(test())
    arrived += messages(ground)
    values = [m.value for m in arrived if m.get_type() == "NAMED_VALUE_FLOAT" and m.name == "LG_AZ"]
    assert values[-1] == pytest.approx(math.degrees(1.0) + 270.0, abs=2.0)


def test_a_pipeline_that_is_too_slow_drops_the_oldest_and_counts():
    settings = with_link(9, daemon={"queue_frames": 2})

    async def test() -> None:
        async with running(settings, sources=source(settings, pace_s=0.001)) as daemon:
            await until(lambda: daemon.counters.estimates > 3)
            process, seen = daemon.pipeline.process, []

            def slow(frame: Frame, pose: Pose):
                time.sleep(0.03)
                seen.append(frame.t_ns)
                return process(frame, pose)

            daemon.pipeline.process = slow
            await until(lambda: daemon.counters.dropped > 20)
            c = daemon.counters
            assert 0 <= c.frames - c.dropped - c.estimates <= 2 + 2  # in the queue, or in hand
            assert seen == sorted(seen)

    asyncio.run(test())


# --- what fails is opened again while the rest goes on


def test_a_failing_source_is_reopened_and_told_while_the_link_goes_on(ground):
    settings = with_link(port_of(ground), daemon={"stall_s": 0.2, "backoff_s": 0.6})

    async def test() -> None:
        async with running(settings, sources=source(settings, fail_after=5)) as daemon:
            await until(lambda: daemon.source_fault)
            await until(lambda: not daemon.hearing)
            before = daemon.component.sent["HEARTBEAT"]
            assert daemon.links.up
            await until(lambda: daemon.counters.source_failures >= 3)
            assert daemon.counters.frames >= 10
            assert daemon.component.sent["HEARTBEAT"] - before <= 3  # only in the moments when it heard

    asyncio.run(test())
    assert any("the cable is out" in m.text for m in messages(ground) if m.get_type() == "STATUSTEXT")


def test_a_source_that_never_opens_is_tried_again_with_growing_pauses(ground):
    settings = with_link(port_of(ground), daemon={"stall_s": 0.2, "backoff_s": 0.8})
    opened: list[float] = []

    async def absent(_: Settings) -> AsyncGenerator[Frame, None]:
        opened.append(time.monotonic())
        raise SourceError("no such device")
        yield  # makes it a generator

    async def test() -> None:
        async with running(settings, sources=absent) as daemon:
            await until(lambda: len(opened) >= 4)
            assert daemon.component.sent["HEARTBEAT"] == 0  # a daemon that does not hear shows no life

    asyncio.run(test())
    pauses = np.diff(opened)
    assert pauses[0] >= 0.49
    assert all(pause >= 0.79 for pause in pauses[1:])


def test_a_driver_that_hangs_ends_the_daemon():
    settings = with_link(9)

    async def hung(_: Settings) -> AsyncGenerator[Frame, None]:
        raise SourceHungError("the driver hangs")
        yield

    async def test() -> None:
        daemon = Daemon(settings, sources=hung)
        await daemon.startup()
        try:
            with pytest.raises(SourceHungError):
                async with asyncio.timeout(WITHIN_S):
                    await daemon.main_loop()
        finally:
            await daemon.shutdown()

    asyncio.run(test())


def test_a_link_that_cannot_be_opened_does_not_stop_the_sound():
    settings = from_table({"mavlink": {"link": f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}"}})

    async def test() -> None:
        async with running(settings, sources=source(settings)) as daemon:
            await until(lambda: daemon.counters.estimates > 20 and daemon.links.last_error)
            assert not daemon.links.up

    asyncio.run(test())


def test_a_dead_link_costs_the_other_nothing(ground):
    dead = f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    settings = from_table({"mavlink": {"link": [dead, f"udpout:127.0.0.1:{port_of(ground)}"]}})

    async def test() -> None:
        async with running(settings, sources=source(settings)) as daemon:
            await until(lambda: daemon.component.sent["HEARTBEAT"] >= 2 and daemon.links.last_error)
            assert daemon.links.up == 1
            assert daemon.links.dropped == 0
            assert f"link down: {dead}: Connection refused" in daemon._in_words()

    asyncio.run(test())
    assert [m.get_type() for m in messages(ground)].count("HEARTBEAT") >= 2


def test_with_a_key_all_is_signed_and_the_timestamp_outlives_the_daemon(ground, tmp_path):
    key = tmp_path / "key"
    key.write_text("a passphrase")
    key.chmod(0o600)
    mavlink = {
        "link": f"udpout:127.0.0.1:{port_of(ground)}",
        "signing_key": str(key),
        "state_directory": str(tmp_path),
    }
    settings = from_table({"mavlink": mavlink})
    stamps = []

    async def test() -> None:
        async with running(settings, sources=source(settings)) as daemon:
            await until(lambda: daemon.component.sent["HEARTBEAT"] >= 1)
        stamps.append(daemon.component.guard.timestamp)

    for _ in range(2):
        asyncio.run(test())
        assert signing.load_timestamp(signing.state_file(settings)) > stamps[-1]
    assert stamps[1] > stamps[0]
    reader = Guard(signing.read_key(key), timestamp=stamps[0])
    ground.setblocking(False)
    packets = [packet for frame in datagrams(ground) for packet in Framer().feed(frame)]
    assert packets
    assert all(reader.admit(packet, 0.0) for packet in packets)


def test_an_unfit_key_stops_the_start(tmp_path):
    key = tmp_path / "key"
    key.write_text("a passphrase")
    key.chmod(0o644)

    async def test() -> None:
        daemon = Daemon(from_table({"mavlink": {"signing_key": str(key)}}))
        with pytest.raises(LinkError, match="chmod 600"):
            await daemon.startup()

    asyncio.run(test())


def test_an_unfit_model_stops_the_start():
    async def test() -> None:
        daemon = Daemon(from_table({"bearing": {"estimator": "model:absent"}}))
        with pytest.raises(ModelError):
            await daemon.startup()

    asyncio.run(test())


# --- end


def test_the_end_of_a_recording_ends_the_main_loop_after_the_last_frame():
    settings = with_link(9)
    frames = steady(settings)

    async def recording(_: Settings) -> AsyncGenerator[Frame, None]:
        for frame in frames[:8]:
            yield frame

    async def test() -> None:
        daemon = Daemon(settings, sources=recording)
        await daemon.startup()
        async with asyncio.timeout(WITHIN_S):
            await daemon.main_loop()
        await daemon.shutdown()
        assert daemon.counters.estimates == 8

    asyncio.run(test())


def test_shutdown_drains_what_is_in_the_queue_and_closes_the_source():
    settings = with_link(9, daemon={"queue_frames": 100})
    frames, closed = steady(settings), []

    async def burst(_: Settings) -> AsyncGenerator[Frame, None]:
        try:
            for frame in frames:
                yield frame
            await asyncio.Event().wait()
        finally:
            closed.append(True)

    async def test() -> None:
        daemon = Daemon(settings, sources=burst)
        await daemon.startup()
        await until(lambda: daemon.counters.frames == len(frames))
        daemon.stop()
        await daemon.main_loop()
        await daemon.shutdown()
        assert daemon.counters.estimates == len(frames)
        assert closed == [True]
        assert [t for t in asyncio.all_tasks() if t is not asyncio.current_task()] == []

    asyncio.run(test())


# --- the service manager


def test_ready_comes_with_the_first_sound_and_the_watchdog_only_with_sound(monkeypatch, tmp_path):
    settings = with_link(9, daemon={"stall_s": 0.5})
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        said: list[bytes] = []

        def listen() -> bytes:
            try:
                while True:
                    said.append(manager.recv(200))
            except BlockingIOError:
                return b"\n".join(said)

        gate = asyncio.Event()
        endless = source(settings)

        async def late(s: Settings) -> AsyncGenerator[Frame, None]:
            await gate.wait()
            async for frame in endless(s):
                if not gate.is_set():
                    await asyncio.Event().wait()
                yield frame

        async def test() -> None:
            async with running(settings, sources=late) as daemon:
                await asyncio.sleep(1.3)
                assert b"READY" not in listen()
                assert b"WATCHDOG" not in listen()
                gate.set()
                await until(lambda: b"READY=1" in listen() and b"WATCHDOG=1" in listen())
                gate.clear()
                await until(lambda: not daemon.hearing)
                listen()
                said.clear()
                await asyncio.sleep(1.3)
                assert b"STATUS=no sound" in listen()
                assert not any(message.startswith(b"WATCHDOG=1") for message in said)
            assert b"STOPPING=1" in listen()

        asyncio.run(test())


def test_a_source_that_says_why_it_failed_keeps_the_service_up(monkeypatch, tmp_path):
    """Ready, and fed: another process would find the same cable out. The heartbeat stays away."""
    settings = with_link(9, daemon={"stall_s": 0.2, "backoff_s": 0.5})
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))

        async def absent(_: Settings) -> AsyncGenerator[Frame, None]:
            raise SourceError("no such device")
            yield

        async def test() -> None:
            async with running(settings, sources=absent) as daemon:
                await asyncio.sleep(2.3)
                assert daemon.component.sent["HEARTBEAT"] == 0

        asyncio.run(test())
        said = b""
        with contextlib.suppress(BlockingIOError):
            while True:
                said += manager.recv(300) + b"\n"
    assert b"READY=1" in said
    assert b"WATCHDOG=1" in said
    assert b"STATUS=no sound: no such device" in said


def test_a_stuck_pipeline_is_not_taken_for_health(monkeypatch, tmp_path):
    """Frames come in, nothing comes out: no heartbeat, no bearings, no watchdog, and an end all the same."""
    settings = with_link(9, daemon={"stall_s": 0.3})
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))

        async def test() -> None:
            daemon = Daemon(settings, sources=source(settings))
            await daemon.startup()
            await until(lambda: daemon.counters.estimates > 3)
            release = threading.Event()
            daemon.pipeline.process = lambda *_: release.wait(WITHIN_S)
            await until(lambda: not daemon.hearing)
            with contextlib.suppress(BlockingIOError):
                while True:
                    manager.recv(300)
            sent = sum(daemon.component.sent.values())
            frames = daemon.counters.frames
            await asyncio.sleep(1.3)
            assert daemon.counters.frames > frames
            assert sum(daemon.component.sent.values()) == sent
            assert not manager.recv(300).startswith(b"WATCHDOG")
            assert await daemon.shutdown() is False
            release.set()

        asyncio.run(test())


# --- as a process


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "locagen_edge", "run", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"},
    )


@pytest.fixture
def settings_file(tmp_path, ground):
    path = tmp_path / "settings.toml"
    path.write_text(
        f'[mavlink]\nlink = "udpout:127.0.0.1:{port_of(ground)}"\n[bearing]\nestimator = "far-field"\n'
    )
    return str(path)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_process_cleanly(settings_file, number):
    process = start("--settings", settings_file)
    lines = [process.stdout.readline() for _ in range(3)]
    process.send_signal(number)
    out, err = process.communicate(timeout=5)  # a second is the law; the rest is for a loaded machine
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert "true" in lines[2]
    assert " dropped, " in out


def test_seconds_end_it_by_itself(settings_file):
    process = start("--settings", settings_file, "--seconds", "2.5")
    out, err = process.communicate(timeout=WITHIN_S)
    assert process.returncode == 0, err
    live = [line for line in out.splitlines() if " s  bearing" in line]
    assert len(live) == 2
    for line in live:
        assert "true" in line
        assert "sent" in line
        assert "NAMED_VALUE_FLOAT" in line


@pytest.mark.skipif(
    importlib.util.find_spec("mavsdk") is None, reason="needs the mavsdk package (extra: dev)"
)
def test_mavsdk_hears_the_bearing_of_the_running_service(tmp_path):
    """The default scene from end to end: sound in one process, a ground station in another."""
    port = free_port(socket.SOCK_DGRAM)
    path = tmp_path / "settings.toml"
    path.write_text(f'[mavlink]\nlink = "udpout:127.0.0.1:{port}"\n[sim]\nturn_deg_s = 0\nsnr_db = 20\n')

    async def test() -> None:
        async with mavsdk("ground", f"udpin://127.0.0.1:{port}") as peer:
            process = start("--settings", str(path), "--quiet")
            try:
                await peer.until(lambda _: len(peer.messages("NAMED_VALUE_FLOAT")) > 20)
                await peer.until(lambda _: peer.messages("STATUSTEXT"))
            finally:
                process.terminate()
                process.communicate(timeout=WITHIN_S)
            values = [m["fields"] for m in peer.messages("NAMED_VALUE_FLOAT")]
            azimuths = [v["value"] for v in values if v["name"] == "LG_AZB"]
            assert np.median(azimuths) == pytest.approx(40.0, abs=3.0)
            assert peer.messages("STATUSTEXT")[0]["fields"]["text"].startswith("Call heard")

    asyncio.run(test())


def test_faults_and_the_cards_clock_are_in_the_status_and_a_fault_is_texted_once(ground):
    settings = with_link(port_of(ground), bearing={"estimator": "far-field"})
    plain = source(settings, pace_s=0.02)

    async def inverted(s: Settings) -> AsyncGenerator[Frame, None]:
        async for frame in plain(s):
            samples = frame.samples * np.float32([[1], [-1], [1]])
            yield Frame(samples, frame.rate_hz, frame.t_ns, frame.start, drift=Drift(12.3, 0.4))

    fault = "microphone 1: inverted, its two wires are swapped"

    async def test() -> None:
        async with running(settings, sources=inverted) as daemon:
            await until(lambda: f"listening; {fault}; " in daemon._in_words())
            assert "0 overruns, 0.0 s of sound lost, clock +12 ±1 ppm" in daemon._in_words()
            estimates = daemon.counters.estimates
            await until(lambda: daemon.counters.estimates > estimates + 100)

    asyncio.run(test())
    texts = [m.text for m in messages(ground) if m.get_type() == "STATUSTEXT"]
    assert texts.count(fault) == 1
