# SPDX-License-Identifier: Apache-2.0
"""Calls for workers to make."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import warpmpc

prepared = 0
"""How often this process was prepared."""


def prepare() -> None:
    """Prepare this process."""
    global prepared
    prepared += 1


def where() -> tuple[int, int, str | None]:
    """This process, how often it was prepared, and the GPUs it sees."""
    return os.getpid(), prepared, os.environ.get("CUDA_VISIBLE_DEVICES")


def meet(folder: str, name: str, others: int) -> int:
    """Wait until as many others are here; returns this process."""
    (Path(folder) / name).touch()
    end = time.monotonic() + 60.0
    while len(list(Path(folder).iterdir())) <= others:
        if time.monotonic() > end:
            raise TimeoutError("nobody came")
        time.sleep(0.02)
    return os.getpid()


def meet_where(folder: str, name: str, others: int) -> tuple[int, int, str | None]:
    """:func:`where`, once as many others are in processes of their own."""
    meet(folder, name, others)
    return where()


def die_once(folder: str, value: int) -> int:
    """Kill this process, but the second time return a value."""
    mark = Path(folder) / f"died-{value}"
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def die(folder: str) -> None:
    """Kill this process and count that."""
    (Path(folder) / f"died-{time.monotonic_ns()}").touch()
    os.kill(os.getpid(), signal.SIGKILL)


def refuse() -> None:
    """Raise what scenes raise."""
    raise warpmpc.SceneError("is wrong", key="planner.samples", file="some.toml", found="x", allowed=["y"])


def chat() -> int:
    """Print something."""
    print("libraries chat")
    os.write(1, b"from native code, too\n")
    return 1


def sleep(mark: str) -> None:
    """Leave this process' number in a file and stay for long."""
    Path(mark).with_suffix(".part").write_text(str(os.getpid()))
    Path(mark).with_suffix(".part").rename(mark)
    time.sleep(600.0)


def linger_once(mark: str, value: int) -> int:
    """Leave this process' number in a file and stay until told to go; where the file is already, return at once."""
    if not Path(mark).exists():
        Path(mark).with_suffix(".part").write_text(str(os.getpid()))
        Path(mark).with_suffix(".part").rename(mark)
        while not Path(mark).with_suffix(".go").exists():
            time.sleep(0.02)
    return value


def gone(process: int) -> bool:
    """Whether a process has ended; one that nobody has waited for counts."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):  # the second: it ended between opening the file and reading it
        return True
    return state == "Z"
