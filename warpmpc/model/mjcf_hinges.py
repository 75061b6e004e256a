# SPDX-License-Identifier: Apache-2.0
"""Hinges of one MJCF body that turn about different points: bodies of their own for all but the last."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree

import mujoco

SPECK = {"pos": "0 0 0", "mass": "1e-6", "diaginertia": "2e-15 2e-15 2e-15"}
"""A mass [kg] and inertia [kg m²] that no joint notices, small enough in size for a medium not to, either."""


def split_hinges(spec: mujoco.MjSpec) -> tuple[mujoco.MjSpec, list[str]]:
    """Return a file whose hinges of one body turn about one point, and a line about each body that was divided.

    MuJoCo has bodies whose hinges do not, Newton's joints do; ankles of dm-control's humanoid are some. The joints'
    order, and so the state, stays the same, and so does what collides.
    """
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    points = {body.name: {tuple(joint.pos) for joint in body.joints if joint.type == hinge} for body in spec.bodies}
    divided = [name for name, found in points.items() if len(found) > 1]
    if not divided:
        return spec, []
    folder = Path(spec.modelfiledir)
    for where in ("meshdir", "texturedir"):
        setattr(spec, where, str(folder / getattr(spec, where)))  # files are found from anywhere
    root = ElementTree.fromstring(spec.to_xml())
    one_point_each(root, divided)
    lines = [f"body '{name}': hinges about different points have bodies of their own" for name in divided]
    return mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode")), lines


def one_point_each(root: ElementTree.Element, names: Collection[str]) -> None:
    """Give joints of named bodies, but for the last of each, bodies of their own, of next to no mass."""
    contact = ElementTree.SubElement(root, "contact")
    parents = {child: parent for parent in root.iter("body") for child in parent.findall("body")}
    for body, parent in parents.items():
        if body.get("name") not in names:
            continue
        joints = body.findall("joint")
        ElementTree.SubElement(contact, "exclude", body1=parent.get("name"), body2=body.get("name"))
        for joint in joints[:-1]:
            place = {key: body.attrib.pop(key) for key in ("pos", "quat") if key in body.attrib}
            family = {"childclass": body.get("childclass")} if "childclass" in body.attrib else {}
            own = ElementTree.Element("body", name=f"{body.get('name')}_{joint.get('name')}", **place, **family)
            own.append(ElementTree.Element("inertial", SPECK))
            body.remove(joint)
            own.append(joint)
            at = list(parent).index(body)
            parent.remove(body)
            own.append(body)
            parent.insert(at, own)
            parent = own
