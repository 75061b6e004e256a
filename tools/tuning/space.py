# SPDX-License-Identifier: Apache-2.0
"""The search space of a tuning: which scene keys may take which values, as written on the command line.

``cost.yaw.weight=0.5..6:log`` is a range of reals searched by order of magnitude, ``planner.knots=3..8`` one of whole
numbers (both ends are), ``planner.noise.sigma[0]=0.1..1`` one value of a list, ``planner.spline=linear|cubic`` a choice
of TOML values.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from scene_keys import present

from warpmpc import SceneError, load_scene
from warpmpc.scene.errors import join_key
from warpmpc.scene.overrides import parse_override, split_key

if TYPE_CHECKING:
    import optuna

    from warpmpc import Scene

FORM = "KEY=LOW..HIGH, KEY=LOW..HIGH:log or KEY=VALUE|VALUE|..."
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

    def start(self, value: object) -> float:
        """A present value of the scene as the first trial's.

        Raises:
            ValueError: If it is not in the range.
        """
        if isinstance(value, list) and len(value) == 1:
            value = value[0]
        if isinstance(value, list):
            raise ValueError(f"--key {self.key}: is a list of {len(value)}: tune its values apart, as {self.key}[0]")
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not self.low <= value <= self.high or (self.whole and value != int(value)):
            raise ValueError(f"--key {self.key}: the scene's {value!r} lies outside {self}: let the range hold it")
        return int(value) if self.whole else float(value)

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
class Choice:
    """One of several values, each as TOML."""

    key: str
    options: tuple[str, ...]

    def suggest(self, trial: optuna.Trial) -> str:
        """The value of a trial."""
        return trial.suggest_categorical(self.key, self.options)

    def start(self, value: object) -> str:
        """A present value of the scene as the first trial's.

        Raises:
            ValueError: If it is not among the options.
        """
        for option in self.options:
            meant = parse_override(f"{self.key}={option}")[1]
            if meant == value or [meant] == value or (meant is False and value is None):
                return option
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


def parse_parameter(text: str) -> Range | Choice:
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
    match = re.fullmatch(rf"({_NUMBER})\s*\.\.\s*({_NUMBER})(:log)?", spec)
    if not match:
        raise ValueError(f"--key {text}: {spec!r} is no range and no choice: write {FORM}")
    *ends, log = match.groups()
    whole = all(re.fullmatch(r"[-+]?\d+", end) for end in ends)
    low, high = (int(end) if whole else float(end) for end in ends)
    if low >= high:
        raise ValueError(f"--key {text}: the low end must be below the high one")
    if log and low <= 0:
        raise ValueError(f"--key {text}: a range searched by order of magnitude must lie above zero")
    return Range(key, low, high, bool(log), whole)


def parse_space(items: Iterable[str]) -> list[Range | Choice]:
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


def start_values(space: Iterable[Range | Choice], scenes: dict[str, Scene], overrides: list[str]) -> dict[str, object]:
    """The scenes' present values, key by key.

    Args:
        space: The search space.
        scenes: Source, as for ``load_scene`` → scene with its overrides.
        overrides: Those overrides.

    Raises:
        ValueError: If a key does not exist or is not set, or has several values.
    """
    start = {}
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
            found |= {f"{source} {key}": parameter.start(value) for key, value in values.items()}
        if len(set(found.values())) > 1:
            each = ", ".join(f"{value} ({where})" for where, value in found.items())
            raise ValueError(f"--key {parameter.key}: stands for several values: {each}; make them one with --set")
        start[parameter.key] = next(iter(found.values()))
    return start


def _check_key(parameter: Range | Choice, source: str, overrides: list[str]) -> None:
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
    raise first
