"""Files that others wrote, read without harm: runs, evaluations, datasets that came from elsewhere.

Nothing is executed, unpickled or taken from the environment. A link that leaves the folder is refused, and so is
whatever is no ordinary file. Sizes are checked before anything is allocated.
"""

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

import yaml

from franka_wm.errors import FrankaError, UserError

MOST_JSON = 32 * 2**20
MOST_YAML = 2**20
MOST_TEXT = 32 * 2**20
"""Largest file of each kind that is read [bytes]."""
MOST_ELEMENTS, DEEPEST = 20_000, 100
"""Most elements of an XML file, and levels of elements."""
MOST_PIXELS = 40_000_000
"""Largest image [px]: an image of 60000 × 60000 fits into a few kB and fills the memory of whoever opens it."""


@dataclass(frozen=True)
class UntrustedFolder:
    """A folder of files that someone else may have written.

    Attributes:
        root: the folder; it may be a link itself, since it is the user who names it.
    """

    root: Path

    def path(self, name: str | Path) -> Path | None:
        """Where the file `name` is; None if there is none.

        Raises:
            UserError: it is a link out of the folder, or no ordinary file.
        """
        path = self._inside(name)
        if path is not None and not path.is_file():
            raise UserError(f"{path} is no file; remove it.")
        return path

    def below(self, name: str | Path) -> "UntrustedFolder":
        """The folder `name`, which need not be there.

        Raises:
            UserError: it is a link out of this folder.
        """
        self._inside(name)
        return UntrustedFolder(self.root / name)

    def _inside(self, name: str | Path) -> Path | None:
        path = self.root / name
        if not path.exists() and not path.is_symlink():
            return None
        real = path.resolve()
        if not real.is_relative_to(self.root.resolve()):
            raise UserError(
                f"{path} is a link to {real}, outside of {self.root}; copy the file, or remove the link."
            )
        return path

    def bytes(self, name: str | Path, most: int = MOST_TEXT) -> bytes | None:
        """The content of the file `name`; None if there is none.

        Raises:
            UserError: as for `path`; or it is larger than `most` bytes, or cannot be read.
        """
        path = self.path(name)
        if path is None:
            return None
        try:
            with path.open("rb") as file:
                content = file.read(most + 1)
        except OSError as error:
            raise UserError(
                f"{path} cannot be read ({error}); remove it or copy the folder again."
            ) from error
        if len(content) > most:
            raise UserError(f"{path} is larger than {most / 2**20:g} MiB, the most that is read; remove it.")
        return content

    def text(self, name: str | Path, most: int = MOST_TEXT) -> str | None:
        """The text of the file `name`; None if there is none.

        Raises:
            UserError: as for `bytes`, or it is not UTF-8.
        """
        content = self.bytes(name, most)
        try:
            return None if content is None else content.decode()
        except UnicodeDecodeError as error:
            raise UserError(f"{self.root / name} cannot be read ({error}); remove it.") from error

    def json(self, name: str | Path) -> dict[str, Any] | None:
        """The object in a JSON file, NaN and infinities as None; None if there is no file.

        Raises:
            UserError: as for `text`, or it holds no object.
        """
        text = self.text(name, MOST_JSON)
        if text is None:
            return None
        try:
            found = json.loads(text, parse_constant=lambda _: None, parse_float=_finite)
        except (ValueError, RecursionError) as error:
            raise UserError(
                f"{self.root / name} cannot be read ({error}); remove it or write it again."
            ) from error
        if not isinstance(found, dict):
            raise UserError(f"{self.root / name} holds no object; remove it or write it again.")
        return found

    def yaml(self, name: str | Path) -> Any:
        """The plain values in a YAML file, interpolations (``${…}``) as the text that they are; None if no file.

        Raises:
            UserError: as for `text`; or it is no YAML, or holds an alias (``*name``): with aliases a few bytes
                become gigabytes, and no run writes them.
        """
        text = self.text(name, MOST_YAML)
        try:
            return None if text is None else yaml.load(text, _PlainLoader)
        except (yaml.YAMLError, RecursionError, ValueError) as error:
            raise UserError(
                f"{self.root / name} cannot be read ({str(error).splitlines()[0]}); remove it or write it again."
            ) from error

    def files(self, pattern: str) -> Iterator[str]:
        """Names of the files below the folder that fit `pattern`, sorted.

        Raises:
            UserError: as for `path`.
        """
        for path in sorted(self.root.rglob(pattern)):
            name = path.relative_to(self.root).as_posix()
            if not path.is_dir() and self.path(name) is not None:
                yield name

    def check_links(self, below: str | Path = "") -> None:
        """Refuse every link in the folder, or in the folder `below` in it, that leaves the former.

        So is a pipe or a device: whoever opened it might wait for ever.

        Raises:
            UserError: it names the first one.
        """
        for path in sorted((self.root / below).rglob("*")):
            if path.is_symlink():
                self._inside(path.relative_to(self.root))
            if not path.is_file() and not path.is_dir() and path.exists():
                raise UserError(f"{path} is no file; remove it.")


def linked_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file that may be a link, as the Hub's local copies are.

    Raises:
        UserError: as for `UntrustedFolder.json`, or there is none.
    """
    real = path.resolve()
    return _there(path, UntrustedFolder(real.parent).json(real.name))


def linked_bytes(path: Path) -> bytes:
    """The content of a JSON file that may be a link.

    Raises:
        UserError: as for `UntrustedFolder.bytes`, or there is none.
    """
    real = path.resolve()
    return _there(path, UntrustedFolder(real.parent).bytes(real.name, MOST_JSON))


def _there[T](path: Path, found: T | None) -> T:
    if found is None:
        raise UserError(f"{path} is missing; copy the folder again.")
    return found


def xml_tree(content: bytes) -> ET.Element:
    """The tree of an XML file, after a look at its size: a few bytes of entities or levels could fill the memory.

    Raises:
        UserError: It is no XML, declares a document type, or has too many elements or levels.
    """
    parser, depth, count = expat.ParserCreate(), 0, 0

    def start(_name: str, _attributes: object) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > DEEPEST or count > MOST_ELEMENTS:
            raise UserError(f"has more than {MOST_ELEMENTS} elements, or {DEEPEST} levels of them")

    def end(_name: str) -> None:
        nonlocal depth
        depth -= 1

    def doctype(*_: object) -> None:
        raise UserError("declares a document type, which may hide entities; remove <!DOCTYPE …>")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
        return ET.fromstring(content)
    except UserError:
        raise
    except (expat.ExpatError, ET.ParseError, ValueError, LookupError) as error:
        raise UserError(f"not readable XML ({error})") from error


@contextmanager
def values_of(what: str, then: str) -> Iterator[None]:
    """Around the use of what a file holds: values of a form that nothing writes end in one line.

    Args:
        what: Which file or folder, for the message.
        then: What to do.

    Raises:
        UserError: In place of what such values lead to.
    """
    try:
        yield
    except FrankaError:
        raise
    except (
        ArithmeticError,
        AssertionError,
        AttributeError,
        LookupError,
        OSError,
        RecursionError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        if type(error).__name__ == "OutOfMemoryError":  # torch's RuntimeError: no fault of the file
            raise
        reason = (str(error).strip() or "no value").splitlines()[0]
        raise UserError(
            f"{what} holds values of another form than was written ({type(error).__name__}: {reason}); {then}"
        ) from error


def check_image(path: Path) -> None:
    """Refuse what is no PNG, or one of too many pixels. Only its header is read.

    Raises:
        UserError: it says which.
    """
    from PIL import Image

    try:
        with Image.open(path, formats=("PNG",)) as image:
            width, height = image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise UserError(f"{path} is no image that can be shown ({error}); remove it.") from error
    if width * height > MOST_PIXELS:
        raise UserError(f"{path} has {width} × {height} pixels, the most is {MOST_PIXELS:,}; remove it.")


def check_video(path: Path) -> None:
    """Refuse what is no .mp4 by its first bytes.

    Raises:
        UserError: it says so.
    """
    with path.open("rb") as file:
        if file.read(8)[4:] != b"ftyp":
            raise UserError(f"{path} is no video that can be shown; remove it.")


class _PlainLoader(yaml.SafeLoader):
    """Plain values, each written out."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it holds an alias, which no run writes")
        return super().compose_node(parent, index)


def _finite(text: str) -> float | None:
    value = float(text)
    return value if math.isfinite(value) else None
