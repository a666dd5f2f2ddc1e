"""A URDF read, and refused in one line before anything is built of it: links, joints, and every number."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from franka_wm.errors import UserError
from franka_wm.options import Bounds
from franka_wm.untrusted import xml_tree

MOST_BYTES = 32 * 2**20
"""Largest URDF that is read; meshes are files of their own."""
JOINTS = ("revolute", "continuous", "prismatic", "fixed")
"""Kinds of joints that an arm may have."""


class Numbers(NamedTuple):
    """What an attribute holds: how many numbers, and within which bounds."""

    count: int = 1
    bounds: Bounds = Bounds(least=-1e9, most=1e9)


ANY, NO_LESS, ABOVE = Numbers(), Numbers(1, Bounds(least=0, most=1e9)), Numbers(1, Bounds(above=0, most=1e9))
ATTRIBUTES: Mapping[str, Mapping[str, Numbers]] = {
    "origin": {"xyz": Numbers(3), "rpy": Numbers(3)},
    "axis": {"xyz": Numbers(3)},
    "limit": {"lower": ANY, "upper": ANY, "effort": NO_LESS, "velocity": NO_LESS},
    "dynamics": {"damping": NO_LESS, "friction": NO_LESS},
    "mimic": {"multiplier": ANY, "offset": ANY},
    "mass": {"value": NO_LESS},
    "inertia": {"ixx": NO_LESS, "iyy": NO_LESS, "izz": NO_LESS, "ixy": ANY, "ixz": ANY, "iyz": ANY},
    "box": {"size": Numbers(3, Bounds(above=0, most=1e6))},
    "cylinder": {"radius": ABOVE, "length": ABOVE},
    "capsule": {"radius": ABOVE, "height": ABOVE},
    "sphere": {"radius": ABOVE},
    "mesh": {"scale": Numbers(3)},
    "color": {"rgba": Numbers(4, Bounds(least=0, most=1))},
}
"""Element → attribute → its numbers; the units are URDF's."""
NEEDED: Mapping[str, tuple[str, ...]] = {"mass": ("value",), "inertia": ("ixx", "iyy", "izz")}
"""Attributes without which an element means nothing."""


def read_description(path: Path) -> ET.Element:
    """The tree of a URDF whose links and joints are one arm's, and whose numbers can be.

    Raises:
        UserError: One line that says what is wrong with the file.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise UserError(f"{path}: larger than {MOST_BYTES / 2**20:g} MiB, the most that a URDF may have")
    except OSError as error:
        raise UserError(f"{path}: not a readable URDF ({error})") from error
    try:
        root = xml_tree(content)
        check_description(root)
    except UserError as error:
        raise UserError(f"{path.name}: {error}") from error
    return root


def check_description(root: ET.Element) -> None:
    """Refuses links and joints that are no tree, and numbers that cannot be.

    Raises:
        UserError: One line that says what is wrong.
    """
    _check_numbers(root)
    _check_tree(root)


def _check_numbers(root: ET.Element) -> None:
    for element in root.iter():
        for name in NEEDED.get(element.tag, ()):
            if name not in element.attrib:
                raise UserError(f"<{element.tag}> without {name}")
        for name, wanted in ATTRIBUTES.get(element.tag, {}).items():
            if name in element.attrib:
                _check_number(f"<{element.tag} {name}={element.get(name)!r}>", element.attrib[name], wanted)
    for axis in root.iter("axis"):
        if not any(float(x) for x in axis.get("xyz", "1 0 0").split()):
            raise UserError("<axis xyz=…>: must not be zero in all directions")
    for mesh in root.iter("mesh"):
        if not all(float(x) for x in mesh.get("scale", "1 1 1").split()):
            raise UserError("<mesh scale=…>: must not be zero")
    for limit in root.iter("limit"):
        if float(limit.get("lower", 0)) > float(limit.get("upper", 0)):
            raise UserError(f"<limit>: lower={limit.get('lower')} lies above upper={limit.get('upper')}")


def _check_number(what: str, text: str, wanted: Numbers) -> None:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != wanted.count or not all(math.isfinite(x) and wanted.bounds.holds(x) for x in values):
        many = "a number" if wanted.count == 1 else f"{wanted.count} numbers"
        raise UserError(f"{what}: must be {many}{wanted.bounds}")


def _check_tree(root: ET.Element) -> None:
    """Names that are there once, and joints that make one tree of all links."""
    links, joints = _named(root, "link"), _named(root, "joint")
    if not links:
        raise UserError(
            "has no links" + ("; it is MJCF, and robots are read as URDF" if root.tag == "mujoco" else "")
        )
    above: dict[str, str] = {}
    for name, joint in joints.items():
        if joint.get("type") not in JOINTS:
            raise UserError(
                f"joint {name!r} of type {joint.get('type')!r}: must be one of {', '.join(JOINTS)}"
            )
        ends = []
        for tag in ("parent", "child"):
            end = joint.find(tag)
            link = None if end is None else end.get("link")
            if link not in links:
                raise UserError(f"joint {name!r}: its {tag} is {link!r}, which is no link")
            ends.append(link)
        parent, child = ends
        if child in above:
            raise UserError(f"link {child!r} hangs on two joints")
        above[child] = parent
    bases = [name for name in links if name not in above]
    if len(bases) != 1:
        raise UserError(
            f"has {len(bases)} links that hang on no joint ({', '.join(bases) or 'a circle'}), needs one"
        )
    for name in links:
        link, steps = name, 0
        while link in above:
            link, steps = above[link], steps + 1
            if steps > len(links):
                raise UserError(f"link {name!r} hangs on itself, through a circle of joints")


def _named(root: ET.Element, tag: str) -> dict[str, ET.Element]:
    found: dict[str, ET.Element] = {}
    for element in root.findall(tag):
        name = element.get("name")
        if not name or name in found:
            raise UserError(f"a {tag} without a name" if not name else f"two {tag}s are called {name!r}")
        found[name] = element
    return found
