# SPDX-License-Identifier: Apache-2.0
"""The search space of a tuning: which scene keys may take which values, as written on the command line.

``cost.yaw.weight=0.5..6:log`` is a range of reals searched by order of magnitude, ``planner.knots=3..8`` one of whole
numbers (both ends are), ``planner.noise.sigma[0]=0.1..1`` one value of a list, ``planner.noise.sigma=x0.2..5`` a factor
on all values of a list, by order of magnitude, ``planner.spline=linear|cubic`` a choice of TOML values.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ...scene.errors import SceneError, entry_label, join_key
from ...scene.load import load_scene
from ...scene.overrides import Key, expand, parse_override, select, split_key
from ...scene.schema import Method, Scene

if TYPE_CHECKING:
    import optuna

FORM = "KEY=LOW..HIGH, KEY=LOW..HIGH:log, KEY=xLOW..HIGH or KEY=VALUE|VALUE|..."
BY_WEIGHTS = (Method.MPPI, Method.DIAL)
"""Methods that have a temperature."""
BY_ELITES = (Method.CEM, Method.ICEM, Method.TSALLIS)
"""Methods that have elites."""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


@dataclass(frozen=True)
class Range:
    """Numbers from low to high."""

    key: str
    low: float
    high: float
    log: bool
    whole: bool

    def suggest(self, trial: optuna.Trial) -> float:
        """The value of a trial."""
        if self.whole:
            return trial.suggest_int(self.key, self.low, self.high, log=self.log)
        # what is tried is what can be written down: six digits
        return float(f"{trial.suggest_float(self.key, self.low, self.high, log=self.log):.6g}")

    def bind(self, value: object) -> tuple[Range, float]:
        """The parameter and its first trial's value, from the scene's present value.

        Raises:
            ValueError: If it is not in the range.
        """
        if isinstance(value, list) and len(value) == 1:
            value = value[0]
        if isinstance(value, list):
            apart = f"tune its values apart, as {self.key}[0], or together by a factor, as {self.key}=x0.2..5"
            raise ValueError(f"--key {self.key}: is a list of {len(value)}: {apart}")
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not self.low <= value <= self.high or (self.whole and value != int(value)):
            raise ValueError(f"--key {self.key}: the scene's {value!r} lies outside {self}: let the range hold it")
        return self, int(value) if self.whole else float(value)

    def text(self, value: float) -> str:
        """A value in TOML."""
        return repr(value)

    @property
    def samples(self) -> tuple[str, ...]:
        """Values in TOML that tell whether the key exists."""
        return self.text(self.low), self.text(self.high)

    def __str__(self) -> str:
        return f"{self.low!r}..{self.high!r}{':log' * self.log}"


@dataclass(frozen=True)
class Factor:
    """A factor on every value of a list."""

    key: str
    low: float
    high: float
    base: tuple[float, ...] = ()
    """The scene's values, which a factor of one leaves as they are."""

    def suggest(self, trial: optuna.Trial) -> float:
        """The value of a trial."""
        return float(f"{trial.suggest_float(self.key, self.low, self.high, log=True):.6g}")

    def bind(self, value: object) -> tuple[Factor, float]:
        """The parameter and its first trial's value, from the scene's present value.

        Raises:
            ValueError: If that is not numbers.
        """
        values = value if isinstance(value, list) else [value]
        if not values or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            raise ValueError(f"--key {self.key}: the scene's {value!r} is no list of numbers")
        return replace(self, base=tuple(values)), 1.0

    def text(self, value: float) -> str:
        """A value in TOML."""
        values = [float(f"{value * v:.6g}") for v in self.base]
        return repr(values if len(values) > 1 else values[0])

    @property
    def samples(self) -> tuple[str, ...]:
        """Values in TOML that tell whether the key exists: none, as a value must be there."""
        return ()

    def __str__(self) -> str:
        return f"x{self.low!r}..{self.high!r}"


@dataclass(frozen=True)
class Choice:
    """One of several values, each as TOML."""

    key: str
    options: tuple[str, ...]

    def suggest(self, trial: optuna.Trial) -> str:
        """The value of a trial."""
        return trial.suggest_categorical(self.key, self.options)

    def bind(self, value: object) -> tuple[Choice, str]:
        """The parameter and its first trial's value, from the scene's present value.

        Raises:
            ValueError: If it is not among the options.
        """
        for option in self.options:
            meant = parse_override(f"{self.key}={option}")[1]
            if meant == value or [meant] == value or (meant is False and value is None):
                return self, option
        raise ValueError(f"--key {self.key}: the scene's {value!r} is not among {self}: add it")

    def text(self, value: str) -> str:
        """A value in TOML."""
        meant = parse_override(f"{self.key}={value}")[1]
        return json.dumps(meant) if isinstance(meant, str) else value

    @property
    def samples(self) -> tuple[str, ...]:
        """Values in TOML that tell whether the key exists."""
        return self.options

    def __str__(self) -> str:
        return "|".join(self.options)


Parameter = Range | Factor | Choice


def parse_parameter(text: str) -> Parameter:
    """Read one key with its range or options.

    Raises:
        ValueError: If it is neither.
    """
    name, equals, spec = (part.strip() for part in text.partition("="))
    if not equals or not name or not spec:
        raise ValueError(f"--key {text}: must have the form {FORM}")
    key = join_key(split_key(re.sub(r"\[(\d+)\]", r".\1", name), file=f"--key {text}"))
    if "|" in spec:
        options = tuple(option.strip() for option in spec.split("|"))
        for option in options:
            try:
                parse_override(f"{key}={option}")
            except SceneError:
                raise ValueError(f"--key {text}: the option {option!r} is not a TOML value") from None
        if len(set(options)) < len(options):
            raise ValueError(f"--key {text}: an option stands there twice")
        return Choice(key, options)
    match = re.fullmatch(rf"(x?)({_NUMBER})\s*\.\.\s*({_NUMBER})(:log)?", spec)
    if not match:
        raise ValueError(f"--key {text}: {spec!r} is no range and no choice: write {FORM}")
    factor, *ends, log = match.groups()
    whole = not factor and all(re.fullmatch(r"[-+]?\d+", end) for end in ends)
    low, high = (int(end) if whole else float(end) for end in ends)
    if low >= high:
        raise ValueError(f"--key {text}: the low end must be below the high one")
    if (log or factor) and low <= 0:
        raise ValueError(f"--key {text}: a range searched by order of magnitude must lie above zero")
    return Factor(key, low, high) if factor else Range(key, low, high, bool(log), whole)


def parse_space(items: Iterable[str]) -> list[Parameter]:
    """Read a search space.

    Args:
        items: Keys with their ranges, or files of such, one a line; what follows a # is left out.

    Raises:
        ValueError: If one cannot be read, or a key is named twice.
    """
    texts = []
    for item in items:
        if "=" in item:
            texts.append(item)
            continue
        if not Path(item).is_file():
            raise ValueError(f"--key {item}: no such file, and not {FORM}")
        lines = (line.partition("#")[0].strip() for line in Path(item).read_text(encoding="utf-8").splitlines())
        texts += [line for line in lines if line]
    space = [parse_parameter(text) for text in texts]
    keys = [parameter.key for parameter in space]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise ValueError(f"--key {twice[0]}: is named twice")
    return space


def derive_space(scene: Scene) -> list[str]:
    """A search space for a scene: weights, noise, horizon, knots, temperature, within factors of what it has.

    Returns:
        Keys with their ranges, as :func:`parse_space` reads them.
    """
    planner = scene.planner
    weights = {cost.label: cost.weight for cost in scene.cost if cost.weight > 0.0}
    texts = []
    if len(weights) > 1:  # one weight alone is the temperature's inverse
        texts += [_near(join_key(("cost", label, "weight")), weight, 5.0) for label, weight in weights.items()]
    texts += [f"planner.noise.sigma{'.range' * (not isinstance(planner.noise.sigma, tuple))}=x0.2..5"]
    if isinstance(planner.horizon, int) and not (isinstance(planner.dt, tuple) and len(planner.dt) > 1):
        texts.append(f"planner.horizon={max(2, planner.horizon // 2)}..{2 * planner.horizon}")
    if planner.knot_count:
        texts.append(f"planner.knots={max(2, planner.knot_count // 2)}..{2 * planner.knot_count}")
    if planner.discount < 1.0:
        rest = 1.0 - planner.discount
        texts.append(f"planner.discount={max(1.0 - 3.0 * rest, 0.1):.6g}..{1.0 - rest / 3.0:.6g}")
    if planner.method in BY_WEIGHTS:
        steered, t = "planner.temperature", planner.temperature
        if t.eta is not None:
            texts.append(f"{steered}.eta=x0.3..4")
        else:
            least = 0.0 if t.ess is None else 1.0
            key = f"{steered}.{'initial' if t.ess is None else 'ess'}"
            texts.append(_near(key, t.ess or t.initial, 5.0, least=least))
    elif planner.method in BY_ELITES:
        texts.append(f"planner.elites={max(1, planner.elites // 2)}..{2 * planner.elites}")
    return texts


def _near(key: str, value: float, factor: float, *, least: float = 0.0) -> str:
    """The range of a value between its part and its multiple."""
    return f"{key}={max(least, float(f'{value / factor:.6g}'))}..{float(f'{value * factor:.6g}')}:log"


def bind_space(
    space: Iterable[Parameter], scenes: dict[str, Scene], overrides: list[str]
) -> tuple[list[Parameter], dict[str, object]]:
    """The search space with the scenes' present values, and those values as the first trial, key by key.

    Raises:
        ValueError: If a key does not exist or is not set, or has several values.
    """
    bound, start = [], {}
    for parameter in space:
        found = {}
        for source, scene in scenes.items():
            _check_key(parameter, source, overrides)
            values = present(scene, parameter.key)
            if not values:
                raise ValueError(
                    f"--key {parameter.key}: is not set in {source}: check its spelling, or say where to start "
                    f"with --set {parameter.key}=VALUE"
                )
            found |= {f"{source} {key}": parameter.bind(value) for key, value in values.items()}
        if len(set(found.values())) > 1:
            each = ", ".join(f"{getattr(p, 'base', '') or value} ({where})" for where, (p, value) in found.items())
            raise ValueError(f"--key {parameter.key}: stands for several values: {each}; make them one with --set")
        own, start[parameter.key] = next(iter(found.values()))
        bound.append(own)
    return bound, start


def _check_key(parameter: Parameter, source: str, overrides: list[str]) -> None:
    """Try a parameter's values until one makes a scene.

    Raises:
        SceneError: If none does.
    """
    first = None
    for text in parameter.samples:
        try:
            load_scene(source, overrides=[*overrides, f"{parameter.key}={text}"])
            return
        except SceneError as error:
            first = first or error
    if first:
        raise first


def present(scene: Scene, key: str) -> dict[str, object]:
    """Full keys that a key as in ``--set`` stands for, with their values as plain data; those not set are left out.

    Raises:
        SceneError: If the key addresses an entry that does not exist.
    """
    data = scene.model_dump(mode="json")
    found = {}
    for full in expand(data, split_key(key)):
        try:
            found[join_key(full)] = _value(data, full)
        except (KeyError, IndexError, TypeError, ValueError):
            continue  # nothing there
    return found


def _value(data: object, key: Key) -> object:
    for depth, part in enumerate(key):
        if isinstance(data, list):
            if not all(isinstance(entry, dict) for entry in data):
                data = data[int(part)]
                continue
            if len(data) == 1 and entry_label(data[0], 0) == "0" and part != "0":
                data = data[0][part]  # the one entry of an array of tables needs no number
                continue
            data = data[select(data, part, key[:depth])[0]]
        else:
            data = data[part]
    return data
