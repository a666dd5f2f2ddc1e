"""Metadata that depends on where the repository lives; everything else is in pyproject.toml.

An index shows README.md away from the repository, where relative links lead nowhere. ``REPOSITORY=https://… python -m
build`` makes them absolute and writes the project's addresses. Without it no address is made up: pictures are left
out, and links become their text.
"""

import os
import re
from pathlib import Path

from setuptools import setup

LINK = re.compile(r"(?P<image>!?)\[(?P<text>[^\]]*)\]\((?!\w+://|#)(?P<target>[^)\s]+)\)")


def readme(text: str, repository: str) -> str:
    """README.md as an index can show it."""

    def replaced(match: re.Match[str]) -> str:
        image, text, target = match["image"], match["text"], match["target"]
        if not repository:
            return "" if image else text
        return f"{image}[{text}]({repository}/{'raw' if image else 'blob'}/HEAD/{target})"

    return LINK.sub(replaced, text)


def addresses(repository: str) -> dict[str, str]:
    """The project's addresses, by the labels that an index knows."""
    pages = {"Source": "", "Issues": "/issues", "Changelog": "/blob/HEAD/CHANGELOG.md"}
    pages |= {"Documentation": "/blob/HEAD/docs/index.md"}
    return {name: repository + page for name, page in pages.items()} if repository else {}


if __name__ == "__main__":
    repository = os.environ.get("REPOSITORY", "").rstrip("/")
    setup(
        long_description=readme(Path("README.md").read_text(encoding="utf-8"), repository),
        long_description_content_type="text/markdown",
        project_urls=addresses(repository),
    )
