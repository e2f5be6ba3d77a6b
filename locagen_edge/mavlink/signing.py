"""MAVLink 2 signing: who may speak to us, and how we show who we are. No I/O but for the two small files.

A signature is 13 bytes behind the checksum: link id, a timestamp of 48 bits (10 us since 2015), and the first
6 bytes of SHA-256 over key, frame, link id and timestamp. It proves the sender; it hides nothing. A timestamp
has to grow within its stream (system, component, link id), so that a recorded frame cannot be played again; a
stream that is new to us may be a minute behind (mavlink.io/en/guide/message_signing.html).

With a key, whatever is not signed with it is refused and counted, heartbeats too. Without one all is
admitted. In both cases the other end may see it differently, and says nothing then: `Guard.complaints` tells
an operator.

Our own timestamp must not go back over restarts, or nobody would hear us until it has caught up. It is the
wall clock, the latest that a signed peer has shown (a Pi has no clock of its own), or what was used before a
restart, whichever is latest. The state file tells when that was, so that a program that falls again and again
does not run ahead of all others by a margin each time: they would be shut out.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from locagen_edge.errors import LinkError
from locagen_edge.mavlink.dialect import COMPONENT_AUTOPILOT, LAYOUTS, checksum
from locagen_edge.mavlink.framer import Packet
from locagen_edge.settings import Settings

UNITS_PER_S = 100_000
"""a timestamp counts 10 us"""
EPOCH_S = 1_420_070_400
"""2015-01-01 00:00 UTC"""
SAVE_S = 20.0
"""how often the timestamp is saved"""
REBOOT = 30 * UNITS_PER_S
"""added to what was saved before this computer started: more than `SAVE_S`, less than `NEW_STREAM`"""
RESTART = 1 * UNITS_PER_S
"""added to what was saved, and the time since, where only the program has started anew"""
NEW_STREAM = 60 * UNITS_PER_S
"""how far a stream that is new may be behind us"""
ASKED = 3
"""questions without any answer, over `UNANSWERED_S`, before that is told: a slow link loses some"""
UNANSWERED_S = 10.0
STREAMS = 64
"""most streams remembered: more than a swarm has"""
SILENCE_S = 5.0
"""refused for so long, and nothing admitted meanwhile: then something is wrong for sure"""
STATE_FILE = "signing-timestamp"

_FLAG = 0x01

COMPLAINTS = {
    "unsigned": "Signing mismatch? Only unsigned messages arrive",
    "wrong": "Signing mismatch? Messages have wrong signatures",
    "replayed": "Signing mismatch? Messages are older than ours",
    "unanswered": "Signing mismatch? The autopilot never answers us",
    "no key": "Signing mismatch? Autopilot signs, we have no key",
}
"""at most 50 characters: a STATUSTEXT"""


def wall_clock() -> int:
    """Now, as a timestamp; 0 before 2015, which is what a computer without a clock believes."""
    return max(0, int((time.time() - EPOCH_S) * UNITS_PER_S))


class Guard:
    """Signs what leaves, admits what comes. `key`: 32 bytes, or None: nothing is signed, all is admitted."""

    def __init__(
        self,
        key: bytes | None = None,
        link_id: int = 0,
        timestamp: int = 0,
        clock: Callable[[], int] = wall_clock,
    ) -> None:
        self._key = key
        self._link_id = link_id
        self._clock = clock
        self._timestamp = timestamp
        self._streams: dict[tuple[int, int, int], int] = {}
        self._refused_s: float | None = None
        self._complaint = ""
        self._asked = 0
        self._asked_s = 0.0
        self.counts: Counter[str] = Counter()
        """frames by what became of them: admitted, unsigned, wrong, replayed"""

    @property
    def signs(self) -> bool:
        return self._key is not None

    @property
    def timestamp(self) -> int:
        """The latest used or seen: what has to be remembered."""
        return self._timestamp

    def sign(self, frame: bytes, link: int = 0) -> bytes:
        """A MAVLink 2 frame of ours with its signature, under the id of that link."""
        if self._key is None:
            return frame
        self._timestamp = max(self._timestamp + 1, self._clock())
        body = frame[:2] + bytes((frame[2] | _FLAG,)) + frame[3:-2]  # the checksum covers the flag
        seed = LAYOUTS[int.from_bytes(frame[7:10], "little")].crc_extra
        body += checksum(body[1:], seed).to_bytes(2, "little")
        body += bytes(((self._link_id + link) % 256,)) + self._timestamp.to_bytes(6, "little")
        return body + self._digest(body)

    def admit(self, packet: Packet, now_s: float) -> bool:
        """Whether a frame may be obeyed."""
        verdict = self._verdict(packet)
        self.counts[verdict] += 1
        if self._key is None:
            if packet.component_id == COMPONENT_AUTOPILOT:  # one that signs expects it of us
                self._complaint = "no key" if packet.signed else ""
        elif verdict == "admitted":
            self._refused_s = None
        elif self._refused_s is None:
            self._complaint, self._refused_s = verdict, now_s
        return verdict == "admitted"

    def asked(self, now_s: float) -> None:
        """Something was asked of the autopilot that it would answer."""
        if self._asked == 0:
            self._asked_s = now_s
        self._asked += 1

    def answered(self) -> None:
        """It has answered: it obeys us."""
        self._asked = 0

    def complaints(self, now_s: float) -> tuple[str, ...]:
        """What an operator should know, in the words of `COMPLAINTS`; nothing where all is well."""
        late = self._refused_s is not None and now_s - self._refused_s >= SILENCE_S
        if self._complaint and (late or self._key is None):
            return (COMPLAINTS[self._complaint],)
        if self._asked >= ASKED and now_s - self._asked_s >= UNANSWERED_S:
            return (COMPLAINTS["unanswered"],)
        return ()

    def _verdict(self, packet: Packet) -> str:
        if self._key is None:
            return "admitted"
        if not packet.signed:
            return "unsigned"
        signed, signature = packet.raw[:-6], packet.raw[-6:]
        if not hmac.compare_digest(self._digest(signed), signature):
            return "wrong"
        timestamp = int.from_bytes(signed[-6:], "little")
        stream = (packet.system_id, packet.component_id, signed[-7])
        last = self._streams.get(stream)
        if last is None:
            late = timestamp + NEW_STREAM < max(self._timestamp, self._clock())
            if late or len(self._streams) >= STREAMS:
                return "replayed"
        elif timestamp <= last:
            return "replayed"
        self._streams[stream] = timestamp
        self._timestamp = max(self._timestamp, timestamp)
        return "admitted"

    def _digest(self, signed: bytes) -> bytes:
        assert self._key is not None
        return hashlib.sha256(self._key + signed).digest()[:6]


# --- the two files ------------------------------------------------------------------------------------


def read_key(path: Path) -> bytes:
    """The key in a file that only its owner may read.

    64 hexadecimal digits are the key itself; any other line is a passphrase, hashed as Mission Planner,
    MAVProxy and QGroundControl hash it (SHA-256). Raises `LinkError` with what is wrong and what to do.
    """
    name = f"mavlink.signing_key: {path}"
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode & 0o777
            content = file.read(4096)
    except OSError as error:
        raise LinkError(f"{name}: cannot be read: {error.strerror}") from error
    if mode & 0o077:
        raise LinkError(f"{name}: others may read it (mode {mode:04o}): chmod 600 {path}")
    try:
        text = content.decode("utf-8").strip()
    except UnicodeDecodeError as error:
        raise LinkError(f"{name}: is not text: one line, 64 hexadecimal digits or a passphrase") from error
    if not text or "\n" in text:
        raise LinkError(f"{name}: has to hold one line: 64 hexadecimal digits or a passphrase")
    if len(text) == 64:
        with contextlib.suppress(ValueError):
            return bytes.fromhex(text)
    return hashlib.sha256(text.encode("utf-8")).digest()


def state_file(settings: Settings) -> Path:
    """Where the timestamp is remembered."""
    given = settings.mavlink.state_directory or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    default = Path(os.environ.get("XDG_STATE_HOME", "") or Path.home() / ".local/state") / "locagen-edge"
    return (Path(given) if given else default) / STATE_FILE


def load_timestamp(path: Path) -> int:
    """Where to go on after a restart; 0 where nothing was ever saved. Raises `LinkError`."""
    try:
        saved, boot, monotonic_s = path.read_text(encoding="ascii").split()
        timestamp, since_s = int(saved), time.monotonic() - float(monotonic_s)
    except FileNotFoundError:
        return 0
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or "cannot be understood; where the clock is right, delete it"
        raise LinkError(f"mavlink.signing_key: the last timestamp, {path}: {why}") from error
    if boot != _boot():
        return timestamp + REBOOT
    return timestamp + int(max(since_s, 0.0) * UNITS_PER_S) + RESTART


def _boot() -> str:
    """What names the time since this computer has started, in which `time.monotonic` counts."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return "unknown"


def save_timestamp(path: Path, timestamp: int) -> None:
    """Remembers it, whole or not at all. Raises `LinkError`."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("w", encoding="ascii") as file:
            file.write(f"{timestamp} {_boot()} {time.monotonic():.3f}\n")
            file.flush()
            os.fsync(file.fileno())  # a rename that outlives the power, a content that does not: zeros
        os.replace(temporary, path)
    except OSError as error:
        raise LinkError(
            f"mavlink.signing_key: the last timestamp cannot be kept in {path}: {error.strerror}; "
            "set mavlink.state_directory to a folder that can be written"
        ) from error


def guard_of(settings: Settings) -> Guard:
    """The guard that the settings ask for. Raises `LinkError` where key or state cannot be used."""
    given = settings.mavlink
    if not given.signing_key:
        return Guard()
    key, path = read_key(Path(given.signing_key)), state_file(settings)
    guard = Guard(key, given.signing_link_id, max(load_timestamp(path), wall_clock()))
    save_timestamp(path, guard.timestamp)  # who cannot remember must not sign: found out now, not in flight
    return guard
