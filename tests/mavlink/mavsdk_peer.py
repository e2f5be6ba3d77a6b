"""A mavsdk peer in a process of its own: `mavsdk_peer.py ground|autopilot URL [XML]`.

A process, because mavsdk is a C++ library with threads: what it does when it is torn down must not decide
whether our tests pass. It prints one JSON object per line for each message of component 191 that it has
decoded (`ground`), and ends when its input does. XML: a dialect that it reads at run time.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

# mavsdk's own log goes to file descriptor 1: it shall not come between our lines.
_out = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)
_lock = threading.Lock()

from mavsdk import Configuration, Mavsdk  # noqa: E402
from mavsdk.plugins.mavlink_direct import MavlinkDirect  # noqa: E402

IDS = {"ground": (245, 190), "autopilot": (42, 1)}


def tell(**what: Any) -> None:
    with _lock:
        print(json.dumps(what), file=_out, flush=True)


def hear(message: Any, _: Any) -> None:
    fields = json.loads(message.fields_json)
    tell(name=message.message_name, system=message.system_id, component=message.component_id, fields=fields)


def watch(mavsdk: Mavsdk, xml: str) -> None:
    """Waits for our component, then tells all that it says."""
    while True:
        for system in mavsdk.get_systems():
            if 191 in system.component_ids():
                direct = MavlinkDirect(system)
                if xml:
                    direct.load_custom_xml(Path(xml).read_text(encoding="utf-8"))
                direct.subscribe_message("", hear)
                watch.kept = system, direct  # type: ignore[attr-defined]
                tell(subscribed=True, system=system.get_system_id(), components=system.component_ids())
                return
        time.sleep(0.01)


def main(role: str, url: str, xml: str = "") -> None:
    system, component = IDS[role]
    mavsdk = Mavsdk(Configuration.create_manual(system, component, True))
    mavsdk.add_any_connection(url)
    tell(open=True)
    if role == "ground":
        threading.Thread(target=watch, args=(mavsdk, xml), daemon=True).start()
    sys.stdin.read()
    os._exit(0)  # no teardown: nothing of it is under test


if __name__ == "__main__":
    main(*sys.argv[1:])
