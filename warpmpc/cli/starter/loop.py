"""The control loop in Python: replace the plant, a simulated robot, by your own."""

import warpmpc

scene = warpmpc.load_scene("scene.toml")
terms = warpmpc.load_terms(["cost.py"])
mpc = warpmpc.Controller(scene, terms=terms)
plant = warpmpc.Plant(scene, seed=1, task=mpc.task, terms=terms)

while not plant.done:
    u = mpc.step(plant.observe())  # State in, control [nu] out
    plant.apply(u)

print(plant.reason, f"{plant.time:.2f} s")
