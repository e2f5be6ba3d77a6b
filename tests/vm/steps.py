"""Runs inside the virtual machine, as root: what the service does under a real systemd, step by step.

Prints one line of JSON for each step. A step returns in words what it saw, or raises `Failed`.
"""

from __future__ import annotations

import json
import os
import pwd
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

UNIT = "locagen-edge.service"
USER = "locagen-edge"
STATE = Path("/var/lib/locagen-edge")
SETTINGS = Path("/etc/locagen-edge/locagen-edge.toml")
GROUP = Path("/sys/fs/cgroup/system.slice") / UNIT
DRIVER = Path("/sys/bus/platform/drivers/snd_aloop")
CARD = "snd_aloop.0"
CAPTURE = Path("/proc/asound/Loopback/pcm1c/sub0/status")
NEIGHBOURS = 8
POLL_S = 0.1
PATIENCE_S = 60.0
"""where no bound is promised"""


class Failed(Exception):
    pass


def systemctl(*arguments: str) -> str:
    done = subprocess.run(["systemctl", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise Failed(f"systemctl {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout.strip()


def show(name: str) -> str:
    return systemctl("show", "-P", name, UNIT)


def until(what: str, holds: Callable[[], object], within_s: float) -> float:
    """Seconds until it holds."""
    start = time.monotonic()
    while not holds():
        if time.monotonic() - start > within_s:
            raise Failed(f"not {what} within {within_s:g} s: {show('ActiveState')}, {show('StatusText')}")
        time.sleep(POLL_S)
    return time.monotonic() - start


def active() -> bool:
    return show("ActiveState") == "active"


def listening() -> bool:
    return active() and show("StatusText").startswith("listening")


def sounding() -> bool:
    """Whether the card is being read: told by the kernel at once, by the service once a second."""
    try:
        return "RUNNING" in CAPTURE.read_text()
    except OSError:
        return False


def journal(*arguments: str) -> list[str]:
    done = subprocess.run(
        ["journalctl", "-u", UNIT, "-o", "cat", *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


def refused() -> list[str]:
    """System calls that the filter did not let through, as the kernel tells them."""
    lines = subprocess.run(["dmesg"], capture_output=True, text=True, check=True).stdout.splitlines()
    return [line for line in lines if "type=1326" in line]


def restarted(act: Callable[[], object], result: str) -> str:
    """Does something to the service and waits until another process of it is ready."""
    before = show("MainPID")
    act()
    seconds = until("restarted", lambda: show("MainPID") not in ("0", before) and active(), PATIENCE_S)
    if not any(f"Failed with result '{result}'" in line for line in journal()):
        raise Failed(f"came back, but the journal tells of no '{result}'")
    return f"ready again after {seconds:.1f} s"


def hog(program: str) -> subprocess.Popen[bytes]:
    """A process within the bounds of the service, as a thread of its own gone wild would be."""
    join = f"open('{GROUP}/cgroup.procs', 'w').write('0')"
    return subprocess.Popen([sys.executable, "-c", f"{join}\n{program}"])


# --- the steps


def starts() -> str:
    begin = time.monotonic()
    systemctl("start", UNIT)
    seconds = time.monotonic() - begin
    if not active():
        raise Failed(f"is {show('ActiveState')}")
    until("listening", listening, PATIENCE_S)
    return f"ready after {seconds:.1f} s"


def is_locked_up() -> str:
    """What the kernel itself says of the process."""
    process = Path("/proc") / show("MainPID")
    status = dict(line.split(":\t", 1) for line in (process / "status").read_text().splitlines())
    uid = str(pwd.getpwnam(USER).pw_uid)
    found = {
        "user": status["Uid"].split()[0] == uid,
        "no capabilities": int(status["CapBnd"], 16) == int(status["CapEff"], 16) == 0,
        "no new privileges": status["NoNewPrivs"] == "1",
        "system calls filtered": status["Seccomp"] == "2",
        "nothing writable and executable": not any(
            " rwx" in line for line in (process / "maps").read_text().splitlines()
        ),
        "MemoryDenyWriteExecute": show("MemoryDenyWriteExecute") == "yes",
    }
    if lacking := [name for name, holds in found.items() if not holds]:
        raise Failed(f"lacks {', '.join(lacking)}")
    return ", ".join(found)


def hears_and_tells() -> str:
    """The other end of the serial line is watched from outside."""
    frames = frames_so_far()
    time.sleep(15)
    heard = frames_so_far() - frames
    if heard < 132:  # nine tenths of what comes in 15 s at a hop of 1024; the status line is a second old
        raise Failed(f"{heard} frames in 15 s: {show('StatusText')}")
    return f"{heard} frames in 15 s; {show('StatusText')}"


def frames_so_far() -> int:
    words = show("StatusText").split()
    return int(words[words.index("frames,") - 1])


def killed() -> str:
    return restarted(lambda: os.kill(int(show("MainPID")), signal.SIGKILL), "signal")


def hangs() -> str:
    """A stopped process answers nobody: the watchdog has to bite, and says where each thread was."""
    told = restarted(lambda: os.kill(int(show("MainPID")), signal.SIGSTOP), "watchdog")
    if not any("most recent call first" in line for line in journal()):
        raise Failed(f"{told}, but the journal does not say where it hung")
    return told


def crashes_again_and_again() -> str:
    """Each restart is put off for longer, by the program itself."""
    systemctl("stop", UNIT)
    good, before = SETTINGS.read_text(), len(put_off())
    SETTINGS.write_text(good + "\nno such key = 1\n")
    systemctl("start", "--no-block", UNIT)
    try:
        until("put off for the third time", lambda: len(put_off()) >= before + 3, PATIENCE_S)
    finally:
        SETTINGS.write_text(good)
    waits = put_off()[before:]
    systemctl("stop", UNIT)
    systemctl("start", UNIT)
    until("listening", listening, PATIENCE_S)
    if waits[:3] != ["1", "2", "4"]:
        raise Failed(f"put off for {waits} s")
    return f"put off for {', '.join(waits)} s; mended, it starts at once"


def put_off() -> list[str]:
    """The seconds that starts were put off for."""
    return [line.split()[-2] for line in journal() if line.startswith("failed again and again")]


def card_pulled_and_back() -> str:
    """Three times."""
    until("reading", sounding, PATIENCE_S)
    process, found_s, load = show("MainPID"), [], 0.0
    for away_s in (4.0, 1.0, 6.5):
        unbind()
        used, begin = cpu_s(), time.monotonic()
        time.sleep(away_s)
        load = max(load, (cpu_s() - used) / (time.monotonic() - begin))
        if show("MainPID") != process:
            raise Failed("the process did not outlive it")
        (DRIVER / "bind").write_text(CARD)
        found_s.append(until("reading", sounding, 30))
    until("listening", listening, PATIENCE_S)
    if not any("audio.device" in line or "device" in line for line in journal("-p", "err")):
        raise Failed("the journal tells of no error")
    told = f"read again after {', '.join(f'{s:.1f}' for s in found_s)} s; same process; "
    told += f"{100 * load:.0f} % of a core while it was away"
    if max(found_s) > 2.0:
        raise Failed(told)
    return told


def unbind() -> None:
    """Returns when the last who had the card open has let go of it: bounded, or it would wait for ever."""
    writer = subprocess.Popen(["sh", "-c", f"echo {CARD} > {DRIVER}/unbind"])
    try:
        writer.wait(30)
    except subprocess.TimeoutExpired:
        holders = subprocess.run(
            "ls -l /proc/[0-9]*/fd/* 2>/dev/null | grep snd/; ps -eo pid,comm,wchan:30", shell=True,
            capture_output=True, text=True, check=False,
        ).stdout  # fmt: skip
        raise Failed(f"somebody holds on to the card: {holders}") from None


def cpu_s() -> float:
    return int(show("CPUUsageNSec")) * 1e-9


def memory_is_bounded() -> str:
    most = int(show("MemoryMax"))
    peak = int((GROUP / "memory.peak").read_text())
    took: list[int] = []

    def eat() -> None:
        took.append(hog(f"x = bytearray({2 * most}); x[::4096] = b'1' * len(x[::4096])").wait(60))

    told = restarted(eat, "oom-kill")
    if took != [-signal.SIGKILL] or peak >= most:
        raise Failed(f"{told}; the hog ended with {took}, peak {peak / 2**20:.0f} MiB")
    return f"own peak {peak / 2**20:.0f} of {most / 2**20:.0f} MiB; what took more was killed; {told}"


def processor_is_bounded() -> str:
    until("listening", listening, PATIENCE_S)
    hogs = [hog("while True: pass") for _ in range(3)]
    time.sleep(1)
    used, begin = cpu_s(), time.monotonic()
    time.sleep(5)
    share = (cpu_s() - used) / (time.monotonic() - begin)
    for one in hogs:
        one.kill()
        one.wait()
    if not 0.5 < share < 1.1:
        raise Failed(f"{share:.2f} cores")
    return f"three busy threads more: {share:.2f} cores in all, of {os.cpu_count()}"


def has_its_weight_among_neighbours() -> str:
    """All want all there is: ours gets four times what each of eight services of usual weight gets."""
    until("listening", listening, PATIENCE_S)
    units = [f"busy@{number}.service" for number in range(NEIGHBOURS)]
    systemctl("start", *units)
    groups = [GROUP, *(GROUP.parent / unit for unit in units)]
    hogs = [hog("while True: pass") for _ in range(3)]
    time.sleep(2)
    before = [used_s(group) for group in groups]
    time.sleep(8)
    ours, *theirs = (used_s(group) - then for group, then in zip(groups, before, strict=True))
    for one in hogs:
        one.kill()
        one.wait()
    systemctl("stop", *units)
    ratio = ours / statistics.mean(theirs)
    told = f"{ratio:.1f} times what each of {NEIGHBOURS} busy services gets; {show('StatusText')}"
    if not 3.0 < ratio < 5.0:
        raise Failed(told)
    return told


def used_s(group: Path) -> float:
    """Time of the processor that a control group has taken."""
    fields = dict(line.split() for line in (group / "cpu.stat").read_text().splitlines())
    return int(fields["usage_usec"]) * 1e-6


def stops() -> str:
    """In the middle of its work. By systemd's clock, from its signal to the end of the last process."""
    until("listening", listening, PATIENCE_S)
    begin = time.monotonic()
    systemctl("stop", UNIT)
    asked, ended = (int(show(f"{name}TimestampMonotonic")) * 1e-6 for name in ("ActiveExit", "InactiveEnter"))
    result = f"{show('Result')}, exit code {show('ExecMainStatus')}"
    told = f"{result}, after {ended - asked:.2f} s"
    if result != "success, exit code 0" or not begin < asked < ended < asked + 1.0:
        raise Failed(told)
    return told


def leaves_nothing_elsewhere() -> str:
    command = ["find", "/", "-xdev", "-user", USER, "-not", "-path", "/proc/*"]
    found = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
    elsewhere = [path for path in found if not path.startswith(str(STATE))]
    if elsewhere:
        raise Failed(", ".join(elsewhere[:5]))
    return f"{len(found)} files, all below {STATE}"


def loads_all_models() -> str:
    """By hand, as its user, with the built-in settings: onnxruntime on this processor."""
    command = ["setpriv", f"--reuid={USER}", f"--regid={USER}", "--init-groups", "locagen-edge", "check",
               "--settings", "/dev/null"]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    models = [line for line in done.stdout.splitlines() if "models: " in line]
    if not models or any(not line.startswith("ok") or "hash and tensors" not in line for line in models):
        raise Failed(f"exit code {done.returncode}: {models or done.stderr[-500:]}")
    return "; ".join(line.partition("models: ")[2] for line in models)


STEPS = (
    starts,
    is_locked_up,
    hears_and_tells,
    killed,
    hangs,
    card_pulled_and_back,
    processor_is_bounded,
    has_its_weight_among_neighbours,
    memory_is_bounded,
    crashes_again_and_again,
    stops,
    leaves_nothing_elsewhere,
    loads_all_models,
)


def main() -> None:
    chosen = os.environ.get("ONLY", "").split(",")
    for step in STEPS:
        if chosen != [""] and step.__name__ not in chosen:
            continue
        begin = time.monotonic()
        try:
            passed, told = True, step()
        except Failed as failure:
            passed, told = False, str(failure)
        except Exception as error:
            passed, told = False, repr(error)
        result = {"step": step.__name__, "passed": passed, "told": told, "seconds": time.monotonic() - begin}
        print(f"\n{json.dumps(result)}", flush=True)
        if not passed:
            print("\n".join(f"| {line}" for line in [*journal("-n", "40"), *refused()]), flush=True)
            if step is starts:
                return


if __name__ == "__main__":
    main()
