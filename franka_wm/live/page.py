"""The live page: a session's scene, its controls and its plots, served to browsers on this machine."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from franka_wm.envs.scene import FLOOR
from franka_wm.errors import UserError
from franka_wm.files import unwritable
from franka_wm.live.extras import import_viser
from franka_wm.live.frame import Frame
from franka_wm.live.gate import Gate, is_number, is_point, stop
from franka_wm.live.objects import room, rows
from franka_wm.live.session import FARTHEST, GOAL_NAME, SPEEDS, Session
from franka_wm.live.shapes import arm_shapes
from franka_wm.live.sliders import Setting
from franka_wm.live.viser_scene import ViserScene, handle_name
from franka_wm.report.style import BLUE, VERMILION, policy_name

HOST = "127.0.0.1"
"""The page takes orders from whoever reaches it, so only this machine does."""

HISTORY = 10.0
"""How far back the plots look, in simulated time [s]."""
PENDING = 8
"""Requests of browsers that may wait for the session at once; further ones are ignored."""
REDRAW = 0.2
"""Least time between two images of the plots and the status [s]; the arm moves in every step."""

KINDS = "video: an .mp4 of the arm; dataset: a LeRobot dataset of what is observed and done"

LABELS = {
    "horizon": "horizon [steps]",
    "num_samples": "candidates",
    "iterations": "iterations",
    "num_simulations": "simulations",
    "temperature": "temperature",
}


class Page:
    """Serves a session. Everything that a browser does goes through the session's methods.

    Args:
        session: What is shown; its thread is started.
        port: On 127.0.0.1; 0 takes a free one, and so does a port in use: :attr:`address` tells which.
        folder: Where recordings go.
        title: Over the controls.

    Raises:
        UserError: viser is missing.
    """

    def __init__(
        self, session: Session, *, port: int = 8080, folder: str | Path = ".", title: str = "franka_wm"
    ):
        viser = import_viser()
        self.session, self.folder = session, Path(folder)
        self.gate = Gate()
        self.server = self.gate.serve(
            lambda: viser.ViserServer(host=HOST, port=port, label=title, verbose=False)
        )
        self._closed = False
        self._pending = threading.BoundedSemaphore(PENDING)
        arm = session.arm
        first = session.frame()
        self.scene = ViserScene(
            self.server,
            arm_shapes(arm.model),
            bodies=len(first.bodies),
            success_distance=arm.simulation.task.success_distance,
            floor=FLOOR if arm.config.resolved_scene else 0.0,
            on_goal=session.ask_goal,
            objects=rows(arm),
            on_object=self._ask_object,
        )
        self.gate.allow_drag(GOAL_NAME, lambda point: is_point(point, 3, FARTHEST))
        for name in session.objects:
            self.gate.allow_drag(handle_name(name), is_within(room(arm)))
        self._times: deque[float] = deque(maxlen=30)
        most = max(2, round(HISTORY * arm.config.fps))
        self._history: deque[tuple[float, float, float]] = deque(maxlen=most)
        self._drawn = 0.0
        self._drawing = threading.RLock()
        self._sliders: dict[str, Any] = {}
        self._build(title)
        session.listen(self.show)
        self.show(first)
        session.start()

    @property
    def port(self) -> int:
        return self.server.get_port()

    @property
    def address(self) -> str:
        return f"http://{HOST}:{self.port}"

    def close(self, timeout: float | None = None) -> bool:
        """Stops the server and the session's thread, and takes no more requests.

        Args:
            timeout: How long to wait for the present step, and again for requests being carried out [s]; for ever
                if None.

        Returns:
            Whether all of them ended in time; if not, the server still runs, and the process is to be ended.
        """
        ended = self.session.stop(timeout)
        if not self._closed:
            self._closed = True
            ended &= all(self._pending.acquire(timeout=timeout) for _ in range(PENDING))
        if ended:
            stop(self.server)
        return ended

    # -- controls ----------------------------------------------------------------------------------------

    def _build(self, title: str) -> None:
        gui, session = self.server.gui, self.session
        red, green, blue = (int(BLUE[i : i + 2], 16) for i in (1, 3, 5))
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(red, green, blue))
        self._status = gui.add_markdown("")
        self._play = self._allow(gui.add_button("Play", icon="player-play"), is_click)
        self._play.on_click(lambda _: self._try(self.toggle))
        others = {"One step": self._step_once, "New episode": session.reset}
        group = self._allow(gui.add_button_group("", list(others)), is_one_of(others))
        group.on_click(lambda event: self._try(others[event.target.value]))
        names = {policy_name(name): name for name in session.policies}
        self._policy = self._allow(
            gui.add_dropdown(
                "policy",
                list(names),
                initial_value=policy_name(session.policy),
                hint="Who decides what the arm does",
            ),
            is_one_of(names),
        )
        self._policy.on_update(lambda event: self._try(lambda: session.set_policy(names[event.target.value])))
        speed = gui.add_slider("speed", *SPEEDS, 0.1, 1.0, hint="1: as fast as the real arm")
        self._allow(speed, lambda value: is_number(value, *SPEEDS))
        speed.on_update(lambda event: setattr(session, "speed", float(event.target.value)))
        keep = gui.add_checkbox(
            "keep the goal", session.keep_goal, hint="A dragged goal outlives the episode"
        )
        self._allow(keep, lambda value: isinstance(value, bool))
        keep.on_update(lambda event: setattr(session, "keep_goal", bool(event.target.value)))
        if session.arm.config.resolved_scene is not None:
            self._contacts = gui.add_checkbox(
                "contacts",
                session.show_contacts,
                hint="Where things touch, and how hard: 10 mm to each side for a newton",
            )
            self._allow(self._contacts, lambda value: isinstance(value, bool))
            self._contacts.on_update(
                lambda event: self._try(lambda: self.show_contacts(bool(event.target.value)))
            )
        empty = (np.zeros(1), np.zeros(1))
        self._distance = self._plot("distance to the goal [cm]", empty, VERMILION)
        self._reward = self._plot("reward", empty, BLUE)
        if session.settings:
            with gui.add_folder("Planner"):
                for setting in session.settings:
                    self._add_slider(setting)
        with gui.add_folder("Record", expand_by_default=False):
            kinds = ("video", "dataset")
            self._kind = gui.add_dropdown("as", kinds, initial_value="video", hint=KINDS)
            self._allow(self._kind, is_one_of(kinds))
            self._recorded = "video"
            self._record = gui.add_button("Record", icon="player-record", color="gray")
            self._allow(self._record, is_click)
            self._record.on_click(lambda _: self._try(self.toggle_recording))

    def _add_slider(self, setting: Setting) -> None:
        slider = self.server.gui.add_slider(
            LABELS.get(setting.name, setting.name),
            setting.low,
            setting.high,
            setting.step,
            setting.value,
        )
        self._sliders[setting.name] = slider
        whole = isinstance(setting.step, int)  # a temperature of 1 is no whole number
        self._allow(slider, lambda value: is_number(value, setting.low, setting.high))

        def moved(event: Any) -> None:
            if event.client is None:  # put back by us
                return
            value = event.target.value
            self._try(lambda: self.session.set_planner(**{setting.name: int(value) if whole else value}))
            slider.value = getattr(self.session.planner, setting.name)

        slider.on_update(moved)

    def _plot(self, title: str, data: tuple[np.ndarray, ...], colour: str) -> Any:
        return self.server.gui.add_uplot(
            data,
            ({"label": "s"}, {"label": title, "stroke": colour, "width": 2}),
            title=title,
            scales=axes(0.0, 1.0),
            legend={"show": False},
            height=115,
            padding=(10, 18, 0, 0),
        )

    def _allow(self, control: Any, check: Callable[[Any], bool]) -> Any:
        return self.gate.allow(control, check)

    def _step_once(self) -> None:
        self.session.pause()
        self.session.step()

    def toggle(self) -> None:
        """Play or pause."""
        if self.session.playing:
            self.session.pause()
        else:
            self.session.play()
        self.show(self.session.frame())

    def show_contacts(self, shown: bool) -> None:
        """Whether contacts are read and drawn."""
        self.session.show_contacts = shown
        self.show(self.session.frame())

    def toggle_recording(self) -> None:
        """Starts to record, or writes ``live-DATE-TIME…`` into the folder and says where."""
        kind = str(self._kind.value)
        if not self.session.recording:
            if (why := unwritable(self.folder)) is not None:
                raise UserError(f"out={self.folder}: {why}")
            self.session.start_recording(kind)
            self._recorded = kind  # whatever the menu says by the time it is written
            self._record.label, self._kind.disabled = "Stop and save", True
            self.show(self.session.frame())
            return
        self._notify("Saved", str(self.save_recording()))

    def save_recording(self) -> Path:
        """Writes ``live-DATE-TIME…`` into the folder.

        Raises:
            UserError: Nothing is recorded, or it cannot be written.
        """
        name = f"live-{datetime.now():%Y-%m-%d-%H-%M-%S}{'.mp4' if self._recorded == 'video' else ''}"
        try:
            return self.session.stop_recording(self.folder / name).resolve()
        finally:  # what could not be written is kept, and the button still saves it
            if not self.session.recording:
                self._record.label, self._kind.disabled = "Record", False
            self.show(self.session.frame())

    def _ask_object(self, name: str, point: Sequence[float]) -> None:
        try:
            self.session.ask_object(name, point)
        except UserError as error:  # it lies on the floor, and was touched there
            self.gate.ignore(str(error))

    def _try(self, action: Callable[[], Any]) -> None:
        """Does what a browser asked for; what cannot be done is said there."""
        if not self._pending.acquire(blocking=False):
            self.gate.ignore(f"a request while {PENDING} others wait")
            return
        try:
            action()
        except UserError as error:
            self._notify("That did not work", str(error), colour="red")
        finally:
            self._pending.release()

    def _notify(self, title: str, body: str, *, colour: Any = "green") -> None:
        for client in self.server.get_clients().values():
            client.add_notification(title=title, body=body, color=colour, auto_close_seconds=8.0)

    # -- what is shown -----------------------------------------------------------------------------------

    def show(self, frame: Frame) -> None:
        """Called by the session with every frame, in the thread that made it."""
        with self._drawing:  # a browser's request shows frames as well, beside the session's thread
            self._draw(frame)

    def _draw(self, frame: Frame) -> None:
        self.scene.show(frame)
        now = time.perf_counter()
        if frame.stepped:
            self._times.append(now)
            seconds = frame.steps / self.session.arm.config.fps
            self._history.append((seconds, 100.0 * frame.distance, frame.reward))
        playing = self.session.playing
        if playing and now - self._drawn < REDRAW:
            return
        self._drawn = now
        self._play.label = "Pause" if playing else "Play"
        self._play.icon = "player-pause" if playing else "player-play"
        self._status.content = self._describe(frame)
        if len(self._history) > 1:
            seconds, distance, reward = np.array(self._history).T
            draw(self._distance, seconds - seconds[-1], distance, steps=10.0)
            draw(self._reward, seconds - seconds[-1], reward, steps=0.1)

    def _describe(self, frame: Frame) -> str:
        fps = self.session.arm.config.fps
        state = "reached" if frame.success else f"{100 * frame.distance:.1f} cm to go"
        lines = [f"**{state}** · {frame.steps / fps:.1f} s · episode {frame.episode + 1}"]
        if self.session.playing and len(self._times) > 1:
            rate = (len(self._times) - 1) / max(self._times[-1] - self._times[0], 1e-6)
            lines.append(f"{rate:.0f} of {fps:.0f} steps/s · decision {1000 * frame.decision:.1f} ms")
        else:
            lines.append("paused")
        if frame.recording is not None:
            full = " (full: stop and save)" if frame.recording_full else ""
            lines.append(f"recording: {frame.recording / fps:.1f} s{full}")
        return "  \n".join(lines)


def is_click(value: Any) -> bool:
    """Whether a value is what a pressed button sends."""
    return value is True


def is_within(bounds: Sequence[tuple[float, float]]) -> Callable[[Any], bool]:
    """A check for points whose coordinates are within (least, most) each."""
    return lambda value: (
        isinstance(value, (list, tuple))
        and len(value) == len(bounds)
        and all(is_number(x, *pair) for x, pair in zip(value, bounds, strict=True))
    )


def is_one_of(choices: Iterable[str]) -> Callable[[Any], bool]:
    """A check for the values of a menu."""
    known = frozenset(choices)
    return lambda value: isinstance(value, str) and value in known


def draw(plot: Any, seconds: np.ndarray, values: np.ndarray, *, steps: float) -> None:
    """Puts a curve into a plot, whose axis holds 0 and all values and grows and shrinks in whole ``steps``.

    Time counts back from now: axes that stay as they are need not be built anew.
    """
    low = steps * np.floor(min(0.0, float(values.min())) / steps)
    high = steps * np.ceil(max(0.0, float(values.max())) / steps)
    scales = axes(low, high if high > low else low + steps)
    if plot.scales != scales:
        plot.scales = scales
    plot.data = (seconds, values)


def axes(low: float, high: float) -> dict[str, Any]:
    """The last seconds, and values from ``low`` to ``high`` with a margin."""
    margin = 0.06 * (high - low)
    return {
        "x": {"time": False, "range": (-HISTORY, 0.0)},
        "y": {"range": (float(low - margin), float(high + margin))},
    }
