# SPDX-License-Identifier: Apache-2.0
"""Clone a planner: a network learns the controls of the horizon from a data set of ``warpmpc run --export``.

python imitate.py SCENE demos.hdf5 policy.onnx

It needs h5py and onnx: pip install "warpmpc[export,onnx]" onnx; with them the planner runs the policy, too.
"""

import itertools
import sys

import numpy as np

try:
    import h5py
    import onnx
    import onnx.parser
except ModuleNotFoundError as error:
    raise SystemExit(f'error: imitate.py needs {error.name}: pip install "warpmpc[export,onnx]" onnx') from None

import warpmpc
from warpmpc.engine.protocol import TimeGrid

OBSERVED = ("joint_q", "joint_qd", "goal")
scene = warpmpc.load_scene(sys.argv[1])
ahead = np.rint(TimeGrid.of(scene).t[:-1] / scene.timing.control_dt).astype(int)  # [T] controls until each step
observed, wanted = [], []
with h5py.File(sys.argv[2]) as file:
    for demo in file["data"].values():
        actions = demo["actions"][:]
        steps = np.minimum(np.arange(len(actions))[:, None] + ahead, len(actions) - 1)
        observed.append(np.hstack([demo["obs"][name][:] for name in OBSERVED]))
        wanted.append(actions[steps].reshape(len(actions), -1))
y = np.vstack(wanted)  # [N, T nu]
relative = np.eye(len(observed[0][0]))[:, :-7]  # [n, n - 7] from what is observed to what is learned from:
relative[-7:-4, :3] = -np.eye(3)  # the place of the body counts from the goal
x = np.vstack(observed) @ relative
(x_mean, x_std), (y_mean, y_std) = ((a.mean(0), a.std(0) + 1e-3) for a in (x, y))
x, y = ((x - x_mean) / x_std).astype(np.float32), ((y - y_mean) / y_std).astype(np.float32)

# two hidden layers, Adam (Kingma and Ba 2015), a rate that falls to zero
rng, sizes, total = np.random.default_rng(0), (x.shape[1], 64, 64, y.shape[1]), 4000
weights = [rng.normal(0.0, n**-0.5, (n, m)).astype(np.float32) for n, m in itertools.pairwise(sizes)]
weights += [np.zeros(n, np.float32) for n in sizes[1:]]
first, second = ([np.zeros_like(w) for w in weights] for _ in range(2))
for step in range(1, total + 1):
    batch = rng.integers(len(x), size=128)
    h1 = np.tanh(x[batch] @ weights[0] + weights[3])
    h2 = np.tanh(h1 @ weights[1] + weights[4])
    error = h2 @ weights[2] + weights[5] - y[batch]
    d2 = error @ weights[2].T * (1.0 - h2**2)
    d1 = d2 @ weights[1].T * (1.0 - h1**2)
    gradients = [x[batch].T @ d1, h1.T @ d2, h2.T @ error, d1.sum(0), d2.sum(0), error.sum(0)]
    for w, m, v, g in zip(weights, first, second, gradients, strict=True):
        m += 0.1 * (g / len(batch) - m)
        v += 0.001 * ((g / len(batch)) ** 2 - v)
        w -= 2e-3 * (1.0 - step / total) * m / (1.0 - 0.9**step) / (np.sqrt(v / (1.0 - 0.999**step)) + 1e-8)
print(f"{len(x)} steps of {len(wanted)} episodes; {np.mean(error**2):.3f} of the variance is left")

# the file's network reads and returns numbers as they are
weights[3], weights[0] = weights[3] - x_mean / x_std @ weights[0], relative / x_std @ weights[0]
weights[2], weights[5] = weights[2] * y_std, weights[5] * y_std + y_mean
layers = "a = Gemm(x, w0, w3) b = Tanh(a) c = Gemm(b, w1, w4) d = Tanh(c) e = Gemm(d, w2, w5) u = Reshape(e, shape)"
ends = f"(float[1, {len(relative)}] x) => (float[1, {len(ahead)}, {actions.shape[1]}] u)"
model = onnx.parser.parse_model(f'<ir_version: 9, opset_import: ["": 17]> policy {ends} {{ {layers} }}')
arrays = {f"w{i}": w.astype(np.float32) for i, w in enumerate(weights)} | {"shape": np.array([1, len(ahead), -1])}
model.graph.initializer.extend(onnx.numpy_helper.from_array(array, name) for name, array in arrays.items())
onnx.save(model, sys.argv[3])
