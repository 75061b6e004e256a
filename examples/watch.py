# SPDX-License-Identifier: Apache-2.0
"""A cost term and a residual that use every function of a step, on the discs of ``cylinder_push``: python watch.py."""

import warp as wp

import warpmpc


@wp.struct
class WatchParams:
    """Keys of the term: names in the scene file become numbers."""

    memory: int  # first of its numbers; scene files do not set it
    frame: int
    joint: int
    sensor: int  # the first number of a sensor of the file
    robot: int  # a robot or an object
    rest: float  # [s] from this time on it counts double


def add_way(s: warpmpc.StepView, p: WatchParams):
    """Add up the way of the frame along the rollout."""
    if s.t == 0:
        warpmpc.remember(s, p.memory, 0.0)
    else:
        before = warpmpc.frame_position(warpmpc.step_before(s), p.frame)
        way = wp.length(warpmpc.frame_position(s, p.frame) - before)
        warpmpc.remember(s, p.memory, warpmpc.memory_before(s, p.memory) + way)


@warpmpc.cost_term("watch", advance=add_way, numbers=1)
def watch(s: warpmpc.StepView, p: WatchParams) -> float:
    """Distance of the first disc from the second, and a little of everything else that a term may look at."""
    place = wp.transform_get_translation(warpmpc.frame_pose(s, p.frame))
    seen = wp.vec3(warpmpc.sensor(s, p.sensor), warpmpc.sensor(s, p.sensor + 1), warpmpc.sensor(s, p.sensor + 2))
    turned = wp.abs(warpmpc.frame_rotation(s, p.frame)[2]) + wp.abs(warpmpc.joint_position(s, p.joint))
    speed = wp.length(warpmpc.frame_velocity(s, p.frame)) + wp.abs(warpmpc.joint_velocity(s, 0))
    speed += wp.length(warpmpc.frame_angular_velocity(s, p.frame))
    jolt = wp.length(warpmpc.frame_acceleration(s, p.frame)) + wp.length(warpmpc.frame_angular_acceleration(s, p.frame))
    push = warpmpc.step_length(s) * wp.abs(warpmpc.control(s, 0))
    hit = wp.length(warpmpc.contact_force(s, 0))  # of the scene's contact_force
    away = wp.abs(warpmpc.centre_of_mass(s, p.robot)[1])
    cost = (
        wp.length(seen - place) + 0.01 * (turned + speed + jolt + hit + push + away) + 0.1 * warpmpc.memory(s, p.memory)
    )
    return wp.where(warpmpc.step_time(s) > p.rest, 2.0 * cost, cost)


@wp.struct
class MassParams:
    """Keys of the residual."""

    robot: int
    scalar: int  # a scalar of the task


@warpmpc.residual_term("mass_at_speed")  # the scene chooses the norm
def mass_at_speed(s: warpmpc.StepView, p: MassParams) -> wp.vec2:
    """Make the centre of mass move along x with a speed of the task."""
    velocity = warpmpc.centre_of_mass_velocity(s, p.robot)
    return wp.vec2(velocity[0] - warpmpc.task_scalar(s, p.scalar), velocity[1])


COST = (
    'cost = [{ term = "watch", frame = "discs/pusher", joint = "discs/pusher_x", sensor = "discs/cart_at", '
    'robot = "discs", rest = 2.0 }, { term = "contact_force", between = ["discs", "obstacles"], weight = 0.01 }, '
    '{ term = "mass_at_speed", robot = "discs", scalar = "speed", norm = { kind = "smooth_abs", p = 0.1 } }]'
)
WALL = 'obstacle = [{ name = "wall", shape = "box", size = [0.1, 4.0, 0.2], position = [1.5, 0.0, 0.0] }]'

if __name__ == "__main__":
    scene = warpmpc.load_scene("cylinder_push", overrides=[COST, WALL, "scalar.speed=0.2", "timing.timeout=2.0"])
    mpc = warpmpc.Controller(scene, terms=[watch, mass_at_speed])
    plant = warpmpc.Plant(scene, task=mpc.task, terms=[watch, mass_at_speed])
    while not plant.done:
        plant.apply(mpc.step(plant.observe()))
    print(mpc.info.terms, "fallback" if mpc.info.fallback else "")
