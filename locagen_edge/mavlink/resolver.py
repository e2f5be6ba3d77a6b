"""A link's host name, looked up where it holds up nobody.

The system's resolver blocks and cannot be told to stop: where no name server answers it takes 10 s and more.
In asyncio's own executor it would stay on after the attempt that asked, fill it with each attempt (serial
ports are opened there, parameters kept), and asyncio would wait for it before the process may end. So each
link has a daemon thread of its own for it, one lookup at a time, and what it finds late is there for a later
attempt.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading

WAIT_S = 1.0
"""how long an attempt to open waits for the lookup: less than the whole attempt may take"""

_Outcome = list[str] | OSError | ValueError


class Resolver:
    """Of one host: a name, or an address in figures, which needs no looking up."""

    def __init__(self, host: str) -> None:
        self._host = host
        self._looking: asyncio.Future[_Outcome] | None = None

    async def addresses(self) -> list[str]:
        """In figures, in the order in which the system prefers them; at least one.

        Raises `OSError` where there is none or it is still being looked up, `ValueError` where no host can
        be named so.
        """
        if _in_figures(self._host):
            return [self._host]
        if self._looking is None:
            self._looking = self._look_up()
        await asyncio.wait({self._looking}, timeout=WAIT_S)
        if not self._looking.done():
            raise OSError(f"{self._host}: still being looked up")
        outcome, self._looking = self._looking.result(), None  # asked anew each time: addresses change
        if isinstance(outcome, list):
            return outcome
        raise outcome

    def _look_up(self) -> asyncio.Future[_Outcome]:
        loop = asyncio.get_running_loop()
        looking: asyncio.Future[_Outcome] = loop.create_future()

        def work() -> None:
            outcome = _found(self._host)
            with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
                loop.call_soon_threadsafe(looking.set_result, outcome)

        threading.Thread(target=work, name=f"look up {self._host}", daemon=True).start()
        return looking


def _in_figures(host: str) -> bool:
    for family in (socket.AF_INET, socket.AF_INET6):
        with contextlib.suppress(OSError, ValueError):
            socket.inet_pton(family, host)
            return True
    return False


def _found(host: str) -> _Outcome:
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)  # one type: each address once
    except (OSError, ValueError) as error:
        return error
    # a link-local address is one on an interface only
    return [f"{at[0]}%{at[3]}" if len(at) == 4 and at[3] else str(at[0]) for *_, at in found]
