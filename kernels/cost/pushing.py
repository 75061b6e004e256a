# SPDX-License-Identifier: Apache-2.0
"""Parts of the work that is left to push an object to its goal."""

import warp as wp

from .view import wrap_angle

wp.set_module_options({"enable_backward": False})

EPSILON = wp.constant(1.0e-6)

WHOLE_TURN = wp.constant(0.3)  # [rad] a heading error from which on the place to turn an object from counts in full
WHOLE_SIDE = wp.constant(0.52)  # [rad] an object turned by less than this from straight is pushed at its side's middle
BESIDE_CORNER = wp.constant(0.12)  # [rad] from an object's corner: a push there turns it towards the side pushed at
SWIVEL_PLAY = wp.constant(3.0)  # [1/rad] how much wider the tolerance is of an object that must still be turned
SWIVEL_RANGE = wp.constant(0.2)  # [m] from the goal's tolerance, within which an object is turned rather than moved
COAST_RANGE = wp.constant(0.2)  # [m] an object that coasts past its goal at this distance misses it
SWIVEL_PRICE = wp.constant(0.4)  # of a way around the object; more would keep turned objects away from the goal


@wp.func
def shrink(d: float, tolerance: float) -> float:
    """Zero within ± tolerance, d itself beyond 2.5 times that, and continuous."""
    a = wp.abs(d)
    if a < 2.5 * tolerance:
        a = wp.max(a - tolerance, 0.0) * 2.5 / 1.5
    return wp.sign(d) * a


@wp.func
def side_place(error: float, steer: float, largest: float) -> float:
    """Place to push an object turned by ``error`` so that it goes straight and turns back, from straight behind [rad].

    Within ``WHOLE_SIDE`` that is beside the middle of its side, by 1 + ``steer`` times the error, at most
    ``largest``. Turned by 45° it is on the same side, just beside the corner that then faces straight; on the other
    side of that corner a push would turn the object on. Only beyond 60° the next side takes over, and without a
    jump: pushers wait where the cost jumps. The corners are those of a square: of a longer object's narrow sides
    they are nearer, so for these it is a rule of thumb. At 180° both ways back are equally long, and there it does
    jump.
    """
    a = wp.abs(error)
    turned = a - wp.half_pi * wp.floor((a + wp.pi / 12.0) / wp.half_pi)  # from the side in use, -15° to 75°
    aim = wp.min((1.0 + steer) * a, largest)
    corner = wp.pi / 4.0
    last = wp.pi / 3.0
    place = turned - aim
    if turned > last:
        place = wp.lerp(last - corner + BESIDE_CORNER, -wp.pi / 12.0 - aim, (turned - last) / (wp.pi / 12.0))
    elif turned > corner:
        place = turned - corner + BESIDE_CORNER
    elif turned > WHOLE_SIDE:
        place = wp.lerp(WHOLE_SIDE - aim, BESIDE_CORNER, (turned - WHOLE_SIDE) / (corner - WHOLE_SIDE))
    return wp.sign(error) * place


@wp.func
def swivel(angle: float, error: float, aside: float, arm: float) -> float:
    """Distance of the pusher from where it would turn an object back by its heading error [rad].

    That is ``arm`` beside the middle of a broad side, ``angle`` away from the first one; small errors count less.
    There are two such places. ``aside`` says how far the object lies towards the first, in tolerances: the farther
    it lies to one side, up to half a tolerance, the more that side counts alone. A push from there brings it back
    rather than away.
    """
    off = angle + wp.sign(error) * arm
    nearest = wp.abs(off - wp.pi * wp.round(off / wp.pi))
    outer = wp.abs(wrap_angle(off + wp.where(aside < 0.0, wp.pi, 0.0)))
    share = wp.min(2.0 * wp.abs(aside), 1.0)
    return wp.lerp(nearest, outer, share) * wp.min(wp.abs(error) / WHOLE_TURN, 1.0)


@wp.func
def coasting_time(off: wp.vec2, velocity: wp.vec2, lead: float, tolerance: float) -> float:
    """Time that an object ``off`` its goal coasts: ``lead``, or until it is nearest to a goal it does not miss.

    All of ``lead`` counts when it passes the tolerance at ``COAST_RANGE`` or more, and less the nearer it passes. If it
    always did, an object would have to come slowly enough not to coast past the goal in that time.
    """
    nearest = wp.clamp(-wp.dot(off, velocity) / wp.max(wp.dot(velocity, velocity), EPSILON), 0.0, lead)
    miss = off + nearest * velocity
    outside = wp.vec2(wp.max(wp.abs(miss[0]) - tolerance, 0.0), wp.max(wp.abs(miss[1]) - tolerance, 0.0))
    return wp.lerp(nearest, lead, wp.min(wp.length(outside) / COAST_RANGE, 1.0))
