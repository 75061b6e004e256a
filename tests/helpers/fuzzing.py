# SPDX-License-Identifier: Apache-2.0
"""Hands mutants to the command line and judges what comes of it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from mutants import FILES, Mutant, mutant

PATIENCE = 10.0
"""Longest processor time that a mutant may take [s], unless a kernel was compiled; other programs do not count."""
LAST_WORD = 120.0
"""Time after which a process that says nothing is given up [s]."""

_NAMED = re.compile(
    r"^error: (?:terms\.py: |.*?(?:\.(?:toml|py|urdf|xml|stl):\d+|\.toml(?: \[variants\.\w+\])?: [\w\"'*][^:\s]*): )"
)
"""An error that names a file and a line of it, or a key; of a file of terms that has none in it, the file."""


_SAID = re.compile(r"warning: |a plan of \d+ samples takes ")
"""Warnings, and the notice of how many samples were taken."""


@dataclass(frozen=True)
class Outcome:
    """What came of a command."""

    seed: int
    what: str
    """The change that was tried."""
    code: int | None
    """Its exit code, None if an exception got out."""
    err: str
    seconds: float
    compiled: bool
    """Whether a kernel was compiled on the way."""

    @property
    def fault(self) -> str | None:
        """What is wrong with it; None for a run, or lines that name file and key each."""
        lines = [line for line in self.err.splitlines() if not _SAID.match(line)]
        if self.code is None or "Traceback" in self.err:
            return "a traceback"
        if self.seconds > PATIENCE and not self.compiled:
            return f"took {self.seconds:.1f} s"
        if self.code in (0, 1):
            return f"says more than warnings: {lines[0]}" if lines else None
        if self.code != 2:
            return f"exit code {self.code}"
        if not lines:
            return "no line on stderr"
        wrong = [line for line in lines if not _NAMED.search(line) or not any(name in line for name in FILES)]
        return f"names no file and key: {wrong[0]}" if wrong else None

    def __str__(self) -> str:
        return f"seed {self.seed}, {self.what}: {self.fault or 'fine'}\n    {self.err.strip()[-1500:]}"


def outcome(case: Mutant) -> Outcome:
    """Check the scene of a mutant, or run it for three controls, in this process."""
    import warp as wp

    from warpmpc.cli.main import app

    short = ["--set", "timing.control_dt=0.04", "--set", "timing.timeout=0.12"]
    with tempfile.TemporaryDirectory() as folder, _in_folder(Path(folder)), _seen() as said:
        case.write(Path(folder))
        args = ["run", case.scene, "--quiet", *short] if case.seed % 2 else ["check", case.scene]
        args += ["--terms", "terms.py"] if case.scene == "arm.toml" else []
        before, start, code = _compiled(wp), time.process_time(), None
        try:
            app(args, prog_name="warpmpc")
        except SystemExit as end:
            code = end.code
        except Exception:
            traceback.print_exc()
        seconds, compiled = time.process_time() - start, _compiled(wp) != before
    return Outcome(case.seed, case.what, code, said[1], seconds, compiled)


def outcomes(seeds: Sequence[int]) -> Iterator[Outcome]:
    """Outcomes of many mutants in a separate process, and in another one whenever that crashes or hangs."""
    left = list(seeds)
    while left:
        worker = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        with worker:
            try:
                while left:
                    worker.stdin.write(f"{left[0]}\n")
                    worker.stdin.flush()
                    with _alarm(LAST_WORD):
                        answer = worker.stdout.readline()
                    if not answer:
                        worker.wait()
                        yield Outcome(
                            left[0], mutant(left.pop(0)).what, worker.returncode, "the process died", 0.0, False
                        )
                        break
                    left.pop(0)
                    yield Outcome(**json.loads(answer))
            except TimeoutError:
                yield Outcome(left[0], mutant(left.pop(0)).what, None, "the process hangs", LAST_WORD, False)
            finally:
                worker.kill()


def _compiled(wp) -> int:
    """How many modules of kernels are in Warp's cache."""
    return len(os.listdir(wp.config.kernel_cache_dir)) if wp.config.kernel_cache_dir else 0


@contextmanager
def _in_folder(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


@contextmanager
def _seen() -> Iterator[list[str]]:
    """What is printed, by native code, too: standard output and error, once it is over."""
    said, kept = [], [os.dup(1), os.dup(2)]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        streams = sys.stdout, sys.stderr
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        try:
            yield said
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
            sys.stdout, sys.stderr = streams
            for number, copy in zip((1, 2), kept, strict=True):
                os.dup2(copy, number)
                os.close(copy)
            for file in (out, err):
                file.seek(0)
                said.append(file.read().decode(errors="replace"))


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    def ring(number: int, frame: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def main() -> None:
    """Outcomes of the seeds that come in, a line each."""
    for line in sys.stdin:
        print(json.dumps(asdict(outcome(mutant(int(line))))), flush=True)


if __name__ == "__main__":
    main()
