# SPDX-License-Identifier: Apache-2.0
"""The quadruped whose base is estimated from an inertial measurement unit, encoders and efforts."""

import numpy as np

from warpmpc import load_scene
from warpmpc.scene.schema import EstimateBase, ImuSensor, JointSensor

FEET = ["dog/fr_foot", "dog/fl_foot", "dog/rr_foot", "dog/rl_foot"]


def dog(delay=0.0, **estimate):
    """The quadruped with sensors and an estimated base."""
    scene = load_scene("quadruped_walk", overrides=(f"plant.delay={delay}", "plant.substeps=8"))
    sensor = scene.plant.sensor.model_copy(
        update={"imu": {"dog": ImuSensor(delay=delay)}, "joints": {"dog": JointSensor(delay=delay)}}
    )
    return scene.model_copy(
        update={
            "plant": scene.plant.model_copy(update={"sensor": sensor}),
            "estimate_base": {"dog": EstimateBase(feet=FEET, **estimate)},
        }
    )


def trot(plant):
    """Controls of a trot forward from the start on."""
    control, phase, begin = plant.layout.control_start.copy(), 3.0 * np.pi * plant.time, min(1.0, plant.time)
    for leg, shift in enumerate((0.0, np.pi, np.pi, 0.0)):
        control[3 * leg + 1] += 0.25 * begin * np.cos(phase + shift)
        control[3 * leg + 2] -= 0.5 * begin * max(np.sin(phase + shift), 0.0)
    return control
