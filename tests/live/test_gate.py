"""What a browser may send to the live page: hostile messages change nothing, cost nothing, and end nothing."""

from __future__ import annotations

import gc
import json
import logging
import math
import socket
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from typing import Any

import numpy as np
import pytest

viser = pytest.importorskip("viser", reason="needs the extra view")

import msgspec.msgpack  # noqa: E402
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from franka_wm.errors import UserError  # noqa: E402
from franka_wm.live.gate import LEFT, Gate, decoded, foreign, short  # noqa: E402
from franka_wm.live.page import PENDING, Page  # noqa: E402
from franka_wm.live.session import BUDGET  # noqa: E402
from franka_wm.live.viser_scene import EYE, LOOK_AT  # noqa: E402

GOAL = (0.45, 0.05, 0.45)
POSE = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.4, 0.2, 0.5]}
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1], "fov": 0.8, "near": 0.01, "far": 1000, "image_height": 700, "image_width": 1000,
}  # fmt: skip


@pytest.fixture(scope="module")
def page(make_session) -> Iterator[Page]:
    session = make_session(policy="noop", keep_goal=True)
    session.set_goal(GOAL)
    page = Page(session, port=0)
    page.said = []  # pyright: ignore
    page.gate._complain = page.said.append  # pyright: ignore
    yield page
    page.close()


def client(page: Page, **headers: str) -> Any:
    return connect(
        f"ws://127.0.0.1:{page.port}",
        subprotocols=[f"viser-v{viser.__version__}"],  # pyright: ignore
        additional_headers=headers,
        max_size=None,
    )


def quiet(page: Page) -> None:
    """Nothing was said so far."""
    page.said.clear()  # pyright: ignore
    page.gate._said, page.gate._unsaid = -math.inf, 0


def update(control: Any, value: Any, **more: Any) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {"value": value} | more}


def hostile(page: Page) -> list[Any]:
    """Messages that no page sends."""
    samples, horizon = page._sliders["num_samples"], page._sliders["horizon"]
    drag = {"type": "TransformControlsUpdateMessage", "name": "/goal"} | POSE
    upload = {
        "type": "FileTransferStartUpload", "source_component_uuid": page._play._impl.uuid, "transfer_uuid": "x",
        "filename": "x", "mime_type": "x", "part_count": 10**9, "size_bytes": 10**12,
    }  # fmt: skip
    wrong: list[Any] = [
        update(samples, v) for v in (5_000_000, -1, 0, math.nan, math.inf, 10**400, "9", None, [1], True)
    ]
    wrong += [update(horizon, 6, removed=True), {**update(horizon, 6), "updates": {"removed": True}}]
    wrong += [{**update(horizon, 6), "updates": {"update_cb": []}}, {**update(horizon, 6), "uuid": "nobody"}]
    wrong += [
        {**update(horizon, 6), "updates": {}},
        {**update(horizon, 6), "updates": [1]},
        {**update(horizon, 6), "x": 1},
    ]
    wrong += [update(page._policy, v) for v in ("fly", 3, None, ["planner"])]
    wrong += [update(page._play, v) for v in (False, 1, "yes")]
    for place in ([1e300, 0, 0], [math.nan, 0, 0], [0, 0, math.inf], [0, 0], [0, 0, "1"], [9, 0, 0], None):
        wrong.append(drag | {"position": place})
    wrong += [
        drag | {"wxyz": [math.nan] * 4},
        drag | {"name": "/arm"},
        drag | {"owner": "client/0"},
        drag | {"z": 1},
    ]
    wrong += [CAMERA | {"fov": math.nan}, CAMERA | {"image_width": 1e12}, CAMERA | {"position": [1e9, 0, 0]}]
    wrong += [
        {"type": "ShareUrlRequest"},
        {"type": "SceneNodeClickMessage", "name": "/goal"},
        upload,
        {},
        [],
        7,
        None,
    ]
    wrong += [
        {"type": "RunJavascriptMessage", "source": "1"},
        {"type": "RemoveSceneNodeMessage", "name": "/goal"},
    ]
    return wrong


def test_what_the_page_sends_is_admitted_and_nothing_else(page: Page) -> None:
    good = [
        update(page._sliders["num_samples"], 64),
        update(page._play, True),
        update(page._policy, "planner"),
        {"type": "TransformControlsUpdateMessage", "name": "/goal", "owner": ""} | POSE,
        {"type": "TransformControlsDragStartMessage", "name": "/goal", "owner": ""},
        {"type": "TransformControlsDragEndMessage", "name": "/goal"},
        CAMERA,
    ]
    assert all(page.gate.admits(message) for message in good)
    for message in hostile(page):
        assert not page.gate.admits(message), message


def test_the_camera_follows_a_phone_that_is_turned(page: Page) -> None:
    """Its first message may be of a picture of no size yet; only what turns it moves the camera, not what it sees."""
    before = set(page.server.get_clients())

    def sees(browser: Any, width: int, height: int, look_at: Any = LOOK_AT, eye: Any = (1, 1, 1)) -> None:
        size = {"image_width": width, "image_height": height}
        browser.send(msgspec.msgpack.encode(CAMERA | size | {"look_at": look_at, "position": eye}))

    with client(page) as browser:
        for size in ((300, 150), (0, 0), (300, 0), (0, 640)):
            sees(browser, *size)
        wait(lambda: set(page.server.get_clients()) - before, "not connected")
        camera = page.server.get_clients()[max(page.server.get_clients())].camera
        np.testing.assert_array_equal(camera.look_at, LOOK_AT)
        sees(browser, 360, 640)
        wait(lambda: camera.look_at[2] < 0, "upright: the arm is not above the controls")
        sees(browser, 360, 640, (0.0, 0.0, 7.0))
        wait(lambda: camera.look_at[2] == 7.0, "what a finger did to the camera is undone")
        sees(browser, 360, 640, LOOK_AT, EYE)
        wait(
            lambda: camera.look_at[2] < 0,
            "a phone that took the page's first view late, or again, stays there",
        )
        sees(browser, 640, 360)
        wait(lambda: np.allclose(camera.look_at, LOOK_AT), "turned back: not the view of a wide window")
        np.testing.assert_allclose(camera.position, EYE)


def test_hostile_messages_change_nothing_and_good_ones_still_arrive(page: Page) -> None:
    session = page.session
    before, planner, speed = session.frame(), session.planner, session.speed
    page.said.clear()  # pyright: ignore
    raw = [
        msgspec.msgpack.encode(m) for m in hostile(page) if m is not None and "10000000000000" not in str(m)
    ]
    raw += [b"", b"\xc1", b"\x91" * 5_000, b"\x00" * 10_000]
    with client(page) as socket:
        for _ in range(20):
            for message in raw:
                socket.send(message)
        socket.send("text")
    with client(page) as socket:  # another one: the first has used up what one client may send
        socket.send(msgspec.msgpack.encode(CAMERA))
        wait(lambda: page.server.get_clients(), "a good message after the bad ones was not heard")
        after = session.frame()
        np.testing.assert_array_equal(after.goal, before.goal)
        assert (session.planner, session.speed, session.policy) == (planner, speed, "noop")
        assert session.error is None and not session.playing
        assert page._play._impl.removed is False and page._sliders["horizon"].value == planner.horizon
        socket.send(
            msgspec.msgpack.encode({"type": "TransformControlsUpdateMessage", "name": "/goal"} | POSE)
        )
        wait(lambda: np.allclose(session.goal, POSE["position"]), "a dragged goal was not heard")
        socket.send(msgspec.msgpack.encode(update(page._sliders["horizon"], 4)))
        wait(lambda: session.planner.horizon == 4, "a slider was not heard")
    said = page.said  # pyright: ignore
    assert 1 <= len(said) <= 60, "one line a second, at most"
    assert all(line.startswith("ignored: ") and "\n" not in line and len(line) < 250 for line in said)


def test_a_message_that_is_too_large_ends_that_client_alone(page: Page) -> None:
    with client(page) as socket, pytest.raises(ConnectionClosed):
        socket.send(b"\x00" * 1_000_000)
        while True:
            socket.recv(timeout=10)
    with client(page) as socket:
        assert socket.recv(timeout=10)


def test_what_clients_held_that_have_left_is_freed(page: Page) -> None:
    gc.disable()
    try:
        for _ in range(2 * LEFT):
            with client(page) as socket:
                socket.recv(timeout=10)
        wait(lambda: page.gate._here == 0, "clients that have left are still counted")
        held = sum(type(one).__name__ == "ServerConnection" for one in gc.get_objects())
        assert held <= LEFT + 1, held
    finally:
        gc.enable()


def test_beyond_the_most_clients_a_page_says_so(page: Page, monkeypatch) -> None:
    monkeypatch.setattr("franka_wm.live.gate.CLIENTS", 1)
    quiet(page)
    with client(page) as socket:
        socket.recv(timeout=10)
        with pytest.raises(InvalidStatus, match="503"), client(page):
            pass
    assert page.said == ["ignored: a client beyond 1, the most at once"]  # pyright: ignore
    wait(lambda: page.gate._here == 0, "clients that have left are still counted")
    with client(page) as socket:
        assert socket.recv(timeout=10)


def test_another_version_is_turned_away_in_one_line(page: Page, capfd) -> None:
    quiet(page)
    address = f"ws://127.0.0.1:{page.port}"
    for _ in range(3):
        socket = connect(address, subprotocols=["viser-v0.0.1"])  # pyright: ignore
        with socket, pytest.raises(ConnectionClosed, match="reload the page"):
            socket.recv(timeout=10)
    assert page.said == ["ignored: a page of another version: 'viser-v0.0.1'"]  # pyright: ignore
    assert "mismatch" not in "".join(capfd.readouterr())


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "http://127.0.0.1", "http://localhost:{port}", "null", "http://127.0.0.1:1"],
)
def test_other_pages_are_turned_away(origin: str, page: Page) -> None:
    page.said.clear()  # pyright: ignore
    with pytest.raises(InvalidStatus, match="403"), client(page, Origin=origin.format(port=page.port)):
        pass
    with client(page, Origin=f"http://127.0.0.1:{page.port}") as socket:
        assert socket.recv(timeout=10)


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example", "10.0.0.1", "", "["]
)
def test_other_hosts_names_are_turned_away(host: str, page: Page) -> None:
    for name, status in (
        (host.format(port=page.port), 403),
        (f"127.0.0.1:{page.port}", 200),
        ("localhost:9", 200),
    ):
        connection = HTTPConnection("127.0.0.1", page.port, timeout=10)
        connection.request("GET", "/", headers={"Host": name})
        answer = connection.getresponse()
        assert answer.status == status, name
        said = answer.read().decode()
        assert status == 200 or f"machine: '{name}'." in said
        connection.close()


def test_a_browser_is_told_what_the_page_may_do(page: Page) -> None:
    """No page holds it in a frame, and a link cannot make it listen to another server."""
    connection = HTTPConnection("127.0.0.1", page.port, timeout=10)
    connection.request("GET", "/?websocket=ws://127.0.0.1:9")
    policy = connection.getresponse().headers["Content-Security-Policy"]
    assert policy == f"frame-ancestors 'none'; connect-src 'self' ws://127.0.0.1:{page.port} data: blob:"
    connection.close()


def test_who_connects_and_asks_nothing_is_not_told_of(page: Page, caplog, capfd, monkeypatch) -> None:
    """An editor that looks for open ports, for example: the library would print three tracebacks.

    viser leaves them out itself, and all other failures, once it has answered a request.
    """
    logger = logging.getLogger("websockets.server")
    ours = [one for one in logger.filters if getattr(one, "__module__", "").startswith("franka_wm")]
    monkeypatch.setattr(logger, "filters", ours)
    with caplog.at_level(logging.INFO, logger.name):
        socket.create_connection(("127.0.0.1", page.port)).close()
        time.sleep(1)
        assert not caplog.records and "Traceback" not in capfd.readouterr().err
        try:
            raise ValueError("of ours")
        except ValueError:
            logger.exception("opening handshake failed")
    assert [one.getMessage() for one in caplog.records] == ["opening handshake failed"]


def test_many_messages_at_once_are_cut_off() -> None:
    class Nothing:
        def get_all(self, name: str) -> list[str]:
            return []

    assert "another host" in (foreign(Nothing()) or "")
    said: list[str] = []
    gate = Gate(said.append)
    for _ in range(1000):
        gate.ignore("x")
    assert said == ["ignored: x"]
    assert decoded("text") is None and decoded(b"\xc1") is None
    assert len(short(["x" * 10_000])) == 100
    json.dumps(short("\x1b[2J\n"))
    assert "\n" not in short("\x1b[2J\n") and "\x1b" not in short("\x1b[2J\n")


def test_requests_do_not_pile_up(page: Page) -> None:
    quiet(page)
    done = []
    taken = [page._pending.acquire(blocking=False) for _ in range(PENDING)]
    assert all(taken)
    page._try(lambda: done.append(1))
    assert not done and "while 8 others wait" in page.said[0]  # pyright: ignore
    for _ in taken:
        page._pending.release()
    page._try(lambda: done.append(1))
    assert done == [1]


# -- the session's own bounds ------------------------------------------------------------------------------


@pytest.mark.parametrize("goal", [(1e300, 0, 0), (math.nan, 0, 0), (0, math.inf, 0), (0, 0), (6, 0, 0)])
def test_goals_out_of_bounds_are_refused_at_once(goal, make_session) -> None:
    session = make_session(policy="noop")
    before = session.goal
    for ask in (session.set_goal, session.ask_goal):
        with pytest.raises(UserError, match="must be three numbers, none beyond ±5 m"):
            ask(goal)
    np.testing.assert_array_equal(session.goal, before)


@pytest.mark.parametrize("speed", [0, -1, 1.5, math.nan, math.inf])
def test_speeds_out_of_bounds_are_refused(speed: float, make_session) -> None:
    session = make_session(policy="noop")
    with pytest.raises(UserError, match=r"must be from 0\.1 to 1"):
        session.speed = speed
    assert session.speed == 1.0


@pytest.mark.parametrize("values", [{"num_samples": 5_000_000}, {"horizon": 0}, {"temperature": math.nan}])
def test_settings_out_of_their_sliders_are_refused(values, make_session) -> None:
    session = make_session(policy="planner")
    before = session.planner
    with pytest.raises(UserError, match="must be from"):
        session.set_planner(**values)
    assert session.planner is before


def test_planning_has_a_budget(make_session, monkeypatch) -> None:
    session = make_session(policy="planner")
    monkeypatch.setattr("franka_wm.live.session.BUDGET", 10 * session._planning_time())
    with pytest.raises(UserError, match="a decision would take about"):
        session.set_planner(num_samples=2048, horizon=24, iterations=16)
    session.set_planner(num_samples=64)
    assert session.planner.num_samples == 64
    assert BUDGET == 1.0


def test_a_dragged_goal_is_judged_anew_while_paused(make_session) -> None:
    session = make_session(policy="noop")
    session.step()
    tool = session.frame().tool
    near = session.set_goal(tool)
    assert near.success and near.distance < 0.01
    away = session.set_goal((tool[0], tool[1], tool[2] + 0.3))
    assert not away.success and away.distance == pytest.approx(0.3, abs=0.01)


def wait(condition: Any, complaint: str, seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, complaint
        time.sleep(0.05)
