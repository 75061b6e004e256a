# SPDX-License-Identifier: Apache-2.0
"""Episodes in which a fabric drives the plant of a scene of Table I."""

from __future__ import annotations

import json
import re
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from studies.paper.constrained import task as constrained

if TYPE_CHECKING:
    from warpmpc import Plant, Scene

SERVER = Path(__file__).with_name("server.py")
STEPS = 4
"""Steps of a fabric in a control: 10 ms each, as in the package's examples."""
DISC = ([{"base_link": 1.0}, 0.2],)
ARM = tuple(
    [{f"panda_link{link}": share for link, share in links.items()}, radius]
    for links, radius in (
        *(({3: 1.0}, 0.1), ({4: 1.0}, 0.1), ({4: 0.67, 5: 0.33}, 0.09), ({4: 0.33, 5: 0.67}, 0.09)),
        *(({5: 1.0}, 0.1), ({7: 1.0}, 0.1)),
    )
)
"""Spheres that keep clear of the obstacles: shares of the places of links, and radius [m]."""
RANGES = ((-2.8973, 2.8973), (-1.7628, 1.7628), (-2.8973, 2.8973), (-3.0718, -0.0698), (-2.8973, 2.8973))
RANGES = (*RANGES, (-0.0175, 3.7525), (-2.8973, 2.8973))
"""The Panda's joints [rad]."""


def task_of(scene: Scene) -> dict:
    """A drawn scene for the server.

    Raises:
        ValueError: If the scene is not one of Table I.
    """
    from warpmpc.scene.model.assets import resolve_asset

    robot = scene.robot[0]
    kinds = {
        "base": {"points": DISC, "limits": (), "urdf": None, "root": "world", "hand": "base_link", "dimension": 2},
        "panda": {"points": ARM, "limits": RANGES, "root": "panda_link0", "hand": "panda_link7", "dimension": 3},
    }
    if scene.name not in ("point_reach", "panda_reach"):
        raise ValueError(f"fabrics play point_reach and panda_reach, not '{scene.name}'")
    kind = kinds[robot.name]
    if "urdf" not in kind:
        path = resolve_asset(robot.asset, base=scene.path.parent, key="robot.asset")
        # its parser knows no capsules
        kind["urdf"] = re.sub(r"(?s)<collision>.*?</collision>", "", path.read_text(encoding="utf-8"))
    spheres = [[list(ball.position), float(np.ravel(ball.size)[0])] for ball in scene.obstacle]
    count = len(kind["limits"]) or kind["dimension"]
    (drive,) = robot.drive
    speed = np.broadcast_to(drive.limit, len(drive.joints))[:count].tolist()
    common = {"spheres": spheres, "goal": list(scene.goal.position), "speed": speed}
    return {**kind, **common, "dt": scene.timing.control_dt, "steps": STEPS}


class Server:
    """A server's process: a fabric's, or that of another method that answers as it does.

    Args:
        python: A Python that has the package.
        task: As :func:`task_of` returns it.
        script: The server.
        option: Option of the command line that names the Python.
        package: What it needs of PyPI.

    Raises:
        ValueError: If the Python does not exist or the method cannot be built; the message has the last line it said.
    """

    def __init__(
        self,
        python: str,
        task: dict,
        *,
        script: Path = SERVER,
        option: str = "--fabrics",
        package: str = "fabrics==0.10.0",
    ):
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115 (a pipe that nobody reads would fill)
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._said}
        try:
            self._process = subprocess.Popen([python, str(script)], text=True, **pipes)
        except OSError as error:
            raise ValueError(f"{option} {python}: {error}") from None
        self.plan_ms: list[float] = []
        self._joints = len(task["speed"])
        if self._asked(task) != "ready\n":
            self._process.wait()
            self._said.seek(0)
            last = (self._said.read().splitlines() or ["it ended"])[-1]
            raise ValueError(f"{option} {python}: {last}; it needs: pip install {package}")

    def __call__(self, q: np.ndarray, qd: np.ndarray, nu: int) -> np.ndarray:
        """Control ``[nu]`` for joints ``[n]`` and their velocities."""
        state = {"q": q[: self._joints].tolist(), "qd": qd[: self._joints].tolist()}
        answer = json.loads(self._asked(state))
        self.plan_ms.append(answer["ms"])
        control = np.zeros(nu, dtype=np.float32)
        control[: self._joints] = answer["u"]
        return control

    def _asked(self, data: dict) -> str:
        try:
            self._process.stdin.write(json.dumps(data) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            return ""
        return self._process.stdout.readline()

    def close(self) -> None:
        """End the process."""
        self._process.communicate()
        self._said.close()


def drive(plant: Plant, method: Callable[[np.ndarray, np.ndarray, int], np.ndarray]) -> dict:
    """Let a method drive a plant to the end of its episode; ``result`` and ``measured`` as of other runs."""
    from shared.measure import Meter

    meter = Meter(plant)
    while not plant.done:
        state = plant.observe()
        control = method(state.joint_q, state.joint_qd, plant.layout.nu)
        plant.apply(control)
        meter(None, plant, control)
    result = {
        "success": plant.success,
        "reason": plant.reason,
        "time_to_goal_s": plant.time if plant.success else None,
        "collisions": {"max_force_N": plant.contact.max_force},
    }
    return {"result": result, "measured": meter.to_json()}


def episode(python: str, source: str, seed: int, method: str = "fabrics") -> dict:
    """Run one episode by ``fabrics`` or a key of ``MOST``: task and plant are those of our run with this seed.

    Raises:
        ValueError: As :class:`Server`.
    """
    import warpmpc
    from warpmpc.scene.draw import draw_task
    from warpmpc.scene.model.compiled import compile_scene

    scene, _ = draw_task(warpmpc.load_scene(source), seed)
    compiled = compile_scene(scene)
    plant = warpmpc.Plant(scene, seed=seed, compiled=compiled)
    if method == "fabrics":
        server = Server(python, task_of(scene))
    else:
        options = {"script": constrained.SERVER, "option": "--casadi", "package": "casadi"}
        server = Server(python, constrained.task_of(scene, compiled, method), **options)
    try:
        record = drive(plant, server)
    finally:
        server.close()
    record["result"]["plan_ms"] = {"p50": float(np.median(server.plan_ms))}
    return record
