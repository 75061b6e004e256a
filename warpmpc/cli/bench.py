# SPDX-License-Identifier: Apache-2.0
"""``warpmpc bench``: wall times of plans of one scene, paired between settings."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TextIO

from ..scene.origin import hardware
from .interrupts import Interrupts
from .progress import Bar, Messages
from .setup import SUCCESS, RunArguments, Setup, results_only, user_errors
from .terminal import say_json, screen

if TYPE_CHECKING:
    import numpy as np

    from ..loop.run.episode import Episode

WARM_UP = 10
"""Plans of every setting that do not count: kernels are compiled, memory is touched, caches fill."""
BUSY = 0.3
"""Load for each core from which the machine counts as busy before the first plan."""


@dataclass
class Setting:
    """One way to plan for the scene, and its times."""

    name: str
    engine: str
    overrides: tuple[str, ...]
    episode: Episode = field(init=False)
    plan_ms: list[float] = field(default_factory=list)
    """Wall time of each plan, from observation to command [ms]."""

    def to_json(self, first: Setting) -> dict[str, object]:
        """Times as plain data; ``ratio`` is this setting's time by the first one's, plan by plan."""
        import numpy as np

        controller = self.episode.controller
        times = np.array(self.plan_ms)
        p50, p90, p99, longest = np.percentile(times, [50, 90, 99, 100]).tolist()
        data = {
            "setting": self.name,
            "engine": controller.engine.name,
            "device": controller.device,
            "samples": controller.shape.samples,
            "horizon": controller.shape.horizon,
            "plan_ms": {"p50": p50, "p90": p90, "p99": p99, "max": longest},
        }
        if self is not first:
            middle, low, high = median_interval(times / np.array(first.plan_ms))
            data["ratio"] = {"p50": middle, "low": low, "high": high}
        return data


def median_interval(values: np.ndarray) -> tuple[float, float, float]:
    """The median of values ``[n]`` and its 95 % interval, by order statistics."""
    import numpy as np
    from scipy.stats import binom

    ordered = np.sort(values)
    lower = max(int(binom.ppf(0.025, len(values), 0.5)) - 1, 0)
    return float(np.median(ordered)), float(ordered[lower]), float(ordered[len(values) - 1 - lower])


def bench(
    arguments: RunArguments,
    *,
    engines: Sequence[str],
    samples: Sequence[int],
    against: Sequence[str],
    plans: int,
    seed: int,
    json_lines: bool,
) -> int:
    """Time plans of every setting at the states of one closed loop, print them, and return the exit code.

    The first setting's plans are carried out. At every observation each setting makes one plan, in an order that
    rotates, so that drifts of the machine meet all settings alike.
    """
    notices = not json_lines
    with results_only() as out, Messages(notices=notices, warnings=notices), Interrupts() as interrupts:
        code = SUCCESS
        settings: list[Setting] = []
        try:
            with user_errors():
                for setting in _settings(engines, samples, against, arguments.overrides):
                    own = replace(arguments, overrides=setting.overrides, engine=setting.engine)
                    setting.episode = Setup(own).episode(seed)
                    settings.append(setting)
                    _check_states(settings[0], setting)
            before = os.getloadavg()[0]
            with Bar(plans, shown=notices) as bar:
                _measure(settings, plans, bar)
        except KeyboardInterrupt:
            code = interrupts.code
        finally:
            for setting in settings:
                setting.episode.controller.engine.close()
        if code == SUCCESS or (settings and settings[-1].plan_ms):
            machine = {**hardware(), "load": [round(before, 2), round(os.getloadavg()[0], 2)]}
            count = min(len(setting.plan_ms) for setting in settings)
            for setting in settings:
                del setting.plan_ms[count:]
            rows = [setting.to_json(settings[0]) for setting in settings]
            report = {"scene": arguments.source, "seed": seed, "plans": count, "machine": machine, "settings": rows}
            if json_lines:
                say_json(report, out)
            else:
                _print(report, settings[0].episode.scene.timing.control_dt, out)
    return code


def _settings(
    engines: Sequence[str], samples: Sequence[int], against: Sequence[str], overrides: Sequence[str]
) -> Iterator[Setting]:
    """Every engine with every number of samples, then what they are held against, on the first engine."""
    for engine in engines:
        for count in samples or (None,):
            change = () if count is None else (f"planner.samples={count}",)
            name = " ".join(([engine] if len(engines) > 1 or not change else []) + list(change))
            yield Setting(name, engine, (*overrides, *change))
    for text in against:
        yield Setting(text, engines[0], (*overrides, *shlex.split(text)))


def _check_states(first: Setting, other: Setting) -> None:
    """Refuse a setting that cannot plan from the first one's observations.

    Raises:
        ValueError: If its robots, objects or drives are others.
    """
    sizes = [(layout.nq, layout.nv, layout.nu) for layout in (s.episode.plant.layout for s in (first, other))]
    if sizes[0] != sizes[1]:
        raise ValueError(
            f"--against '{other.name}': has other robots, objects or drives than the scene: their plans cannot be "
            "compared state by state; change keys of planner, engine and cost"
        )


def _measure(settings: list[Setting], plans: int, bar: Bar) -> None:
    """Time plans of all settings in turn; a new episode of the same seed begins where one ends."""
    first = settings[0].episode
    kept = first.plant.observe()
    for i in range(-WARM_UP, plans):
        if first.plant.done:
            first.plant.reset()
            for setting in settings:
                setting.episode.controller.reset()
            kept = first.plant.observe()
        control = None
        for k in range(len(settings)):
            setting = settings[(i + k) % len(settings)]
            start = time.perf_counter()
            command = setting.episode.controller.step(kept)
            took = 1e3 * (time.perf_counter() - start)
            control = command if setting is settings[0] else control
            if i >= 0:
                setting.plan_ms.append(took)
        first.plant.apply(control)
        kept = first.plant.observe()
        if bar.due():
            bar.draw(f"{max(i + 1, 0)}/{plans} plans", max(i + 1, 0), "" if i >= 0 else "warming up")


def _print(report: dict, control_dt: float, out: TextIO) -> None:
    """The times as a table, and the machine."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("setting")
    for head in ("engine", "samples × steps", "p50 ms", "p90", "p99", "of a control", "by the first (95 %)"):
        table.add_column(head, justify="right")
    for row in report["settings"]:
        ms, ratio = row["plan_ms"], row.get("ratio")
        table.add_row(
            row["setting"],
            f"{row['engine']} {row['device']}",
            f"{row['samples']} × {row['horizon']}",
            *(f"{ms[p]:.2f}" for p in ("p50", "p90", "p99")),
            f"{0.1 * ms['p50'] / control_dt:.0f} %",
            f"{ratio['p50']:.3f} ({ratio['low']:.3f} to {ratio['high']:.3f})" if ratio else "",
        )
    console = screen(out, width=None if out.isatty() else 140)
    console.print(table)
    machine, load = report["machine"], report["machine"]["load"]
    gpus = f", {', '.join(machine['gpus'])}" if machine["gpus"] else ""
    busy = ": busy before the first plan, times are too long" if load[0] > BUSY * machine["cores"] else ""
    console.print(
        f"{report['plans']} plans each after {WARM_UP}; {machine['cores']} cores of {machine['cpu']}{gpus}; "
        f"load {load[0]:.1f} before, {load[1]:.1f} after{busy}"
    )
