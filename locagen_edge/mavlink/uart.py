"""A serial port as asyncio knows it; loaded where a link is one."""

from __future__ import annotations

from typing import Any

import serial  # type: ignore[import-untyped]
import serial_asyncio_fast


def opened(path: str, baud: int) -> Any:
    """Raises `OSError` (pyserial's is a child of it). Exclusive: two programs on one UART each get half of
    the bytes, and neither is told."""
    return serial.Serial(path, baudrate=baud, exclusive=True)


class Transport(serial_asyncio_fast.SerialTransport):
    """pyserial-asyncio-fast, except that a device pulled out while we write is no traceback in the log."""

    def _fatal_error(self, exc: BaseException, message: str = "") -> None:  # noqa: ARG002
        self._abort(exc)
