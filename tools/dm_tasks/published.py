# SPDX-License-Identifier: Apache-2.0
"""What learned agents reach: returns of 1000 steps, by task."""

TD_MPC2 = {
    "acrobot_swingup": 663,
    "ball_in_cup_catch": 984,
    "cartpole_swingup": 877,
    "cheetah_run": 896,
    "finger_spin": 991,
    "finger_turn_hard": 977,
    "fish_swim": 761,
    "hopper_stand": 955,
    "hopper_hop": 449,
    "humanoid_stand": 906,
    "humanoid_walk": 900,
    "humanoid_run": 603,
    "pendulum_swingup": 838,
    "quadruped_run": 954,
    "reacher_hard": 982,
    "walker_run": 877,
}
"""TD-MPC2 (Hansen et al., ICLR 2024): last points of its published curves, mean of 3 seeds after 4 million steps of
training, 14 million for the humanoid."""
