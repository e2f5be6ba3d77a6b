"""MAVSDK as an operator, in a process of its own: lists parameters, sets one, commands, tells what it saw.

`mavsdk_operator.py URL`; one JSON object per line. A process for the reason that `mavsdk_peer.py` gives.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from typing import Any

_out = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)

from mavsdk import Configuration, Mavsdk  # noqa: E402
from mavsdk.plugins.mavlink_direct import MavlinkDirect  # noqa: E402
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkMessage  # noqa: E402
from mavsdk.plugins.param import Param  # noqa: E402
from mavsdk.plugins.param.param import ParamError, ProtocolVersion  # noqa: E402


def tell(**what: Any) -> None:
    print(json.dumps(what), file=_out, flush=True)


def ours(mavsdk: Mavsdk) -> Any:
    while True:
        for system in mavsdk.get_systems():
            if 191 in system.component_ids():
                return system
        time.sleep(0.01)


def main(url: str) -> None:
    mavsdk = Mavsdk(Configuration.create_manual(245, 190, True))
    mavsdk.add_any_connection(url)
    tell(open=True)
    system = ours(mavsdk)
    parameters = Param(system)
    with contextlib.suppress(ParamError):  # it selects, and then says "unknown" (4.1.0)
        parameters.select_component(191, ProtocolVersion.V1)
    found = parameters.get_all_params()
    tell(listed={one.name: one.value for one in found.float_params}, integers=len(found.int_params))
    parameters.set_param_float("LG_TRK_COAST", 4.25)
    tell(set=parameters.get_param_float("LG_TRK_COAST"))
    try:
        parameters.set_param_float("LG_TRK_COAST", 1e6)
        tell(refused="")
    except ParamError as error:
        tell(refused=str(error))
    tell(after=parameters.get_param_float("LG_TRK_COAST"))
    direct = MavlinkDirect(system)
    for command, param1 in ((31010, 0), (31010, 1), (31011, 0), (31010, 9), (400, 1), (512, 148)):
        fields = {"target_system": system.get_system_id(), "target_component": 191, "command": command}
        fields |= {"confirmation": 0, "param1": param1, **{f"param{n}": 0 for n in range(2, 8)}}
        message = MavlinkMessage("COMMAND_LONG", 245, 190, system.get_system_id(), 191, json.dumps(fields))
        ack = json.loads(direct.send_command(message).fields_json)
        tell(command=command, param1=param1, result=ack["result"])
    tell(done=True)
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
