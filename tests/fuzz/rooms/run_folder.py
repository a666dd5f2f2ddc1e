"""Folders of runs, as strangers may send them, for `report`, `compare` and `summary`."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import yaml
from hypothesis import strategies as st

from rooms.checkpoint import WHOLE, _mutate, smoke_run
from rooms.forked import AcceptedError, NotApplicable
from rooms.odd import leaves, mutation

LINKS = ["/etc/passwd", "/dev/zero", "/", "..", "nowhere"]
SECRET = "fuzz-secret-of-the-environment"


class RunFolder:
    """Cases: `{"mutations": [[kind, file, …], …]}`."""

    name = "run_folder"
    seconds = 30.0

    def __init__(self, folder: Path) -> None:
        from franka_wm.commands import compare, report, summary  # noqa: F401
        from franka_wm.report.compare import compare_page
        from franka_wm.report.document import write_document
        from franka_wm.report.page import write_page
        from franka_wm.report.run import read_run

        self.source = smoke_run(folder)
        self.read, self.compare, self.write = read_run, compare_page, write_document
        self.page = write_page
        write_page(self.source)
        files = sorted(p.relative_to(self.source).as_posix() for p in self.source.rglob("*") if p.is_file())
        trees: dict[str, Any] = {}
        for name in files:
            if name.endswith(".json") and "optimizer" not in name and "replay" not in name:
                trees[name] = json.loads((self.source / name).read_text())
            elif name.endswith(".yaml"):
                trees[name] = yaml.safe_load((self.source / name).read_text())
        changes = [
            mutation(list(leaves(tree))).map(
                lambda m, name=name: ["yaml" if name.endswith(".yaml") else "json", name, *m]
            )
            for name, tree in trees.items()
            if list(leaves(tree))
        ]
        self.cases = st.fixed_dictionaries(
            {
                "mutations": st.lists(
                    st.one_of(
                        *changes,
                        *changes,
                        st.tuples(st.just("whole"), st.sampled_from(files), st.sampled_from(WHOLE)).map(list),
                        st.tuples(st.just("cut"), st.sampled_from(files), st.integers(0, 3000)).map(list),
                        st.tuples(st.just("link"), st.sampled_from(files), st.sampled_from(LINKS)).map(list),
                        st.tuples(st.just("gone"), st.sampled_from(files), st.just(0)).map(list),
                        st.tuples(st.just("folder"), st.sampled_from(files), st.just(0)).map(list),
                        st.tuples(
                            st.just("byte"), st.sampled_from(files), st.integers(0, 5000), st.integers(0, 255)
                        ).map(list),
                    ),
                    min_size=1,
                    max_size=3,
                )
            }
        )

    def use(self, case: dict[str, Any], folder: Path) -> None:
        """The page of the run, and the run beside a whole one."""
        import contextlib
        import io

        from franka_wm.commands.summary import summary
        from franka_wm.errors import UserError

        os.environ["FUZZ_SECRET"] = SECRET  # of this fork
        run = folder / "run"
        shutil.copytree(self.source, run, copy_function=os.link, symlinks=True)
        for kind, name, *rest in case["mutations"]:
            path = run / name
            if not path.is_file():
                raise NotApplicable("gone")
            self._damage(kind, path, rest)
        out = folder / "page.html"
        refused = None
        for use in (
            lambda: self.page(str(run), str(out)),
            lambda: self.write(self.compare([self.read(str(run)), self.read(str(self.source))]), out),
            lambda: summary.callback((str(run),)),  # type: ignore[misc]
        ):
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    use()
            except UserError as error:
                refused = error
            if out.is_file() and (SECRET in (text := out.read_text()) or "root:x:0" in text):
                raise AcceptedError("something of this machine in the page", "leak")
        if refused is None and (damage := self.read(str(run)).damage):
            refused = UserError(damage)  # which the page says
        if refused is not None:
            raise refused

    @staticmethod
    def _damage(kind: str, path: Path, rest: list[Any]) -> None:
        if kind == "link":
            path.unlink()
            path.symlink_to(rest[0])
        elif kind == "gone":
            path.unlink()
        elif kind == "folder":
            path.unlink()
            path.mkdir()
        elif kind == "byte":
            _mutate("header", path, rest) if path.stat().st_size else None
        else:
            _mutate(kind, path, rest)
