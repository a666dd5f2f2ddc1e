"""Sliders of the planner's settings: whole numbers where their steps are."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from franka_wm.errors import UserError
from franka_wm.live.page import Page
from franka_wm.live.sliders import RANGES, Setting, rebuilt
from franka_wm.planning import MCTS


@pytest.mark.parametrize(("name", "moved", "sent"), [("temperature", 0.55, 0.55), ("horizon", 3.0, 3)])
def test_a_setting_that_is_whole_by_chance_takes_what_its_slider_gives(
    name: str, moved: float, sent: float
) -> None:
    """A temperature of 1 became 0 between 0 and 1, which is refused."""
    updates: list[Any] = []
    slider = SimpleNamespace(value=1, on_update=updates.append)
    planner = SimpleNamespace(**{name: 1})
    session = SimpleNamespace(planner=planner, set_planner=lambda **new: planner.__dict__.update(new))
    page: Any = SimpleNamespace(
        server=SimpleNamespace(gui=SimpleNamespace(add_slider=lambda *_: slider)),
        session=session,
        _sliders={},
        _allow=lambda *_: None,
        _try=lambda do: do(),
    )
    Page._add_slider(page, Setting(name, 1, *RANGES[name]))
    updates[0](SimpleNamespace(client=1, target=SimpleNamespace(value=moved)))
    assert getattr(planner, name) == sent and type(getattr(planner, name)) is type(sent)
    assert slider.value == sent


def test_a_longest_path_comes_back_with_more_simulations() -> None:
    """With as few as its length it does not matter, and must not be forgotten."""
    search = MCTS(num_actions=3, num_simulations=16, max_depth=4)
    few = rebuilt(search, num_simulations=2)
    assert few.num_simulations == 2
    again = rebuilt(few, num_simulations=16)
    assert again.max_depth == search.max_depth == 4


def test_a_recording_is_written_as_it_was_begun(tmp_path: Path) -> None:
    """The menu may have changed since; a dataset has no ending, a video has one."""
    written: list[Path] = []
    session: Any = SimpleNamespace(recording=False)

    def begin(kind: str) -> None:
        session.recording = True

    def end(path: Path) -> Path:
        written.append(path)
        session.recording = False
        return path

    session.start_recording, session.stop_recording = begin, end
    shown: list[bool] = []
    session.frame = lambda: session.recording
    menu, button = SimpleNamespace(value="video", disabled=False), SimpleNamespace(label="Record")
    page: Any = SimpleNamespace(
        session=session,
        folder=tmp_path,
        _kind=menu,
        _record=button,
        _notify=lambda *_: None,
        show=shown.append,
    )
    page.save_recording = lambda: Page.save_recording(page)
    for begun, later in (("video", "dataset"), ("dataset", "video")):
        menu.value = begun
        Page.toggle_recording(page)
        menu.value = later
        Page.toggle_recording(page)
        assert written[-1].suffix == (".mp4" if begun == "video" else "") and button.label == "Record"
    assert shown == [True, False, True, False]  # what the page says of it, while paused, too
    (tmp_path / "file").touch()
    page.folder = tmp_path / "file"
    with pytest.raises(
        UserError, match=r"out=.*file: .* is not a folder"
    ):  # and not when it is to be written
        Page.toggle_recording(page)
    assert not session.recording
