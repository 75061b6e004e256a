# SPDX-License-Identifier: Apache-2.0
"""What ``warpmpc run --real-time`` does: episodes at the pace of the clock, and what kept them from it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..scene.load import load_scene
from .interrupts import Interrupts
from .progress import Messages
from .setup import FAILURE, SUCCESS, results_only, start_warp, user_errors
from .terms import load_terms

if TYPE_CHECKING:
    from ..plant.plant import Plant
    from ..record.ticks import TickRecorder
    from ..run.real_time import RealTimeResult
    from .outputs import Outputs


def run_real_time(
    source: str,
    *,
    seeds: Sequence[int],
    speed: float,
    overrides: Sequence[str],
    term_files: Sequence[Path],
    engine: str,
    device: str,
    outputs: Outputs,
    refused: Sequence[str],
    json_lines: bool,
    quiet: bool,
) -> int:
    """Run one episode per seed in real time, report, and return the exit code.

    Args:
        source: Scene and variant.
        seeds: Seeds of the episodes.
        speed: Simulated seconds in a second of wall time.
        overrides: ``KEY=VALUE`` texts.
        term_files: Python files of cost terms.
        engine: Engine of the roll-outs.
        device: Device of the roll-outs.
        outputs: Files to write.
        refused: Options that were given and do not go with real time.
        json_lines: Whether to print JSON.
        quiet: Whether to print nothing.
    """
    results: list[RealTimeResult] = []
    notices = not quiet and not json_lines
    with results_only() as out, Messages(notices=notices, warnings=not quiet), Interrupts() as interrupts:
        try:
            with user_errors():
                if refused:
                    raise ValueError(f"{', '.join(refused)}: not with --real-time, where one plant follows the clock")
                outputs.check(seeds, envs=1, jobs=None)
                scene = load_scene(source, overrides=overrides)
                start_warp()
                asked = {"engine": engine, "device": device, "real_time": True, "speed": speed}
                folder = outputs.folder(scene, seeds=seeds, term_files=term_files, asked=asked)
                from ..run.real_time import run_real_time

                options = {"engine": engine, "device": device, "speed": speed, "check": interrupts.check}
                terms = partial(load_terms, [path.absolute() for path in term_files]) if term_files else None
                for seed in seeds:
                    recorder = TickRecording() if outputs.any else None
                    options |= {"recorder": recorder, "log": outputs.any}
                    results.append(run_real_time(scene, seed=seed, terms=terms, **options))
                    if recorder is not None:
                        recorder.save(outputs, results[-1])
                    if folder is not None:
                        folder.add(results[-1].to_json())
                    if json_lines:
                        line = json.dumps(results[-1].to_json(), ensure_ascii=False, allow_nan=False)
                        print(line, file=out, flush=True)
                    elif not quiet:
                        print(*described(results[-1]), sep="\n", file=out, flush=True)
                    if results[-1].reason == "interrupted":
                        return interrupts.code
        except KeyboardInterrupt:
            return interrupts.code
    return SUCCESS if all(result.passed for result in results) else FAILURE


class TickRecording:
    """Takes note of an episode's ticks and writes the files that are wanted of it; makes its recorder when called."""

    def __call__(self, robot: Plant) -> TickRecorder:
        """The recorder of the episode of a simulated robot."""
        from ..record.ticks import TickRecorder

        self._robot, self._recorder = robot, TickRecorder(robot)
        return self._recorder

    def save(self, outputs: Outputs, result: RealTimeResult) -> None:
        """Write the files.

        Raises:
            OSError: If one cannot be written.
            ValueError: If the name of one is not that of such a file.
        """
        history = self._recorder.history(result.report.faults, result.made)
        outputs.save(history, result.seed)
        for path in outputs.recordings(result.seed):
            from ..record.tick_recording import record_ticks  # slow to import

            record_ticks(path, history, self._robot)


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
    """What to do about a planner that does not keep up with the clock; None where it does."""
    from ..run.advice import slow_plans  # slow to import

    if not result.report.plan_rate:
        return "no plan came in time: real time would need a faster planner, or a lower --speed"
    return slow_plans(result.report.plan_ms["p50"], result.period, speed=result.speed)


def _percentiles(values: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.2f}" for name, value in values.items()) + " ms"
