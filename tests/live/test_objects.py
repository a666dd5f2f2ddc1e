"""Objects that are dragged on the live page, and contacts that are shown there."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.errors import UserError
from franka_wm.live.session import Session
from franka_wm.policies.expert import ExpertPolicy
from franka_wm.policies.scripted import NoopPolicy
from presets import GRIPPER

STACK = GRIPPER | {"task": "stack", "episode_length": 1_000_000}
ELSEWHERE = (0.42, -0.12, 0.02)
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1], "fov": 0.8, "near": 0.01, "far": 1000, "image_height": 700, "image_width": 1000,
}  # fmt: skip
WEIGHT = 0.05 * 9.81


@pytest.fixture(scope="module")
def arm() -> FrankaEnv:
    return FrankaEnv(FrankaConfig(**STACK), num_envs=1, device="cpu", seed=0)


@pytest.fixture
def stacking(arm: FrankaEnv) -> Session:
    policies = {
        "expert": ExpertPolicy(arm.simulation.task, arm.kinematics, arm.config),
        "noop": NoopPolicy(arm.action_dim),
    }
    return Session(arm, policies, policy="noop", seed=3)


def rest(session: Session) -> np.ndarray:
    """Place and velocities of both cubes, (2, 13)."""
    return session.arm.simulation.tensors.objects.view(2, 13).numpy().copy()


def test_an_object_is_put_elsewhere_and_nothing_else_moves(stacking: Session) -> None:
    for _ in range(5):
        stacking.step()
    before, state = rest(stacking), stacking.arm.get_state()
    frame = stacking.move_object("cube", (0.42, -0.12, 0.4))
    after = rest(stacking)
    np.testing.assert_allclose(after[0, :3], (0.42, -0.12, 0.4), atol=1e-6)
    np.testing.assert_array_equal(after[0, 3:7], before[0, 3:7])
    assert not after[0, 7:].any()
    np.testing.assert_array_equal(after[1], before[1])
    assert torch.equal(stacking.arm.get_state()["joint_q"], state["joint_q"])
    row = stacking.arm.model.body_label.index("cube")
    np.testing.assert_allclose(frame.bodies[row, :3], (0.42, -0.12, 0.4), atol=1e-6)
    np.testing.assert_allclose(stacking._now["objects"][0, :3], (0.42, -0.12, 0.4), atol=1e-6)
    assert frame.episode == 0 and frame.steps == 5
    fallen = stacking.step()
    assert 0.38 < fallen.bodies[row, 2] < 0.4, "it falls from there, from rest"


def test_the_episode_goes_on_from_there(stacking: Session) -> None:
    stacking.set_policy("expert")
    for _ in range(12):
        stacking.step()
    stacking.move_object("cube", ELSEWHERE)
    stacking.move_object("base", (0.5, 0.15, 0.0))
    frames = [stacking.step() for _ in range(90)]
    assert frames[-1].success and frames[-1].episode == 0
    np.testing.assert_allclose(rest(stacking)[0, :3], (0.5, 0.15, 0.06), atol=0.015)


def test_it_is_put_onto_the_table_not_into_it(stacking: Session, arm: FrankaEnv) -> None:
    assert stacking.move_object("cube", (0.5, 0.1, -0.3)).bodies[-2, 2] == pytest.approx(0.02, abs=1e-4)
    state = arm.get_state()
    turned = torch.tensor([math.sin(math.pi / 8), 0.0, 0.0, math.cos(math.pi / 8)])  # on an edge
    state["rest_q"][0, 5:9] = turned
    arm.set_state(state)
    frame = stacking.move_object("cube", (0.5, 0.1, 0.0))
    assert frame.bodies[-2, 2] == pytest.approx(0.02 * math.sqrt(2), abs=1e-4)
    np.testing.assert_allclose(frame.bodies[-2, 3:], turned, atol=1e-6)


@pytest.mark.parametrize(
    "point", [(math.nan, 0, 0.1), (0.5, 0.8, 0.1), (0.5, 0, 3.0), (0.5, 0.1), (1e9, 0, 0)]
)
def test_points_beyond_the_table_are_refused_at_once(point, stacking: Session) -> None:
    before = rest(stacking)
    for ask in (stacking.move_object, stacking.ask_object):
        with pytest.raises(
            UserError, match=r"object cube to .*: must be three numbers over the table, x -0\.2"
        ):
            ask("cube", point)
    np.testing.assert_array_equal(rest(stacking), before)


def test_objects_that_are_not_there(stacking: Session, make_session) -> None:
    with pytest.raises(UserError, match="object 'ball': choose from cube, base"):
        stacking.move_object("ball", ELSEWHERE)
    with pytest.raises(UserError, match="none; this task has no objects"):
        make_session(policy="noop").ask_object("cube", ELSEWHERE)


def test_contacts_are_read_only_where_asked_for(stacking: Session, monkeypatch) -> None:
    monkeypatch.setattr("franka_wm.live.session.touching", lambda arm: pytest.fail("read"))
    assert stacking.step().contacts is None


def test_contacts_hold_the_weight_of_what_lies(stacking: Session) -> None:
    stacking.show_contacts = True
    frame = [stacking.step() for _ in range(20)][-1]
    assert frame.contacts is not None and frame.contacts.shape == (8, 7), "two cubes on four corners each"
    np.testing.assert_allclose(frame.contacts[:, 2], 0.0, atol=1e-3)
    np.testing.assert_allclose(np.abs(frame.contacts[:, 3:6]), [[0, 0, 1]] * 8, atol=1e-3)
    assert frame.contacts[:, 6].sum() == pytest.approx(2 * WEIGHT, rel=0.02)
    moved = stacking.move_object("cube", (0.42, -0.12, 0.3))
    assert moved.contacts is None, "those of the step before are no longer so"
    left = stacking.step().contacts
    assert left is not None and len(left) == 4, "what is in the air touches nothing"
    assert stacking.reset().contacts is None


# -- in a browser ------------------------------------------------------------------------------------------


@pytest.fixture
def page(stacking: Session) -> Iterator[Any]:
    pytest.importorskip("viser", reason="needs the extra view")
    from franka_wm.live.page import Page

    page = Page(stacking, port=0)
    page.said = []  # pyright: ignore
    page.gate._complain = page.said.append  # pyright: ignore
    yield page
    page.close()


def wait(condition: Callable[[], Any], complaint: str) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline, complaint
        time.sleep(0.02)


def test_a_browser_drags_an_object_while_paused_and_sees_contacts(page: Any, stacking: Session) -> None:
    import msgspec.msgpack
    import viser
    from websockets.sync.client import connect

    assert not page.scene._halo.visible, "a success that is no distance of the tool has no sphere"
    name = "/objects/cube"
    drag = {"type": "TransformControlsUpdateMessage", "name": name, "wxyz": [1.0, 0.0, 0.0, 0.0]}
    before = rest(stacking)
    protocol: Any = f"viser-v{viser.__version__}"
    with connect(f"ws://127.0.0.1:{page.port}", subprotocols=[protocol], max_size=None) as socket:

        def send(message: Any) -> None:
            socket.send(msgspec.msgpack.encode(message))

        send(CAMERA)  # whose controls are heard must have shown where it looks from
        for point in ([math.nan, 0, 0], [0.5, 0.9, 0.1], [0.5, 0, 9], [0.5, 0], "here"):
            assert not page.gate.admits(drag | {"position": point})
            send(drag | {"position": point})
        assert page.gate.admits(drag | {"position": list(ELSEWHERE)})
        send(drag | {"name": "/objects/ball", "position": ELSEWHERE})
        wait(lambda: page.said, "nothing was said of what is ignored")
        np.testing.assert_array_equal(rest(stacking), before)
        assert len(page.said) == 1 and page.said[0].startswith(
            "ignored: a message that the page does not send"
        )
        send({"type": "TransformControlsDragStartMessage", "name": name})
        send(drag | {"position": ELSEWHERE})
        wait(lambda: np.allclose(rest(stacking)[0, :3], ELSEWHERE, atol=1e-4), "a drag was not heard")
        send({"type": "TransformControlsDragEndMessage", "name": name})
        wait(lambda: not page.scene._dragged, "the end of a drag was not heard")
        handles = {handle.name: handle for handle in page.scene.objects.values()}
        stacking.move_object("base", (0.5, 0.15, 0.02))
        np.testing.assert_allclose(handles["/objects/base"].position, (0.5, 0.15, 0.02), atol=1e-4)
        assert not page.scene._touching
        for shown, nodes in ((True, 2), (False, 0)):
            control = page._contacts._impl.uuid
            send({"type": "GuiUpdateMessage", "uuid": control, "updates": {"value": shown}})
            wait(
                lambda nodes=nodes: stacking.step() and len(page.scene._touching) == nodes,
                f"contacts shown: {shown}",
            )
        send({"type": "TransformControlsDragStartMessage", "name": name})
        send(drag | {"position": ELSEWHERE})
        wait(lambda: page.scene._dragged, "a drag was not heard")
    wait(lambda: not page.scene._dragged, "who leaves while dragging lets go")
    assert stacking.error is None and not stacking.playing


def test_frames_of_several_threads_are_drawn_one_after_the_other(page: Any, stacking: Session) -> None:
    """Else one removes the nodes that the other has just made, and viser ends the session's thread."""
    stacking.show_contacts = True
    frame = stacking.step()
    assert frame.contacts is not None
    draw, drawing, most = page.scene.show, [], []

    def slowly(frame: Any) -> None:
        drawing.append(1)
        time.sleep(0.01)
        most.append(len(drawing))
        draw(frame)
        drawing.pop()

    page.scene.show = slowly
    threads = [threading.Thread(target=page.show, args=(frame,)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1] * 4
