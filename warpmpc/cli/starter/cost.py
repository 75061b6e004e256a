"""Your own cost term: one function of one step of one rollout, compiled into the planner's kernel."""

import warp as wp

import warpmpc


@wp.struct
class AboveParams:
    """Keys of the term in a scene file."""

    frame: int  # a text in the scene file is looked up as a frame
    least: float  # [m]


@warpmpc.cost_term("above")
def above(s: warpmpc.StepView, p: AboveParams) -> float:
    """Distance of a frame below a height [m]."""
    return wp.max(0.0, p.least - warpmpc.frame_position(s, p.frame)[2])
