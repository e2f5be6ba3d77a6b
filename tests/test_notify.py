"""sd_notify over a real datagram socket."""

from __future__ import annotations

import socket

from locagen_edge.notify import notify


def test_without_a_manager_nothing_is_sent(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not notify(READY="1")


def test_states_arrive_as_lines(monkeypatch, tmp_path):
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(path)
        monkeypatch.setenv("NOTIFY_SOCKET", path)
        assert notify(READY="1", STATUS="listening")
        assert server.recv(100) == b"READY=1\nSTATUS=listening"


def test_abstract_addresses_work(monkeypatch):
    name = "locagen-edge-test-notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind("\0" + name)
        monkeypatch.setenv("NOTIFY_SOCKET", "@" + name)
        assert notify(WATCHDOG="1")
        assert server.recv(100) == b"WATCHDOG=1"


def test_a_manager_that_is_gone_is_no_error(monkeypatch, tmp_path):
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    assert not notify(READY="1")
