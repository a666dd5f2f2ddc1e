"""URDF and MJCF files of a scene, which a stranger may have written: what of them is read, and what is refused."""

from __future__ import annotations

import math
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from franka_wm.errors import UserError
from franka_wm.untrusted import xml_tree

MOST_BYTES = 8 * 2**20
"""Largest file that is read; meshes are files of their own."""
MOST_MESH_BYTES = 64 * 2**20
"""Most of all its meshes together."""
MOST_CORNERS, MOST_SIDES = 600_000, 1000
"""Most corners of all its meshes together, those of triangles counted each, and of one polygon: they cost time."""
MESHES = ("obj", "stl")
LARGEST = 1e9
"""Largest number."""
NOT_FINITE = re.compile(r"[+-]?(nan|inf)", re.IGNORECASE)
"""What C reads as a number that is none, also where Python does not: nan(1)."""
OBJ_LINE = re.compile(rb"(?:^|[\r\n])[ \t]*([vf])[ \t]([^\r\n]*)")

BODY = {"body", "frame", "geom", "joint", "site", "inertial"}
"""What a body of MJCF may have."""
LEFT_OUT = {"option", "size", "visual", "statistic", "keyframe", "sensor", "custom", "contact"}
"""Sections of MJCF that say nothing about a body of this scene."""
UNREAD = {"light", "camera"}
TEXT = {
    "name", "class", "childclass", "type", "mesh", "material", "file", "eulerseq", "angle", "shape", "link",
    "builtin", "content_type", "filename",
}  # fmt: skip
"""Attributes that are no numbers whatever they hold."""


@dataclass(frozen=True)
class Source:
    """What MuJoCo's compiler gets to read.

    Attributes:
        xml: Links, joints and geometry alone.
        meshes: The files that it names.
        hides_colliders: Whether colliders are not drawn, because there is geometry that is only seen.
    """

    xml: str
    meshes: dict[str, bytes]
    hides_colliders: bool


def read_source(file: str) -> Source:
    """The links, joints and geometry of a ``.urdf`` or ``.xml`` file, with its meshes.

    Raises:
        UserError: One line that says what is wrong.
    """
    path = Path(file).expanduser()
    if path.suffix.lower() not in (".urdf", ".xml"):
        raise UserError(f"{file!r}: must be a file that ends in .urdf or .xml (MJCF)")
    if not os.path.isfile(path):  # unlike Path.is_file, it takes names that no file can have
        raise UserError(f"{path}: no such file")
    try:
        root = xml_tree(_content(path, MOST_BYTES))
        if root.tag == "robot":
            return _urdf(root, path)
        if root.tag == "mujoco":
            return _mjcf(root, path)
        raise UserError(f"begins with <{root.tag[:40]}>; URDF begins with <robot>, MJCF with <mujoco>")
    except UserError as error:
        raise UserError(f"{path}: {error}") from error


def _content(path: Path, most: int) -> bytes:
    try:
        with path.open("rb") as file:
            content = file.read(most + 1)
    except OSError as error:
        raise UserError(f"cannot be read ({error})") from error
    if len(content) > most:
        raise UserError(f"larger than {most / 2**20:g} MiB, the most that is read")
    return content


def _check_numbers(root: ET.Element) -> None:
    for element in root.iter():
        for name, text in element.attrib.items():
            if name in TEXT:
                continue
            for word in text.split():
                try:
                    value = math.nan if NOT_FINITE.match(word) else float(word)
                except ValueError:
                    continue
                least = 0.0 if name in ("mass", "density") else -LARGEST  # MuJoCo passes over negative ones
                if not least <= value <= LARGEST:
                    raise UserError(
                        f"<{element.tag[:40]} {name}={text[:80]!r}>: must be numbers from {least:g} to {LARGEST:g}"
                    )


# -- URDF ---------------------------------------------------------------------------------------------------


def _urdf(root: ET.Element, path: Path) -> Source:
    from franka_wm.envs.robots.description import check_description  # here: robots need scenes

    check_description(root)
    for joint in root.iter("joint"):
        if joint.find("mimic") is not None:
            raise UserError(
                f"joint {joint.get('name')!r} follows another one, which scenes have not; remove <mimic>"
            )
    bare = ET.Element("robot", {"name": "body"})
    options = ET.SubElement(bare, "mujoco")
    ET.SubElement(
        options, "compiler", {"fusestatic": "false", "discardvisual": "false", "strippath": "false"}
    )
    bare.extend(child for child in root if child.tag in ("link", "joint", "material"))
    for material in bare.iter("material"):
        for texture in material.findall("texture"):
            material.remove(texture)
    meshes = _Meshes(path)
    for mesh in bare.iter("mesh"):
        mesh.set("filename", meshes.add(mesh.get("filename", "")))
    _check_numbers(bare)
    for link in bare.iter("link"):
        for geometry in (*link.findall("visual"), *link.findall("collision")):
            if geometry.find("geometry") is None:
                raise UserError(f"link {link.get('name')!r}: a {geometry.tag} without a geometry")
    return Source(ET.tostring(bare, encoding="unicode"), meshes.found, bare.find("link/visual") is not None)


# -- MJCF ---------------------------------------------------------------------------------------------------


def _mjcf(root: ET.Element, path: Path) -> Source:
    bare = ET.Element("mujoco")
    compiler = ET.SubElement(bare, "compiler")
    folder = ""
    for section in root:
        if section.tag == "compiler":
            compiler.attrib.update(section.attrib)
            folder = section.get("meshdir", section.get("assetdir", folder))
        elif section.tag in ("default", "asset", "worldbody"):
            bare.append(section)
        elif section.tag not in LEFT_OUT:
            raise UserError(f"<{section.tag[:40]}> is not read; remove it, or write all into one file")
    for name in ("meshdir", "texturedir", "assetdir"):
        compiler.attrib.pop(name, None)
    compiler.attrib.update({"fusestatic": "false", "discardvisual": "false", "strippath": "false"})
    for world in bare.findall("worldbody"):
        _check_body(world)
    _check_numbers(bare)
    for element in bare.iter("mesh"):
        if "builtin" in element.attrib or len(element):
            raise UserError("<mesh> with builtin= or <plugin>: must come from a file, or from vertex=")
    for element in bare.iter("material"):
        element.attrib.pop("texture", None)
        for layer in element.findall("layer"):
            element.remove(layer)
    meshes = _Meshes(path)
    for asset in bare.findall("asset"):
        for element in list(asset):
            if element.tag not in ("mesh", "material"):
                if element.tag != "texture":
                    raise UserError(f"<asset> with <{element.tag[:40]}>: must be meshes and materials")
                asset.remove(element)
            elif "file" in element.attrib:
                name = element.attrib["file"]
                element.attrib.setdefault("name", Path(name).stem)
                element.attrib.pop("content_type", None)
                element.set("file", meshes.add(name, folder))
            else:
                meshes.count(
                    len(element.get("vertex", "").split()) // 3 + len(element.get("face", "").split())
                )
    return Source(ET.tostring(bare, encoding="unicode"), meshes.found, hides_colliders=False)


def _check_body(body: ET.Element) -> None:
    for element in list(body):
        if element.tag in UNREAD:
            body.remove(element)
        elif element.tag not in BODY:
            raise UserError(f"<{body.tag}> with <{element.tag[:40]}>: must be of {', '.join(sorted(BODY))}")
        else:
            _check_body(element)


# -- meshes -------------------------------------------------------------------------------------------------


class _Meshes:
    """Meshes that a file names, read into memory.

    Args:
        file: The file; they must be in its folder, or in that of its package.
    """

    def __init__(self, file: Path):
        self._folder = file.parent
        self._names: dict[Path, str] = {}
        self._corners = 0
        self.found: dict[str, bytes] = {}

    def add(self, name: str, below: str = "") -> str:
        """Reads a mesh once; what the file is to call it."""
        suffix = Path(name).suffix.lower().lstrip(".")
        if suffix not in MESHES:
            raise UserError(
                f"mesh {name[:200]!r}: must be a file that ends in {', '.join(f'.{x}' for x in MESHES)}"
            )
        for folder, candidate in self._candidates(name, below):
            if not os.path.isfile(candidate):
                continue
            real = candidate.resolve()
            if not real.is_relative_to(folder.resolve()):
                raise UserError(f"mesh {name[:200]!r}: lies outside of {folder}; copy it there")
            if real not in self._names:
                left = MOST_MESH_BYTES - sum(map(len, self.found.values()))
                self._names[real] = f"mesh{len(self._names)}.{suffix}"
                content = self.found[self._names[real]] = _content(real, left)
                try:
                    (self._count_obj if suffix == "obj" else self._count_stl)(content)
                except UserError as error:
                    raise UserError(f"mesh {name[:200]!r}: {error}") from error
            return self._names[real]
        raise UserError(f"mesh {name[:200]!r}: no such file in {self._folder}")

    def count(self, corners: int) -> None:
        """Adds the corners of a mesh; too many are refused before anything is made of them."""
        self._corners += corners
        if self._corners > MOST_CORNERS:
            raise UserError(
                f"meshes with more than {MOST_CORNERS} corners, those of triangles counted each; thin them"
            )

    def _count_obj(self, content: bytes) -> None:
        for line in OBJ_LINE.finditer(content):
            sides = len(line[2].split()) if line[1] == b"f" else 1
            if sides > MOST_SIDES:
                raise UserError(
                    f"has a polygon of {sides} corners, the most is {MOST_SIDES}; cut it into triangles"
                )
            self.count(sides)

    def _count_stl(self, content: bytes) -> None:
        self.count(6 * int.from_bytes(content[80:84], "little"))

    def _candidates(self, name: str, below: str) -> Iterator[tuple[Path, Path]]:
        """Folders that a mesh must not leave, and where it may be."""
        scheme, _, rest = name.partition("://")
        if not rest:
            yield self._folder, self._folder / below / name
        elif scheme in ("package", "model"):
            package, _, inner = rest.partition("/")
            here = self._folder.resolve()
            for folder in (here, *here.parents[:2]):  # PACKAGE/urdf/body.urdf, and one more
                if package and folder.name == package:
                    yield folder, folder / inner
            yield self._folder, self._folder / inner
            yield self._folder, self._folder / rest
        else:
            raise UserError(f"mesh {name[:200]!r}: only local files are read; download it and name the file")
