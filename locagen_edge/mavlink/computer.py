"""ONBOARD_COMPUTER_STATUS: how the computer is doing, from what Linux tells under /proc and /sys.

What cannot be read is told as "not known"; nothing raises.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from locagen_edge.mavlink.dialect import messages

_U8, _I8, _I16, _U32 = 0xFF, 0x7F, 0x7FFF, 0xFFFFFFFF
"""what MAVLink sends for "not known" """
_CORES = 8
MIB = 1 << 20


class Computer:
    """Reads it; the load is that since the last reading. `root`, `disk`: other folders, for tests."""

    def __init__(self, root: Path = Path("/"), disk: Path = Path("/")) -> None:
        self._root, self._disk = root, disk
        self._before: list[tuple[int, int]] = []

    def status(self, now_ns: int) -> Any:
        """The message; `now_ns`: monotonic time."""
        uptime = self._read("proc/uptime").split()
        total, free = self._memory()
        used_mib, size_mib = self._storage()
        return messages.MAVLink_onboard_computer_status_message(
            time_usec=now_ns // 1000,
            uptime=_clamped(float(uptime[0]) * 1000.0) if uptime else 0,
            type=0,
            cpu_cores=_padded(self._loads(), _CORES, _U8),
            cpu_combined=(_U8,) * 10,
            gpu_cores=(_U8,) * 4,
            gpu_combined=(_U8,) * 10,
            temperature_board=_I8,
            temperature_core=_padded(self._temperatures(), _CORES, _I8),
            fan_speed=(_I16,) * 4,
            ram_usage=_U32 if total is None or free is None else _clamped((total - free) / 1024),
            ram_total=_U32 if total is None else _clamped(total / 1024),
            storage_type=(0, _U32, _U32, _U32),
            storage_usage=(used_mib, _U32, _U32, _U32),
            storage_total=(size_mib, _U32, _U32, _U32),
            link_type=(_U32,) * 6,
            link_tx_rate=(_U32,) * 6,
            link_rx_rate=(_U32,) * 6,
            link_tx_max=(_U32,) * 6,
            link_rx_max=(_U32,) * 6,
        )

    def _read(self, name: str) -> str:
        try:
            return (self._root / name).read_text(encoding="ascii", errors="replace")
        except OSError:
            return ""

    def _loads(self) -> list[int]:
        """Per cent of each core that were not idle since the last reading."""
        now = []
        for line in self._read("proc/stat").splitlines():
            name, *ticks = line.split()
            if name.startswith("cpu") and name != "cpu":
                counts = [int(tick) for tick in ticks[:8] if tick.isdigit()]
                if len(counts) >= 5:
                    now.append((sum(counts), counts[3] + counts[4]))  # idle, waiting for a disk
        before, self._before = self._before, now
        if len(before) != len(now):
            return [_U8] * len(now)
        loads = []
        for (all_now, idle_now), (all_then, idle_then) in zip(now, before, strict=True):
            passed = all_now - all_then
            busy = 1.0 - (idle_now - idle_then) / passed if passed > 0 else 0.0
            loads.append(min(max(round(100.0 * busy), 0), 100))
        return loads

    def _memory(self) -> tuple[int | None, int | None]:
        """Total and available, KiB."""
        table = dict(line.split(":", 1) for line in self._read("proc/meminfo").splitlines() if ":" in line)
        found = [table.get(name, "").split() for name in ("MemTotal", "MemAvailable")]
        total, free = (int(words[0]) if words and words[0].isdigit() else None for words in found)
        return total, free

    def _temperatures(self) -> list[int]:
        """Of the first zones that the kernel knows, degrees Celsius."""
        found = []
        for zone in range(_CORES):
            text = self._read(f"sys/class/thermal/thermal_zone{zone}/temp").strip()
            if not text.removeprefix("-").isdigit():
                break
            found.append(min(max(round(int(text) / 1000.0), -127), 126))
        return found

    def _storage(self) -> tuple[int, int]:
        """Used and total, MiB."""
        try:
            disk = os.statvfs(self._disk)
        except OSError:
            return _U32, _U32
        used = (disk.f_blocks - disk.f_bfree) * disk.f_frsize
        return _clamped(used / MIB), _clamped(disk.f_blocks * disk.f_frsize / MIB)


def _padded(values: Sequence[int], length: int, unknown: int) -> tuple[int, ...]:
    return tuple([*values, *[unknown] * length][:length])


def _clamped(value: float) -> int:
    return min(max(round(value), 0), _U32 - 1)
