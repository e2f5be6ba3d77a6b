"""The service manager's notification socket: sd_notify(3) in a few lines, without libsystemd."""

from __future__ import annotations

import os
import socket


def notify(**states: str) -> bool:
    """Sends e.g. READY="1", STATUS="text". False where no service manager listens (NOTIFY_SOCKET)."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address or address[0] not in "/@":
        return False
    message = "\n".join(f"{key}={value}" for key, value in states.items())
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as s:
        try:
            s.sendto(message.encode(), "\0" + address[1:] if address[0] == "@" else address)
        except OSError:
            return False  # a manager that is gone or busy: the next beat tries again
    return True
