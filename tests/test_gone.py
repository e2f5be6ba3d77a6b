"""What is held of a device that is gone is let go, mapped memory too; all else stays as it is."""

from __future__ import annotations

import ctypes
import mmap
import os
from pathlib import Path

import pytest

from locagen_edge.gone import close_gone


def mapped(path) -> bool:
    return str(path) in Path("/proc/self/maps").read_text()


@pytest.fixture
def device(tmp_path):
    """A file, open and mapped as a driver's buffers are: by the C library, unknown to Python."""
    path = tmp_path / "pcmC0D1c"
    path.write_bytes(bytes(4096))
    number = os.open(path, os.O_RDWR)
    libc = ctypes.CDLL(None)
    libc.mmap.restype = ctypes.c_void_p
    arguments = 4096, mmap.PROT_READ | mmap.PROT_WRITE, mmap.MAP_SHARED, number, ctypes.c_long(0)
    address = libc.mmap(None, *arguments)
    assert mapped(path)
    yield path, number
    if mapped(path):
        libc.munmap(ctypes.c_void_p(address), 4096)
        os.close(number)


def test_what_is_left_of_a_pulled_device_is_let_go(device, tmp_path):
    path, number = device
    path.unlink()
    assert close_gone(f"{tmp_path}/") == 1
    assert not mapped(path)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(number)
    assert close_gone(f"{tmp_path}/") == 0


def test_a_device_that_came_back_under_the_same_name_is_another(device, tmp_path):
    """As udev names it: the old file is gone all the same, the new one stays open."""
    path, _ = device
    path.unlink()
    path.write_bytes(bytes(4096))
    new = os.open(path, os.O_RDONLY)
    try:
        assert close_gone(f"{tmp_path}/") == 1
        os.fstat(new)
    finally:
        os.close(new)


def test_a_device_that_is_there_and_what_is_no_device_stay(device, tmp_path):
    path, number = device
    assert close_gone(f"{tmp_path}/") == 0
    path.unlink()
    assert close_gone() == 0  # gone, but not among /dev/snd/
    os.fstat(number)
    assert mapped(path)
