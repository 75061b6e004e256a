# SPDX-License-Identifier: Apache-2.0
"""``warpmpc run --real-time``: episodes at the pace of the clock, and what kept them from it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

from ..cost.user_files import load_terms
from ..loop.log.run_log import planner_files
from ..physics.runtime.files import try_file
from .interrupts import Interrupts
from .progress import Messages
from .setup import FAILURE, SUCCESS, RunArguments, begin, others_whole, results_only, user_errors
from .terminal import say, say_json

if TYPE_CHECKING:
    from ..loop.plant.plant import Plant
    from ..loop.robots.estimated import MonitoredRobot
    from ..loop.run.real_time import RealTimeResult
    from ..loop.run.run_recorder import RunRecorder
    from .outputs import Outputs
    from .run_folder import RunFolder


def run_real_time(
    arguments: RunArguments,
    *,
    seeds: Sequence[int],
    robot: str,
    speed: float,
    outputs: Outputs,
    refused: Sequence[str],
    json_lines: bool,
    quiet: bool,
) -> int:
    """Run one episode per seed in real time, report, and return the exit code."""
    results: list[RealTimeResult] = []
    folder: RunFolder | None = None
    notices = not quiet and not json_lines
    with results_only() as out, Messages(notices=notices, warnings=not quiet) as messages, Interrupts() as interrupts:
        try:
            with user_errors():
                if refused:
                    raise ValueError(f"{', '.join(refused)}: not with --real-time, where one plant follows the clock")
                if outputs.record and robot != "simulated":
                    raise ValueError(f"--robot {robot}: --record shows the simulated one alone: take --out or --npz")
                outputs.check(seeds, envs=1, jobs=None)
                scene, _ = arguments.load()
                begin(scene, arguments.device)
                options = {"engine": arguments.engine, "device": arguments.device, "robot": robot, "speed": speed}
                asked = {**options, "real_time": True}
                folder = outputs.folder(scene, seeds=seeds, term_files=arguments.term_files, asked=asked)
                from ..loop.run.real_time import run_real_time

                files = [path.absolute() for path in arguments.term_files]
                options |= {"check": interrupts.check, "terms": partial(load_terms, files) if files else None}
                for seed in seeds:
                    with TickLog(outputs, seed) as log:
                        recorder = {"recorder": log.recorder, "log": log.path} if outputs.any else {}
                        results.append(run_real_time(scene, seed=seed, **options, **recorder))
                        log.save()
                    if folder is not None:
                        with others_whole():
                            folder.add(results[-1].to_json())
                    if json_lines:
                        say_json(results[-1].to_json(), out)
                    elif not quiet:
                        say(*described(results[-1]), out=out)
                    if results[-1].reason == "interrupted":
                        return interrupts.code
        except KeyboardInterrupt:
            return interrupts.code
        finally:
            if folder is not None:
                folder.end()
    return SUCCESS if all(result.passed for result in results) and not messages.unwritten else FAILURE


class TickLog:
    """Log of an episode in real time and the files that are made of it; without a folder it is beside them until then.

    Raises:
        ValueError: If there is the log of a run that was killed.
    """

    def __init__(self, outputs: Outputs, seed: int):
        self._outputs, self._seed, self._robot = outputs, seed, None
        self.path = outputs.log(seed) or outputs.beside(seed)
        if self.path is not None and self.path.exists():
            raise ValueError(f"'{self.path}' is left from a run that was killed: warpmpc replay reads it; move it away")
        if self.path is not None and outputs.out is None:
            try_file(self.path)

    def __enter__(self) -> TickLog:
        return self

    def __exit__(self, error: type[BaseException] | None, *more: object) -> None:
        if self.path is not None and self._outputs.out is None and (error is None or self._robot is None):
            for file in (*planner_files(self.path), self.path):
                file.unlink(missing_ok=True)

    def recorder(self, robot: Plant | MonitoredRobot) -> RunRecorder:
        """The recorder of a robot's episode."""
        from ..loop.run.run_recorder import RunRecorder

        self._robot = robot
        return RunRecorder(robot, path=self.path)

    def save(self) -> None:
        """Write the files.

        Raises:
            OSError: If one cannot be written.
            ValueError: If the name of one is not that of such a file.
        """
        if self._robot is None:
            return
        from ..loop.log.run_log import RunLog
        from ..loop.plant.simulated import SimulatedPlant

        log = RunLog.load(self.path)
        self._outputs.save(log, self._seed)
        if not isinstance(self._robot, SimulatedPlant):
            return
        for path in self._outputs.recordings(self._seed):
            from ..extras.record.tick_recording import record_ticks  # slow to import

            with others_whole():
                record_ticks(path, log, self._robot)


def described(result: RealTimeResult) -> Iterator[str]:
    """The lines that tell of an episode."""
    report = result.report
    cost = "" if result.mean_cost is None else f", mean cost {result.mean_cost:.4g}"
    time = f"{result.sim_time:.2f} s, in {result.wall_time:.1f} s of wall time"
    yield f"seed {result.seed}: {result.reason} at {time}{cost}"
    jitter, latency = report.jitter_ms, report.latency_ms
    yield (
        f"  agent    {report.rate:g} Hz, jitter {_percentiles(jitter)}, {report.missed} of {report.ticks} ticks late"
        + (f", the clock waited {report.slipped:.2f} s for the plant" if report.slipped else "")
    )
    if report.plans:
        yield f"  planner  {report.plan_rate:.1f} plans/s, plan {_percentiles(report.plan_ms)}"
        yield f"  latency  {_percentiles(latency)} from observation to plan"
    for kind, count in Counter(fault.kind for fault in report.faults).items():
        yield f"  faults   {count} × {kind}"
    late = slow_planner(result)
    if late:
        yield f"  {late}"


def slow_planner(result: RealTimeResult) -> str | None:
    """Advice on a planner that does not keep up with the clock; None where it does."""
    from ..loop.realtime.pace import slow_plans  # slow to import

    if not result.report.plan_rate:
        return "no plan came in time: real time would need a faster planner, or a lower --speed"
    return slow_plans(result.report.plan_ms["p50"], result.period, speed=result.speed)


def _percentiles(values: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.2f}" for name, value in values.items()) + " ms"
