"""Lets go of sound cards that were pulled.

PortAudio (19.6, 19.7) does not close a device that has left: Pa_CloseStream gives up where stopping fails,
and forgets the stream with its file open and its buffers mapped. The kernel then keeps the dead card with its
number and its driver, for as long as this process lives. So what is left of it is unmapped and closed here;
that its device file is gone tells it from a card that is only silent.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
from pathlib import Path

GONE = " (deleted)"  # what the kernel adds to the name of a file that is no longer there: proc(5)


def close_gone(devices: str = "/dev/snd/") -> int:
    """Closes what this process holds of devices that no longer exist; returns how many files.

    Only while no stream is open, by the thread that owns PortAudio: what it has forgotten nobody uses.
    """
    libc = ctypes.CDLL(None)
    for line in Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines():
        addresses, *_, name = line.split(maxsplit=5)
        if _is_gone(name, devices):
            start, end = (int(address, 16) for address in addresses.split("-"))
            libc.munmap(ctypes.c_void_p(start), ctypes.c_size_t(end - start))
    closed = 0
    for number in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):  # the listing's own, closed by now
            if _is_gone(os.readlink(f"/proc/self/fd/{number}"), devices):
                os.close(int(number))
                closed += 1
    return closed


def _is_gone(name: str, devices: str) -> bool:
    return name.startswith(devices) and name.endswith(GONE)
