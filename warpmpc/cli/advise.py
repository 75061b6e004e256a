# SPDX-License-Identifier: Apache-2.0
"""``warpmpc run --advise``: a failed episode again on the same seed, with one change each, in processes beside."""

from __future__ import annotations

import logging
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..loop.run.result import Changes
from ..loop.run.workers import LocalWorkers, one_thread
from ..physics.runtime.thread_pool import thread_count
from ..scene.schema import Method, SampleCount
from ..scene.schema_planner import DIRECT
from .spread import run_seeds

if TYPE_CHECKING:
    from collections.abc import Iterator
    from concurrent.futures import Future

    from ..loop.run.result import EpisodeResult, Shortfall
    from ..planner.controller.controller import Controller
    from .setup import RunArguments, Setup

logger = logging.getLogger("warpmpc")

TRIALS = 3
"""Guesses of a verdict that are tried, and those that change a weight."""
LIMIT = 300.0
"""Time for all of them [s]."""
MORE = 1.1
"""Ratio from which something is better, or worse."""


def advised(arguments: RunArguments, setup: Setup, failed: EpisodeResult) -> tuple[EpisodeResult, bool]:
    """The result of a failed episode with what came of one change each, and whether that was interrupted.

    Args:
        arguments: What the episode was run with.
        setup: The same, made ready.
        failed: Its result.
    """
    guesses = [guess.changes for guess in failed.shortfall.tries]
    first = [c for n, c in enumerate(guesses) if n < TRIALS or any(key.startswith("cost.") for key in c)]
    episode = setup.episode(failed.seed)
    changes = {str(c): [f"{key}={value}" for key, value in c.items()] for c in (*first, *_others(episode.controller))}
    episode.controller.engine.close()
    fixed = list(arguments.overrides)
    if setup.scene.planner.samples is SampleCount.AUTO:  # not measured beside others
        fixed.append(f"planner.samples={failed.samples}")
    tried = {name: {"set": sets, "helped": None, "outcome": "had no end in time"} for name, sets in changes.items()}
    workers = LocalWorkers(min(thread_count(0), len(changes)) if failed.device == "cpu" else 1)
    logger.info("trying %d changes, %d at a time, for up to %g s", len(changes), workers.count, LIMIT)
    given = {"engine": failed.engine, "device": failed.device}
    futures: dict[Future, str] = {}
    interrupted = False
    with workers:
        try:
            for name, sets in changes.items():
                each = replace(arguments, overrides=(*one_thread(workers, fixed), *sets), **given)
                futures[workers.submit(run_seeds, each, [failed.seed], False)] = name
            for future in as_completed(futures, timeout=LIMIT):
                tried[futures[future]] |= _outcome(failed, future)
        except TimeoutError:
            pass
        except KeyboardInterrupt:
            interrupted = True
    return replace(failed, tried=tuple(tried.values())), interrupted


def _others(controller: Controller) -> Iterator[dict[str, str]]:
    """Changes that are worth a try whatever a verdict says."""
    from ..planner.tumbles import tumble

    changes, planner = Changes(controller), controller.scene.planner
    wild = tumble(controller.scene, controller.compiled, controller.engine.name)
    yield changes.sigma(wild.factor if wild else 0.3)
    yield changes.sigma(3.0)
    if further := changes.further():
        yield further
    yield changes.samples(2)
    if planner.method not in DIRECT:
        off = controller.plan_step.refiner is not None
        yield {"planner.refine": "false"} if off else {"planner.refine.method": "ilqg"}
        own = {"planner.refine.method": "ilqg"} if "refine" in planner.model_fields_set else {}
        yield {"planner.method": str(Method.ILQG), **own}


def _outcome(failed: EpisodeResult, future: Future) -> dict[str, Any]:
    """What came of a change."""
    try:
        ((result, _),) = future.result()
    except (ValueError, BrokenProcessPool) as error:  # such as a scene that lists its steps
        return {"helped": None, "outcome": f"cannot be tried, {' '.join(str(error).split())}"}
    helped, outcome = _compared(failed.shortfall, result)
    return {"helped": helped, "outcome": outcome} | ({"reached_s": result.sim_time} if result.success else {})


def _compared(before: Shortfall, result: EpisodeResult) -> tuple[bool, str]:
    """Whether an episode came farther than the one that failed, and how far."""
    if result.success:
        return True, f"the goal is reached at {result.sim_time:.2f} s"
    now = result.shortfall
    if now is None:
        return True, f"it does not fail within {result.sim_time:.2f} s"
    if now.phases != before.phases:
        return now.phases > before.phases, f"{now.phases} phases instead of {before.phases} end"
    if before.lasted is not None and now.lasted is not None:
        return now.lasted > MORE * before.lasted, f"it lasts {now.lasted:.2f} s instead of {before.lasted:.2f} s"
    if now.lasted is not None:
        return False, f"it falls or fails at {now.lasted:.2f} s"
    stands = f"it neither falls nor fails within {result.sim_time:.2f} s"
    left = {name: excess for name, (_, excess) in before.nearest.items() if excess > 0.0}
    if not left:
        return before.lasted is not None, stands if before.lasted is not None else "it does not hold, either"
    ratio = {name: max(now.nearest.get(name, (0.0, 0.0))[1], 0.0) / excess for name, excess in left.items()}
    name = max(ratio, key=ratio.get)
    value = f"{now.nearest[name][0]:.3g}" if name in now.nearest else "its bound"
    nearer = f"{name} comes to {value} instead of {before.nearest[name][0]:.3g}"
    if before.lasted is not None:
        return True, f"{stands}, and {nearer}"
    return bool(np.mean(list(ratio.values())) * MORE < 1.0), nearer
