"""An episode as a file for the Rerun viewer: the arm, its goal, the plan, and every number over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from franka_wm.errors import UserError
from franka_wm.files import atomic_write
from franka_wm.live.extras import import_rerun
from franka_wm.live.frame import Frame
from franka_wm.live.session import Session
from franka_wm.live.shapes import arm_shapes
from franka_wm.report.style import BLUE, VERMILION

GOAL, PATH, TRAIL = (213, 94, 0), (0, 114, 178), (150, 156, 166)


def record_episode(
    env: Any,
    policies: Mapping[str, Any],
    path: str | Path,
    *,
    policy: str | None = None,
    seed: int = 0,
    steps: int | None = None,
) -> Path:
    """Plays one episode and writes it; the file appears whole or not at all.

    Logged: ``arm/…`` (meshes and their motion), ``goal``, ``tool``, ``trail``, ``plan`` (the path that the plan
    commands, :func:`~franka_wm.live.commanded.commanded_path`), ``camera`` if the environment observes ``pixels``,
    and over time ``reward``, ``distance`` [m], ``decision`` [s] and ``joints/…`` [rad]. Timelines: ``step`` and
    ``time`` (simulated).

    Args:
        env: One world.
        policies: By name.
        path: Ends in .rrd; its folder is made.
        policy: Who acts; see :class:`~franka_wm.live.session.Session`.
        seed: Seed of the pose and the goal.
        steps: How many; the episode's length if not given. The recording ends with the episode, whose last step
            is not in it where the environment restarts by itself; a longer `episode_length` avoids that.

    Returns:
        ``path``.

    Raises:
        UserError: rerun is missing, no such policy, another ending, or the file cannot be written.
    """
    rr = import_rerun()
    path = Path(path)
    if path.suffix != ".rrd":
        raise UserError(f"{path}: a recording for Rerun must end in .rrd")
    session = Session(env, policies, policy=policy, seed=seed)
    steps = session.arm.config.episode_length if steps is None else steps
    with atomic_write(path) as temporary:
        stream = rr.RecordingStream("franka_wm")
        stream.save(
            str(temporary), default_blueprint=_layout(rr, "pixels" in session.arm.simulation.renderer.images)
        )
        _log_shapes(rr, stream, session)
        frame = session.frame()
        tools = [frame.tool]
        _log_frame(rr, stream, session, frame, tools)
        for _ in range(steps):
            frame = session.step()
            if frame.episode:  # the worlds have been reset: what is shown belongs to the next episode
                break
            tools.append(frame.tool)
            _log_frame(rr, stream, session, frame, tools)
        stream.flush()
        stream.disconnect()
    return path


def _layout(rr: Any, pixels: bool) -> Any:
    import rerun.blueprint as rrb

    images = [rrb.Spatial2DView(origin="camera", name="camera")] if pixels else []
    plots = [rrb.TimeSeriesView(origin=name, name=name) for name in ("distance", "reward", "joints")]
    arm = rrb.Spatial3DView(origin="/", name="arm")
    return rrb.Blueprint(
        rrb.Horizontal(arm, rrb.Vertical(*images, *plots), column_shares=[2, 1]), collapse_panels=True
    )


def _log_shapes(rr: Any, stream: Any, session: Session) -> None:
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for shape in arm_shapes(session.arm.model):
        name = f"{_link(shape.body)}/{shape.name}"
        w, x, y, z = (float(v) for v in shape.wxyz)
        stream.log(
            name,
            rr.Transform3D(translation=shape.position, quaternion=rr.Quaternion(xyzw=[x, y, z, w])),
            static=True,
        )
        mesh = rr.Mesh3D(
            vertex_positions=shape.vertices,
            triangle_indices=shape.faces,
            vertex_normals=shape.normals,
            albedo_factor=shape.colour,
        )
        stream.log(name, mesh, static=True)
    for name, colour in (("distance", VERMILION), ("reward", BLUE)):
        red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
        stream.log(name, rr.SeriesLines(colors=[red, green, blue], names=name), static=True)


def _log_frame(rr: Any, stream: Any, session: Session, frame: Frame, tools: list) -> None:
    stream.set_time("step", sequence=frame.steps)
    stream.set_time("time", duration=frame.steps / session.arm.config.fps)
    for body, pose in enumerate(frame.bodies):
        stream.log(_link(body), rr.Transform3D(translation=pose[:3], quaternion=rr.Quaternion(xyzw=pose[3:])))
    stream.log("goal", rr.Points3D([frame.goal], radii=0.02, colors=GOAL))
    stream.log("tool", rr.Points3D([frame.tool], radii=0.008, colors=PATH))
    stream.log("trail", rr.LineStrips3D([tools], radii=0.002, colors=TRAIL))
    paths = [] if frame.path is None else [frame.path]
    stream.log("plan", rr.LineStrips3D(paths, radii=0.004, colors=PATH))
    if "pixels" in session.arm.simulation.renderer.images:
        stream.log("camera", rr.Image(session.arm.simulation.renderer.images["pixels"][0].cpu().numpy()))
    for joint, angle in enumerate(session.arm.joint_positions()[0].tolist()):
        stream.log(f"joints/{joint + 1}", rr.Scalars(angle))
    stream.log("distance", rr.Scalars(frame.distance))
    if frame.stepped:
        stream.log("reward", rr.Scalars(frame.reward))
        stream.log("decision", rr.Scalars(frame.decision))


def _link(body: int) -> str:
    return "arm/base" if body < 0 else f"arm/link{body + 1}"
