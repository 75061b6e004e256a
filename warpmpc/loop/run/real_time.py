# SPDX-License-Identifier: Apache-2.0
"""One episode in real time: the planner in a separate process, the robot here, neither waits."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...scene.draw import draw_task
from ...scene.model.compiled import compile_scene
from ...scene.task.task import Task
from ..plant.simulated import SimulatedPlant
from ..realtime.loop import RealTimeReport, RobotLoop, TickLogger
from ..realtime.process import MakeTerms, PlannerProcess
from ..robots.drivers import await_state, find_driver, make_robot
from ..robots.estimated import MonitoredRobot
from .episode import compile_shared, watched
from .fit_samples import fit_to_machine, with_samples
from .result import Result, plain

if TYPE_CHECKING:
    from ...scene.schema import Scene
    from ..plant.plant import Plant


@dataclass(frozen=True, kw_only=True)
class RealTimeResult(Result):
    """Result of one episode in real time; ``mean_cost`` is over all ticks."""

    speed: float
    """Simulated seconds in a second of wall time that were asked for."""
    wall_time: float
    """Wall time [s]."""
    period: float
    """Length of a planned control [s]."""
    report: RealTimeReport
    """Rates, jitter, latencies, faults."""

    def to_json(self) -> dict[str, Any]:
        """The result as data for JSON: plain types, units in the keys."""
        report = self.report
        cost = {"mean_cost": self.mean_cost} if self.success is None else {}
        return plain(
            {
                "scene": self.scene,
                "variant": self.variant,
                "seed": self.seed,
                "success": self.success,
                "reason": self.reason,
                "sim_time_s": self.sim_time,
                "speed": self.speed,
                "wall_time_s": self.wall_time,
                "ticks": report.ticks,
                "rate_Hz": report.rate,
                "jitter_ms": report.jitter_ms,
                "missed_ticks": report.missed,
                "slipped_s": report.slipped,
                "plans": report.plans,
                "plan_rate_Hz": report.plan_rate,
                "latency_ms": report.latency_ms,
                "plan_ms": report.plan_ms,
                "age_ms": report.age_ms,
                "faults": [asdict(fault) for fault in report.faults],
                **cost,
            }
        )


def run_real_time(
    scene: Scene,
    *,
    seed: int = 0,
    engine: str = "auto",
    device: str = "auto",
    terms: MakeTerms | None = None,
    robot: str = "simulated",
    speed: float = 1.0,
    check: Callable[[], None] = lambda: None,
    recorder: Callable[[Plant | MonitoredRobot], TickLogger] | None = None,
    log: Path | None = None,
) -> RealTimeResult:
    """Run one episode of a scene in real time, with the planner in a separate process.

    Args:
        scene: The scene; what its ``randomize_task`` names is drawn from the seed.
        seed: Seed of the task, of the controller's noise and of the plant's properties.
        engine: Engine of the roll-outs, as for :class:`~warpmpc.Controller`.
        device: Device of the roll-outs, as for :class:`~warpmpc.Controller`.
        terms: Makes users' cost terms, here and in the planner's process.
        robot: Name of the robot's driver (``warpmpc.scene.registry.ROBOTS``), and its file: ``NAME:FILE.toml``.
        speed: Simulated seconds in a second of wall time.
        check: Called at every tick; a ``KeyboardInterrupt`` from it ends the episode.
        recorder: Makes what takes note of every tick, from the robot, such as :class:`~warpmpc.RunRecorder`; it is
            closed.
        log: Run log beside which plans are noted.

    Raises:
        SceneError: If the scene names anything that does not exist, or has point clouds.
        ValueError: If the speed is no positive number, the engine or device is not available here, there is no such
            robot, it shows no state, or its clock does not go slower.
    """
    if not 0.0 < speed < float("inf"):
        raise ValueError(f"the speed is a positive number, not {speed}")
    made = tuple(terms()) if terms else ()
    name = robot.partition(":")[0]
    find_driver(robot)  # before anything takes long
    shared = compile_shared(scene)
    samples, engine, device = fit_to_machine(scene, engine=engine, device=device, terms=made, compiled=shared)
    drawn = with_samples(draw_task(scene, seed)[0], samples)
    compiled, task = shared or compile_scene(drawn), Task(drawn)
    common = {"seed": seed, "task": task, "compiled": compiled}
    with ExitStack() as stack:
        driver = make_robot(robot, drawn, terms=made, watch=watched(scene), **common)
        stack.callback(getattr(driver, "close", lambda: None))
        plant = isinstance(driver, SimulatedPlant)
        simulated = plant or getattr(driver, "simulated", False)
        if speed != 1.0 and not (simulated or getattr(driver, "use_sim_time", False)):
            raise ValueError(f"the robot '{name}' is not simulated: its speed is 1, not {speed:g}")
        run = driver if plant else MonitoredRobot(drawn, driver, task=task, terms=made, compiled=compiled)
        await_state(driver, name)
        options = {"engine": engine, "device": device, "terms": terms, "speed": speed, "log": log}
        planner = stack.enter_context(PlannerProcess(drawn, **options, **common))
        getattr(driver, "show_paths", lambda source: None)(planner.paths)
        if not plant:
            run.observe()  # the recorder begins with a state
        made_recorder = recorder(run) if recorder else None
        loop = RobotLoop(drawn, run, planner, speed=speed, simulated=simulated, recorder=made_recorder)
        ends = []  # success, reason and time as the robot is before it is stopped

        def over() -> bool:
            check()
            ends[:] = [run.success, run.reason, run.time]
            return run.done

        reason = None
        try:
            loop.run(over)
        except KeyboardInterrupt:
            reason = "interrupted"
        finally:
            if made_recorder is not None:
                made_recorder.close()
        report = loop.report()
    success, why, moment = ends or (run.success, run.reason, run.time)
    return RealTimeResult(
        scene=scene.name,
        variant=scene.variant,
        seed=seed,
        success=success if scene.success else None,
        reason=why if success else reason or why,
        sim_time=moment,
        speed=speed,
        wall_time=loop.wall,
        period=scene.timing.control_dt,
        report=report,
        mean_cost=None if scene.success else run.mean_cost,
    )
