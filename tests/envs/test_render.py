"""Pictures for people: filters, angles, and recordings that other programs can open."""

import math
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from franka_wm.envs import FrankaConfig, FrankaEnv, high_quality
from franka_wm.envs.camera import look_at as camera_pose
from franka_wm.envs.camera_math import look_at_angles, supersample
from franka_wm.envs.high_quality import HighQualityRenderer, high_quality_renderer, which_backends
from franka_wm.errors import UserError

CONFIG = FrankaConfig(observations=("state",), substeps=4, gravity_compensation=True)
needs_usd = pytest.mark.skipif(find_spec("pxr") is None, reason="needs the extra [usd]")


@pytest.fixture(scope="module")
def env() -> FrankaEnv:
    return FrankaEnv(CONFIG, num_envs=2, device="cpu")


# -- supersample, look_at_angles, which_backends --------------------------------------------------------------


def test_supersample_averages_blocks() -> None:
    frame = torch.arange(3 * 4 * 6, dtype=torch.float32).view(3, 4, 6)
    small = supersample(frame, 2)
    assert small.shape == (3, 2, 3)
    assert small[1, 1, 2] == frame[1, 2:4, 4:6].mean()
    assert torch.equal(supersample(frame, 1), frame)
    checkers = torch.tensor([[0, 255], [255, 0]], dtype=torch.uint8).repeat(3, 2, 2)
    assert supersample(checkers, 2).unique().tolist() == [128]
    batch = torch.rand(5, 3, 4, 4)
    assert torch.equal(supersample(batch, 2)[3], supersample(batch[3], 2))


@pytest.mark.parametrize(("shape", "factor"), [((3, 4, 5), 2), ((4, 4), 2), ((3, 4, 4), 0), ((3, 4, 4), 1.5)])
def test_supersample_refuses_what_does_not_divide(shape: tuple[int, ...], factor: int) -> None:
    with pytest.raises(UserError):
        supersample(torch.zeros(shape), factor)


@pytest.mark.parametrize(
    ("target", "up_axis", "expected"),
    [
        ((1, 0, 0), "Z", (0, 0)),
        ((0, 2, 0), "Z", (0, 90)),
        ((-1, 0, -1), "Z", (-45, 180)),
        ((0, 0, 3), "Z", (90, 0)),
        ((0, 0, -3), "Z", (-90, 0)),
        ((1, 1, 0), "Y", (45, 0)),
        ((0, 0, 1), "Y", (0, 90)),
        ((-1, 1, 0), "x", (-45, 0)),
        ((0, 0, 1), "X", (0, 90)),
    ],
)
def test_angles(target: tuple, up_axis: str, expected: tuple) -> None:
    eye = np.array([5.0, -2.0, 1.0])
    assert look_at_angles(eye, eye + np.array(target), up_axis) == pytest.approx(expected, abs=1e-6)


def test_angles_agree_with_newtons_camera() -> None:
    """The path tracer turns them into a direction by Newton's own convention."""
    pytest.importorskip("pyglet")
    from newton._src.viewer.camera import Camera

    for up_axis in "XYZ":
        camera = Camera(up_axis=up_axis)
        direction = np.array([-0.3, 0.5, -0.2])
        camera.pitch, camera.yaw = look_at_angles((0, 0, 0), direction, up_axis)
        assert np.allclose(camera.get_front(), direction / np.linalg.norm(direction), atol=1e-6)


@pytest.mark.parametrize(
    ("eye", "target", "up_axis"),
    [((1, 2, 3), (1, 2, 3), "Z"), ((0, 0, 0), (1, 0, 0), "W"), ((0, 0), (1, 0, 0), "Z")],
)
def test_angles_of_nothing_are_an_error(eye: tuple, target: tuple, up_axis: str) -> None:
    with pytest.raises(UserError):
        look_at_angles(eye, target, up_axis)


def test_backends_are_looked_for_without_importing_them() -> None:
    before = set(sys.modules)
    found = which_backends()
    assert set(found) == {"warp", "rtx", "usd"}
    assert found["warp"] is True
    assert set(sys.modules) == before


def test_backends_follow_what_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(high_quality, "find_spec", lambda name: None if name == "ovrtx" else object())
    assert which_backends() == {"warp": True, "rtx": False, "usd": True}


@pytest.mark.parametrize("backend", ["usd", "rtx"])
def test_a_missing_backend_names_its_extra(
    backend: Any, env: FrankaEnv, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(high_quality, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=rf"pip install 'franka-wm\[{backend}\]'") as error:
        HighQualityRenderer(env.model, backend=backend, output_path=tmp_path / "a.usd")
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


# -- USD --------------------------------------------------------------------------------------------------------


def open_stage(path: Path) -> Any:
    from pxr import Usd

    stage = Usd.Stage.Open(str(path))
    assert stage
    return stage


def instance_positions(stage: Any, frame: float) -> dict[str, np.ndarray]:
    """Where every visible shape is at a frame, by path."""
    from pxr import Usd, UsdGeom

    cache = UsdGeom.XformCache(Usd.TimeCode(frame))
    out = {}
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not prim.IsA(UsdGeom.Gprim) or prim.GetParent().IsA(UsdGeom.PointInstancer):
            continue  # what a point instancer repeats is not drawn where it is defined
        if UsdGeom.Imageable(prim).ComputeVisibility(frame) != UsdGeom.Tokens.invisible:
            out[str(prim.GetPath())] = np.array(cache.GetLocalToWorldTransform(prim).ExtractTranslation())
    return out


@needs_usd
def test_a_recording_has_all_its_frames_and_nothing_is_there_before_it_is_whole(
    env: FrankaEnv, tmp_path: Path
) -> None:
    frames = 104  # more than the 100 at which Newton's viewer stops unless told otherwise
    path = tmp_path / "new" / "reach.usdc"
    env.reset(seed=0)
    state = env.simulation.newton_state
    tools = []
    with high_quality_renderer(env, output_path=path) as renderer:
        for frame in range(frames):
            if frame % 20 == 0:  # a servo step for some frames is enough to see the robot move
                env._step(env.rand_action())
            tools.append(env.tool_position()[0].numpy())
            renderer.add(state)
        assert not path.exists()
    assert renderer.close() == path
    assert [p.name for p in path.parent.iterdir()] == ["reach.usdc"]

    stage = open_stage(path)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, frames - 1)
    assert stage.GetTimeCodesPerSecond() == CONFIG.fps
    # The robot is there and moves: some shape follows the tool from the first frame to the last.
    first, last = instance_positions(stage, 0), instance_positions(stage, frames - 1)
    assert len(first) > 10
    moved = {name: last[name] - first[name] for name in first}
    assert max(np.linalg.norm(move) for move in moved.values()) > 0.02
    nearest = min(first, key=lambda name: float(np.linalg.norm(first[name] - tools[0])))
    assert np.linalg.norm(first[nearest] - tools[0]) < 0.12
    assert np.linalg.norm(last[nearest] - tools[-1]) < 0.12
    # Every frame has a sample of its own, the last ones too.
    samples = {
        time
        for prim in stage.Traverse()
        for attribute in prim.GetAttributes()
        for time in attribute.GetTimeSamples()
    }
    assert samples == {float(t) for t in range(frames)}


@needs_usd
@pytest.mark.parametrize(
    "framing", [None, ((0.3, -0.7, 1.5), (0.1, 0.2, 0.3)), ((0.0, 0.0, 2.0), (0.0, 0.0, 0.0))]
)
def test_the_camera_sees_what_ours_sees(env: FrankaEnv, tmp_path: Path, framing: tuple | None) -> None:
    from pxr import UsdGeom

    path = tmp_path / "camera.usda"
    with high_quality_renderer(env, output_path=path, size=(640, 480)) as renderer:
        if framing is not None:
            renderer.look_at(*framing)
        renderer.add(env.simulation.newton_state)
    stage = open_stage(path)
    (camera,) = [UsdGeom.Camera(p) for p in stage.Traverse() if p.IsA(UsdGeom.Camera)]
    optics = camera.GetCamera(0)
    assert optics.GetFieldOfView(optics.FOVVertical) == pytest.approx(CONFIG.camera_fov_degrees, abs=1e-3)
    assert optics.aspectRatio == pytest.approx(640 / 480)
    matrix = np.array(camera.ComputeLocalToWorldTransform(0))  # row vectors
    eye, target = framing or env.camera_framing
    pose = camera_pose(eye, target)
    assert np.allclose(matrix[3, :3], eye)
    rotation = np.array(wp.quat_to_matrix(pose.q)).reshape(3, 3).T
    if (eye[0], eye[1]) == (target[0], target[1]):  # straight down: any turn about the view will do
        assert np.allclose(matrix[2, :3], rotation[2], atol=1e-6)
        assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
    else:
        assert np.allclose(matrix[:3, :3], rotation, atol=1e-6)


@needs_usd
def test_a_camera_that_moves_cuts_and_does_not_glide(env: FrankaEnv, tmp_path: Path) -> None:
    from pxr import UsdGeom

    path = tmp_path / "cut.usdc"
    with HighQualityRenderer(env.model, output_path=path) as renderer:
        for frame in range(6):
            renderer.set_camera((2.0 if frame < 4 else -2.0, 0, 0), 0, 180 if frame < 4 else 0)
            renderer.add(env.simulation.newton_state)
    stage = open_stage(path)
    (camera,) = [UsdGeom.Camera(p) for p in stage.Traverse() if p.IsA(UsdGeom.Camera)]
    where = [camera.ComputeLocalToWorldTransform(t).ExtractTranslation()[0] for t in range(6)]
    assert where == pytest.approx([2, 2, 2, 2, -2, -2])


@needs_usd
def test_world_0_alone_unless_all_are_asked_for(env: FrankaEnv, tmp_path: Path) -> None:
    env.reset(seed=0)
    counts, spread = [], []
    for worlds in ((0,), None):
        path = tmp_path / f"{worlds is None}.usdc"
        with HighQualityRenderer(env.model, output_path=path, worlds=worlds) as renderer:
            renderer.add(env.simulation.newton_state)
        positions = instance_positions(open_stage(path), 0)
        counts.append(len(positions))
        spread.append(max(math.hypot(p[0], p[1]) for p in positions.values()))
    assert counts[1] == 2 * counts[0] - 1, "two robots, one ground"
    assert spread[0] < 1.0, "world 0 stands where it is simulated"


@needs_usd
def test_an_empty_recording_is_an_error_and_leaves_nothing(env: FrankaEnv, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nothing was recorded"):
        HighQualityRenderer(env.model, output_path=tmp_path / "a.usd").close()
    assert not list(tmp_path.iterdir())


@needs_usd
def test_a_failure_leaves_the_old_file_alone(env: FrankaEnv, tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    path.write_text("#usda 1.0\n")
    with (
        pytest.raises(RuntimeError, match="mine"),
        HighQualityRenderer(env.model, output_path=path) as renderer,
    ):
        renderer.add(env.simulation.newton_state)
        raise RuntimeError("mine")
    assert path.read_text() == "#usda 1.0\n"
    assert [p.name for p in tmp_path.iterdir()] == ["a.usda"]
    with pytest.raises(UserError, match="closed"):
        renderer.add(env.simulation.newton_state)


@needs_usd
def test_recording_twice_to_one_path_shows_the_second(env: FrankaEnv, tmp_path: Path) -> None:
    path = tmp_path / "a.usdc"
    stages = []
    for frames in (2, 5):
        with HighQualityRenderer(env.model, output_path=path) as renderer:
            for _ in range(frames):
                renderer.add(env.simulation.newton_state)
        stages.append(open_stage(path))  # kept open, as a viewer in the same process would
        assert stages[-1].GetEndTimeCode() == frames - 1


@needs_usd
@pytest.mark.parametrize(
    "options",
    [
        {"output_path": "a.mp4"},
        {"output_path": "."},
        {"environment": "moon"},
        {"size": (0, 4)},
        {"fps": 0},
        {"worlds": (2,)},
        {"backend": "gl"},
        {"up_axis": "Q"},
    ],
)
def test_bad_options_are_one_line(
    options: dict, env: FrankaEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as error:
        HighQualityRenderer(env.model, **options)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


# -- RTX: what can be said without the card --------------------------------------------------------------------


class FakeRTX:
    """Stands in for Newton's viewer: remembers what it was asked, paints the frame's number."""

    made: "list[FakeRTX]" = []

    def __init__(self, *, width: int, height: int, headless: bool, async_rendering: bool, **_: Any):
        assert headless
        assert not async_rendering, "asynchronous frames lag by one"
        self.size, self.camera, self.log, self.closed = (height, width), SimpleNamespace(fov=45.0), [], 0
        FakeRTX.made.append(self)

    def set_model(self, model: Any) -> None:
        self.model = model

    def set_visible_worlds(self, worlds: list[int]) -> None:
        self.worlds = worlds

    def set_camera(self, pos: tuple, pitch: float, yaw: float) -> None:
        self.pose = (pos, pitch, yaw)

    def begin_frame(self, time: float) -> None:
        self.log.append(time)

    def log_state(self, state: Any) -> None: ...
    def end_frame(self) -> None: ...

    def get_frame(self) -> Any:
        picture = np.zeros((*self.size, 3), np.uint8)
        picture[0, :, 1] = len(self.log)
        return wp.array(picture, dtype=wp.uint8, device="cpu")

    def close(self) -> None:
        self.closed += 1


def fake_rtx(monkeypatch: pytest.MonkeyPatch, viewer: type) -> None:
    import newton.viewer

    monkeypatch.setattr(high_quality, "find_spec", lambda name: object())
    monkeypatch.setattr(newton.viewer, "ViewerRTX", viewer)


def test_rtx_collects_frames_channels_first(env: FrankaEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_rtx(monkeypatch, FakeRTX)
    with high_quality_renderer(env, backend="rtx", size=(8, 6), passes=3) as renderer:
        for _ in range(2):
            renderer.add(env.simulation.newton_state)
    viewer = FakeRTX.made[-1]
    assert renderer.frames.shape == (2, 3, 6, 8)
    assert renderer.frames[:, 1, 0, 0].tolist() == [3, 6], "the last pass of each frame is kept"
    assert viewer.log == pytest.approx([0, 0, 0, 1 / 30, 1 / 30, 1 / 30])
    assert viewer.camera.fov == CONFIG.camera_fov_degrees
    assert viewer.worlds == [0]
    assert viewer.closed == 1
    assert viewer.pose[1:] == pytest.approx(look_at_angles(*env.camera_framing))
    assert renderer.close() is None


def test_rtx_that_cannot_start_says_what_it_needs(env: FrankaEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(FakeRTX):
        def end_frame(self) -> None:
            raise RuntimeError("Failed to create OVRTX renderer: no device")

    fake_rtx(monkeypatch, Broken)
    with (
        pytest.raises(UserError, match="RTX GPU"),
        HighQualityRenderer(env.model, backend="rtx") as renderer,
    ):
        renderer.add(env.simulation.newton_state)
    assert FakeRTX.made[-1].closed == 1
