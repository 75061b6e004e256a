# SPDX-License-Identifier: Apache-2.0
"""No rollout reads or writes beyond the end of an array of known size."""

import subprocess
import sys

import pytest
from fused_models import CONTACTS, OPTION

ROLL = """
import sys
import mujoco, numpy as np, quick_kernels, warp as wp
from warpmpc.physics import source_parts  # an index out of bounds ends the process:
source_parts.CONTRACT += " -fsanitize=array-bounds -fsanitize-trap=array-bounds"
from shared.plain_rollout import PlainRollout
quick_kernels.compile_soonest()
mj = mujoco.MjModel.from_xml_string(sys.stdin.read())
q, _ = PlainRollout(mj, 16, 5)(np.tile(mj.qpos0, (16, 1)), np.zeros((16, mj.nv)), np.ones((5, 16, mj.nu)))
print(np.isfinite(q).all())
"""
BALL = """
<mujoco><worldbody><geom type="plane" size="1 1 1"/><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
MODELS = {"ball": BALL, "contacts": CONTACTS}


@pytest.mark.parametrize("name", MODELS)
def test_no_index_is_out_of_bounds(name):
    text = MODELS[name].replace("{option}", OPTION.format(integrator="implicitfast"))
    program = f"import sys\nsys.path[:] = {sys.path}\n{ROLL}"  # tools are on the path here alone
    done = subprocess.run([sys.executable, "-c", program], input=text, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, f"signal {-done.returncode}: {done.stderr}"
    assert done.stdout.endswith("True\n")
