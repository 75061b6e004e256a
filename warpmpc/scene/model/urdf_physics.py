# SPDX-License-Identifier: Apache-2.0
"""Masses, inertias and joint limits of a URDF file that no physics can be made of: repaired, or refused with a cure."""

from __future__ import annotations

import math
from graphlib import CycleError, TopologicalSorter
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_ROUNDING = 2e-5
"""Share of an inertia by which A + B ≥ C must hold, so that it still does in single precision and with the six digits
that MuJoCo writes; what misses it by less is not worth a word."""
_DENSITY = 1000.0
"""Density that the importer gives shapes of links without an ``<inertial>`` [kg/m³]."""
_LIGHT = (1e-6, 1e-9)
"""Mass [kg] and inertia [kg·m²] of a link without any between two joints: nothing beside what hangs on it."""
_AXES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_ROWS, _COLUMNS = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)


class Impossible(Exception):
    """A link or joint that cannot be repaired: which, why, and the cure."""


def repair_inertias(root: Element, *, floating: bool) -> list[str]:
    """Give every link the inertia of some distribution of mass, and every moving one a mass.

    Args:
        root: The ``<robot>``, changed in place.
        floating: Whether its root moves freely.

    Returns:
        What was repaired, one line each.

    Raises:
        Impossible: If mass or inertia are no numbers, or a joint moves nothing that has a mass.
    """
    for kind in ("link", "joint"):
        _require_names(root, kind)
    links = {link.get("name", ""): link for link in root.findall("link")}
    said = [line for link in links.values() if (line := _repair_inertia(link))]
    children: dict[str, list[tuple[str, bool]]] = {name: [] for name in links}
    below = set()
    for joint in root.findall("joint"):
        parent, child = (_end(joint, side, links) for side in ("parent", "child"))
        children[parent].append((child, joint.get("type") == "fixed"))
        below.add(child)
    _require_no_loop(children)
    for name in links:
        if name not in below:
            said += _repair_massless(name, links, children, moves=floating, moving=floating)
    return said


def _require_names(root: Element, kind: str) -> None:
    """Refuse links or joints without a name, or with one that another has."""
    seen = set()
    for element in root.findall(kind):
        name = element.get("name", "").strip()
        if not name:
            ends = (element.find(side) for side in ("parent", "child"))
            between = " and ".join(f"'{end.get('link')}'" for end in ends if end is not None)
            raise Impossible(f"a {kind} has no name" + (f": the one between {between}" if between else ""))
        if name in seen:
            raise Impossible(f"two {kind}s are called '{name}'")
        seen.add(name)


def _end(joint: Element, side: str, links: dict[str, Element]) -> str:
    """Name of a joint's parent or child link."""
    entry = joint.find(side)
    name = None if entry is None else entry.get("link")
    if name not in links:
        raise Impossible(f"joint '{joint.get('name')}': its {side} is no link of the file ('{name}')")
    return name


def _require_no_loop(children: dict[str, list[tuple[str, bool]]]) -> None:
    """Refuse links that hang on themselves.

    Raises:
        Impossible: If there are such.
    """
    try:
        TopologicalSorter({name: [child for child, _ in below] for name, below in children.items()}).prepare()
    except CycleError as error:
        loop = " → ".join(f"'{name}'" for name in error.args[1][::-1])
        raise Impossible(
            f"links {loop} form a loop of joints, but a URDF is a tree: take one of these joints out (an MJCF file may "
            "close a loop with <equality>)"
        ) from None


def _repair_massless(name: str, links: dict, children: dict, *, moves: bool, moving: bool) -> list[str]:
    """Mend a link and what hangs on it.

    Args:
        name: The link.
        links: All links by name.
        children: Links below each link, and whether they are fixed to it.
        moves: Whether a joint moves it against its parent.
        moving: Whether anything moves it in the world.
    """
    link, said = links[name], []
    if moving and link.find("inertial") is None and link.find("collision") is not None:
        said.append(f"link '{name}' has no <inertial>: its shapes weigh {_DENSITY:g} kg/m³")
    if moves and not _has_mass(name, links, children, rigid=True):
        if not _has_mass(name, links, children, rigid=False):
            raise Impossible(
                f"link '{name}' moves, but neither it nor what hangs on it has a mass: give it an <inertial>, or make "
                "its joint fixed"
            )
        _set_inertial(link, *_LIGHT)
        said.append(f"link '{name}' moves and has no mass: {_LIGHT[0]:g} kg are taken")
    for child, fixed in children[name]:
        said += _repair_massless(child, links, children, moves=not fixed, moving=moving or not fixed)
    return said


def _has_mass(name: str, links: dict, children: dict, *, rigid: bool) -> bool:
    """Return whether a link or what is fixed to it (``rigid``), or else anything that hangs on it, has a mass."""
    mass = _number(links[name], "mass", "value")
    if mass > 0.0 or (links[name].find("inertial") is None and links[name].find("collision") is not None):
        return True
    return any(_has_mass(c, links, children, rigid=rigid) for c, fixed in children[name] if fixed or not rigid)


def _number(link: Element, entry: str, attribute: str) -> float:
    """A number of a link's ``<inertial>``, 0 where it says nothing."""
    found = link.find(f"inertial/{entry}")
    text = "0" if found is None else found.get(attribute, "0")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise Impossible(
            f"link '{link.get('name')}': {attribute} of its <{entry}> must be a finite number, not '{text}'"
        )
    return value


def _set_inertial(link: Element, mass: float, inertia: float) -> None:
    """Give a link a mass [kg] and the same inertia [kg·m²] about all axes."""
    for old in link.findall("inertial"):
        link.remove(old)
    inertial = link.makeelement("inertial", {})
    inertial.append(link.makeelement("mass", {"value": repr(mass)}))
    inertial.append(link.makeelement("inertia", {axes: repr(inertia * (axes in _AXES[:3])) for axes in _AXES}))
    link.append(inertial)


def _repair_inertia(link: Element) -> str | None:
    """Make a link's inertia that of some distribution of mass; returns what is to be said."""
    name, mass = link.get("name"), _number(link, "mass", "value")
    if mass < 0.0:
        raise Impossible(f"link '{name}': its mass must not be negative; found {mass:g} kg")
    numbers = np.array([_number(link, "inertia", axes) for axes in _AXES])
    if mass > 0.0 and not numbers.any():
        inertia = 0.4 * mass * (3.0 * mass / (4.0 * math.pi * _DENSITY)) ** (2.0 / 3.0)
        entry = link.find("inertial/inertia")
        if entry is None:
            entry = link.makeelement("inertia", {})
            link.find("inertial").append(entry)
        for axes in _AXES[:3]:
            entry.set(axes, repr(inertia))
        return f"link '{name}' has a mass and no inertia: a ball's of {_DENSITY:g} kg/m³ is taken, {inertia:.3g} kg·m²"
    given = np.zeros((3, 3))
    given[_ROWS, _COLUMNS] = given[_COLUMNS, _ROWS] = numbers
    nearest = nearest_inertia(given)
    if nearest is given:
        return None
    for axes, number in zip(_AXES, nearest[_ROWS, _COLUMNS], strict=True):
        link.find("inertial/inertia").set(axes, repr(float(number)))
    if np.abs(nearest - given).max() <= 3.0 * _ROUNDING * np.abs(given).max():
        return None
    before, after = (", ".join(f"{x:.4g}" for x in np.linalg.eigvalsh(i)) for i in (given, nearest))
    return f"link '{name}': no body has the principal inertias {before} kg·m² (A + B ≥ C); {after} are taken"


def nearest_inertia(inertia: np.ndarray) -> np.ndarray:
    """The nearest inertia ``[3, 3]`` that some distribution of mass has, with room for rounding.

    Second moments of mass, ½ tr(I) 1 - I, are never negative (Wensing, Kim and Slotine, RA-L 2018); those that are
    become zero. With A + B < C this raises A and B by half of what is missing and keeps C.

    Returns:
        The same array where nothing is to be changed.
    """
    moments, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    least = _ROUNDING * np.abs(moments).max()
    if moments.min() >= least:
        return inertia
    moments = np.maximum(moments, least)
    return np.sum(moments) * np.eye(3) - (axes * moments) @ axes.T


def repair_joints(root: Element) -> list[str]:
    """Take limits of joints for what they mean.

    Continuous joints have no range, whatever their ``<limit>`` says. A range from 0 to 0 or none at all, a speed or an
    effort of 0 stand for nothing known.

    Returns:
        What was repaired, one line each.

    Raises:
        Impossible: If a joint's range ends before it begins, or it mimics what has no axis.
    """
    said = []
    kinds = {joint.get("name"): joint.get("type") for joint in root.findall("joint")}
    for joint in root.findall("joint"):
        limit, kind, name = joint.find("limit"), joint.get("type"), joint.get("name")
        mimic = joint.find("mimic")
        if mimic is not None and kind == "fixed":
            joint.remove(mimic)
            said.append(f"joint '{name}' is fixed: what it mimics is left out")
        elif mimic is not None:
            _require_mimic(mimic, kinds, name)
        if limit is None or kind not in ("revolute", "prismatic", "continuous"):
            continue
        given = [key for key in ("lower", "upper", "effort", "velocity") if limit.get(key) is not None]
        known = {key: _limit(limit, key, name) for key in given}
        lower, upper = known.get("lower", 0.0), known.get("upper", 0.0)
        unbounded = kind == "continuous"
        if not unbounded and lower == upper == 0.0:
            said.append(f"joint '{name}' has no range (lower = upper = 0): it is taken as without limits")
            unbounded = True
        elif not unbounded and lower >= upper:
            raise Impossible(f"joint '{name}': lower must be below upper in its <limit>; found {lower:g} and {upper:g}")
        for key in ("effort", "velocity"):
            if known.get(key, 0.0) < 0.0:
                raise Impossible(f"joint '{name}': {key} of its <limit> is below zero ({known[key]:g})")
        nothing = [key for key in ("effort", "velocity") if known.get(key, 1.0) == 0.0]
        if nothing:
            said.append(f"joint '{name}': a limit of 0 for {' and '.join(nothing)} is taken as none")
        for key in [*nothing, *(("lower", "upper") if unbounded else ())]:
            limit.attrib.pop(key, None)
    return said


def _require_mimic(mimic: Element, kinds: dict[str | None, str | None], joint: str | None) -> None:
    leader = mimic.get("joint")
    if leader not in kinds:
        raise Impossible(f"joint '{joint}': it mimics '{leader}', which is no joint of the file")
    for name in (joint, leader):
        if kinds[name] not in ("revolute", "prismatic", "continuous"):
            raise Impossible(
                f"joint '{joint}': it mimics '{leader}', but '{name}' is {kinds[name]} and has no one axis"
            )
    for key in ("offset", "multiplier"):
        if mimic.get(key) is not None and math.isinf(_limit(mimic, key, joint)):
            raise Impossible(f"joint '{joint}': {key} of its <mimic> is infinite")


def _limit(element: Element, key: str, joint: str | None) -> float:
    try:
        value = float(element.get(key))
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise Impossible(f"joint '{joint}': {key} of its <{element.tag}> is no number ('{element.get(key)}')")
    return value
