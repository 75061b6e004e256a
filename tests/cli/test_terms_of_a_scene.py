# SPDX-License-Identifier: Apache-2.0
"""Cost terms of a file hold for the scene that the file was given for."""

import pytest
from small_scenes import DISC, make_scene

import warpmpc
from warpmpc.scene.registry import TERMS

DECORATED = """
import warp as wp
import warpmpc

@wp.struct
class Params:
    frame: int
    offset: float

@warpmpc.cost_term("{own}")
def mine(s: warpmpc.StepView, p: Params) -> float:
    return p.offset + {value}
"""
REGISTERED = (
    DECORATED
    + """
from warpmpc.scene.registry import TERMS
TERMS.register("mine", mine)
"""
)


@pytest.mark.parametrize(("text", "own"), [(DECORATED, "mine"), (REGISTERED, "mine"), (REGISTERED, "other")])
def test_two_scenes_in_one_process_have_each_its_own_term_of_a_name(tmp_path, text, own):
    controllers = []
    for value in ("1.0", "3.0"):
        file = tmp_path / f"terms_{value[0]}.py"
        file.write_text(text.format(own=own, value=value))
        terms = warpmpc.load_terms(file)
        assert [term.name for term in terms] == ["mine"]
        keys = {"term": "mine", "frame": "base/centre", "offset": 0.5}
        scene = make_scene(robot=[DISC], cost=[keys], planner={"samples": 4, "horizon": 3, "discount": 1.0})
        controllers.append(warpmpc.Controller(scene, device="cpu", terms=terms))
    for controller, value in zip(controllers, (4.5, 10.5), strict=True):
        controller.step(warpmpc.State.start(controller.layout))
        assert controller.info.terms["mine"] == pytest.approx(value)
    assert "mine" not in TERMS


def test_a_file_that_fails_leaves_nothing_registered(tmp_path):
    file = tmp_path / "terms.py"
    file.write_text(REGISTERED.format(own="mine", value="1.0") + "raise RuntimeError('no')\n")
    with pytest.raises(ValueError, match="RuntimeError: no"):
        warpmpc.load_terms(file)
    assert "mine" not in TERMS
