#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Time the engine ``fused`` on one core beside ``mujoco.rollout`` on one thread, and whole plans beside their goals.

    python tools/bench_fused.py                                    # physics of the models that are installed
    python tools/bench_fused.py quadruped omni_push_box --worlds 64 512 --json out.json
    python tools/bench_fused.py --plans                            # whole plans, all threads of this machine

Physics: both sides step the same model from the same states with the same controls, in turns; the medians of the runs
are compared. Bodies lie, lean and collide: states are taken after a while of random controls.
"""

from __future__ import annotations

import argparse
import copy
import importlib.util
import json
import os
import platform
import time
from pathlib import Path

import mujoco
import mujoco.rollout
import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

import warpmpc
from warpmpc.engine.fused.plain import PlainRollout
from warpmpc.engine.mujoco import silence_mujoco
from warpmpc.model.compiled import compile_scene
from warpmpc.model.mujoco_model import Options, make_world

FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
OPTION = '<option timestep="0.005" integrator="Euler" iterations="20" tolerance="1e-6"/>'
_LEG = """
<body name="{n}_hip" pos="{x} {y} 0"><joint name="{n}_hip" axis="1 0 0" range="-0.8 0.8"/>
  <inertial pos="0 {s} 0" mass="0.7" diaginertia="0.0007 0.0007 0.0005"/>
  <body name="{n}_thigh" pos="0 {s2} 0"><joint name="{n}_thigh" axis="0 1 0" range="-1 3"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="1"/>
    <body name="{n}_calf" pos="0 0 -0.2"><joint name="{n}_calf" axis="0 1 0" range="-2.7 -0.8"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.19" size="0.013" mass="0.15"/>
      <geom type="sphere" size="0.02" pos="0 0 -0.2" mass="0.06" friction="0.8"/>
    </body></body></body>"""


def quadruped() -> mujoco.MjModel:
    """Twelve joints like those of a Go1, trunk and legs of simple shapes, servos with limits."""
    legs = "".join(
        _LEG.format(n=name, x=x, y=y, s=0.04 * np.sign(y), s2=0.08 * np.sign(y))
        for name, x, y in (("fr", 0.19, -0.05), ("fl", 0.19, 0.05), ("rr", -0.19, -0.05), ("rl", -0.19, 0.05))
    )
    joints = [f"{leg}_{part}" for leg in ("fr", "fl", "rr", "rl") for part in ("hip", "thigh", "calf")]
    servos = "".join(f'<position joint="{j}" kp="30" kv="1" forcerange="-24 24"/>' for j in joints)
    pose = " ".join(["0 0.9 -1.8"] * 4)
    return mujoco.MjModel.from_xml_string(f"""
<mujoco><compiler angle="radian" autolimits="true"/>{OPTION}
<default><joint armature="0.01" damping="0.3"/><geom condim="3"/></default>
<worldbody><geom type="plane" size="9 9 .1"/>
<body name="trunk" pos="0 0 0.3"><freejoint/><geom type="box" size=".19 .05 .06" mass="5"/>{legs}</body></worldbody>
<actuator>{servos}</actuator>
<keyframe><key qpos="0 0 0.3 1 0 0 0 {pose}" ctrl="{pose}"/></keyframe></mujoco>""")


def arm_with_box() -> mujoco.MjModel:
    """Seven hinges on a column with a ball at the hand, and a box on the floor before it."""
    links, end, bits = "", "", "contype='0' conaffinity"
    for i, length in enumerate((0.05, 0.2, 0.2, 0.2, 0.15, 0.1, 0.05)):
        axis = "0 1 0" if i % 2 else "0 0 1"
        links += (
            f'<body pos="0 0 {0.33 if i == 0 else 0.0}">'
            f'<joint name="j{i}" axis="{axis}" range="-2.6 2.6" damping="1" armature="0.1"/>'
            f'<geom type="capsule" fromto="0 0 0 0 0 {length}" size="0.05" mass="1.5" {bits}="{int(i > 3)}"/>'
            f'<body pos="0 0 {length}">'
        )
        end += "</body></body>"
    servos = "".join(f'<position joint="j{i}" kp="400" kv="40" forcerange="-80 80"/>' for i in range(7))
    return mujoco.MjModel.from_xml_string(f"""
<mujoco><compiler angle="radian" autolimits="true"/>{OPTION}
<worldbody><geom type="plane" size="9 9 .1"/>
{links}<geom type="sphere" size="0.06" mass="0.4" contype="0" conaffinity="1"/>{end}
<body name="box" pos="0.55 0 0.1"><freejoint/><geom type="box" size=".08 .12 .1" mass="0.8"/></body></worldbody>
<actuator>{servos}</actuator>
<keyframe><key qpos="0 1.1 0 0.9 0 0.3 0 0.55 0 0.1 1 0 0 0" ctrl="0 1.1 0 0.9 0 0.3 0"/></keyframe></mujoco>""")


def humanoid() -> mujoco.MjModel:
    """Newton's ``nv_humanoid.xml`` with its own motors over a floor, without the springs of its free joint."""
    folder = Path(importlib.util.find_spec("newton").submodule_search_locations[0])
    spec = mujoco.MjSpec.from_file(str(folder / "examples/assets/nv_humanoid.xml"))
    for item in (*spec.sensors, *spec.tendons):
        spec.delete(item)
    if not any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in spec.geoms):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9.0, 9.0, 0.1])
    model = spec.compile()
    model.jnt_stiffness[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE] = 0.0
    model.opt.timestep, model.opt.integrator = 0.005, mujoco.mjtIntegrator.mjINT_EULER
    model.opt.iterations, model.opt.tolerance = 20, 1e-6
    model.qpos0[2] = 1.3
    return model


def of_scene(name: str) -> mujoco.MjModel:
    """The model of a shipped scene, as its rollouts step it."""
    scene = warpmpc.load_scene(name)
    compiled = compile_scene(scene)
    substeps = compiled.substeps(scene.engine.substeps, scene.timing.control_dt, 2)
    step = scene.timing.control_dt / substeps
    return make_world(compiled, timestep=step, options=Options.of(scene.engine), sensors=()).model


def shadow_hand() -> mujoco.MjModel:
    """The Shadow hand of gymnasium-robotics with a block; friction along tangents, one contact of a mesh and a box."""
    folder = Path(importlib.util.find_spec("gymnasium_robotics").submodule_search_locations[0])
    model = mujoco.MjModel.from_xml_path(str(folder / "envs/assets/hand/manipulate_block.xml"))
    model.geom_condim[:], model.pair_dim[:] = np.minimum(model.geom_condim, 3), np.minimum(model.pair_dim, 3)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
    return model


OWN = {"quadruped": quadruped, "humanoid": humanoid, "arm_with_box": arm_with_box}
if importlib.util.find_spec("gymnasium_robotics"):
    OWN["shadow_hand"] = shadow_hand
SCENES = (
    "omni_push_box",
    "omni_push_sphere",
    "diff_push_box",
    "panda_push_objects",
    "panda_reach",
    "point_reach",
    "mobile_pick",
)


def spread(model: mujoco.MjModel, worlds: int, *, seconds: float = 0.4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates, velocities and controls that worlds have come to after a while of random controls."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    q, v = np.empty((worlds, model.nq)), np.empty((worlds, model.nv))
    rest, start = data.ctrl.copy(), (data.qpos.copy(), data.qvel.copy())
    limited = model.actuator_ctrllimited.astype(bool)
    width = np.where(limited, 0.5 * np.ptp(model.actuator_ctrlrange, axis=1), 0.5)
    u = rest + 0.5 * width * rng.normal(size=(worlds, model.nu))
    steps = int(seconds / model.opt.timestep)
    for w in range(worlds):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = *start, u[w]
        mujoco.mj_step(model, data, steps)
        q[w], v[w] = data.qpos, data.qvel
    return q, v, u.astype(np.float32).astype(float)


def physics(name: str, worlds: int, *, steps: int, runs: int, lanes: int | None) -> dict:
    """Microseconds of a world-step on one thread, of both.

    Args:
        name: One of the models here, or a shipped scene.
        worlds: Number of worlds.
        steps: Physics steps of a run.
        runs: Runs of each, in turns.
        lanes: Worlds in a number, as many as the processor likes if None.
    """
    model = OWN[name]() if name in OWN else of_scene(name)
    q, v, u = spread(model, worlds)
    engine = PlainRollout(model, worlds, steps, lanes=lanes)
    control = np.repeat(u[None], steps, axis=0)
    start = time.perf_counter()
    ours = engine(q, v, control)[0].copy()
    first = time.perf_counter() - start
    initial = np.zeros((worlds, mujoco.mj_stateSize(model, FULL)))
    initial[:, 1 : 1 + model.nq + model.nv] = np.hstack([q, v])
    other = copy.copy(model)
    data, given = mujoco.MjData(other), np.ascontiguousarray(control.transpose(1, 0, 2))
    state = np.zeros((worlds, steps, initial.shape[1]))
    times: dict[str, list[float]] = {"fused": [], "mujoco": []}
    with mujoco.rollout.Rollout(nthread=0) as rollout:
        for _ in range(runs):
            begin = time.perf_counter()
            engine.launch()
            between = time.perf_counter()
            rollout.rollout(other, data, initial, given if model.nu else None, nstep=steps, state=state)
            times["fused"].append(between - begin)
            times["mujoco"].append(time.perf_counter() - between)
    theirs = state[:, :, 1 : 1 + model.nq].transpose(1, 0, 2)
    each = {key: 1e6 * float(np.median(values)) / (worlds * steps) for key, values in times.items()}
    return {
        "model": name,
        "worlds": worlds,
        "steps": steps,
        "dofs": model.nv,
        "lanes": engine._lanes,
        "fused_us": each["fused"],
        "mujoco_us": each["mujoco"],
        "ratio": float(np.median(np.array(times["mujoco"]) / np.array(times["fused"]))),
        "first_call_s": first,
        "apart_p50": float(np.median(np.abs(ours[-1] - theirs[-1]).max(axis=1))),
    }


PLANS = (
    # scene, overrides, goal on two cores [ms] (issue 13)
    ("omni_push_box", ("planner.samples=64", "planner.horizon=12", "engine.substeps=4"), 2.0),
    ("omni_push_box", ("planner.samples=500", "planner.horizon=12", "engine.substeps=4"), None),
    ("panda_push_objects", ("planner.samples=64", "planner.horizon=12", "engine.substeps=4"), 4.0),
    ("panda_push_objects", ("planner.samples=512", "planner.horizon=12", "engine.substeps=4"), 25.0),
    ("mobile_pick", ("planner.samples=128", "planner.horizon=8", "engine.substeps=3"), 5.0),
    ("mobile_pick", ("planner.samples=750", "planner.horizon=8", "engine.substeps=3"), 25.0),
    ("panda_reach", ("planner.samples=500",), 8.0),
    ("cylinder_push", ("planner.samples=256", "planner.horizon=50"), 4.0),
)


def plan(name: str, overrides: tuple[str, ...], goal: float | None, *, engine: str, plans: int) -> dict:
    """Time whole plans of a scene from states near its start, from observation to command."""
    scene = warpmpc.load_scene(name, overrides=list(overrides))
    found = {"scene": name, "overrides": list(overrides), "engine": engine, "goal_ms": goal}
    try:
        controller = warpmpc.Controller(scene, engine=engine, device="cpu", seed=0)
    except warpmpc.SceneError as error:
        return found | {"refused": str(error).splitlines()[0]}
    plant = warpmpc.Plant(scene, compiled=controller.compiled, task=controller.task)
    times = []
    for _ in range(plans):
        state = plant.observe()
        begin = time.perf_counter()
        u = controller.step(state)
        times.append(1e3 * (time.perf_counter() - begin))
        if plant.done:
            break
        plant.apply(u)
    controller.engine.close()
    kept = times[min(10, len(times) // 2) :]
    return found | {"p50_ms": float(np.median(kept)), "p99_ms": float(np.percentile(kept, 99)), "plans": len(kept)}


def machine() -> dict:
    """What figures were taken on, and how busy it was."""
    cpu = platform.processor()
    try:
        with open("/proc/cpuinfo") as file:
            cpu = next((line.split(":")[1].strip() for line in file if line.startswith("model name")), cpu)
    except OSError:
        pass
    versions = {"warp": wp.__version__, "mujoco": mujoco.__version__}
    return {"cpu": cpu, "cores": len(os.sched_getaffinity(0)), "load": os.getloadavg(), **versions}


def main() -> None:
    """Time models or plans and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", nargs="*", help="models, scenes; with --plans scenes")
    parser.add_argument("--worlds", type=int, nargs="+", default=[512])
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--lanes", type=int, choices=(1, 4, 8, 16))
    parser.add_argument("--plans", type=int, nargs="?", const=100, help="time whole plans, so many of each")
    parser.add_argument("--engine", nargs="+", default=["fused"], help="engines whose plans are timed")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    silence_mujoco()
    wp.config.quiet = True
    results, before = [], machine()
    if options.plans:
        table = Table("scene", "overrides", "engine", "plan p50 [ms]", "p99", "goal")
        for name, overrides, goal in PLANS:
            if options.name and name not in options.name:
                continue
            for engine in options.engine:
                r = plan(name, overrides, goal, engine=engine, plans=options.plans)
                results.append(r)
                figures = [r["refused"], ""] if "refused" in r else [f"{r['p50_ms']:.2f}", f"{r['p99_ms']:.2f}"]
                table.add_row(name, " ".join(overrides), engine, *figures, "-" if goal is None else f"{goal:g}")
    else:
        table = Table("model", "worlds", "dofs", "fused [µs]", "mujoco.rollout", "ratio", "apart", "first call [s]")
        for name in options.name or (*OWN, *SCENES):
            for worlds in options.worlds:
                try:
                    r = physics(name, worlds, steps=options.steps, runs=options.runs, lanes=options.lanes)
                except ValueError as error:
                    results.append({"model": name, "refused": str(error)})
                    table.add_row(name, str(worlds), "", str(error))
                    continue
                results.append(r)
                figures = [f"{r[key]:.2f}" for key in ("fused_us", "mujoco_us")]
                figures += [f"{r['ratio']:.1f}", f"{r['apart_p50']:.0e}", f"{r['first_call_s']:.1f}"]
                table.add_row(name, str(worlds), str(r["dofs"]), *figures)
    console = Console(width=150)
    console.print(table)
    after = machine()
    load = f"load {before['load'][0]:.1f} before, {after['load'][0]:.1f} after"
    console.print(f"{load}, {after['cores']} cores, {after['cpu']}")
    if options.json:
        told = {"machine": before, "load_after": after["load"], "results": results}
        options.json.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
