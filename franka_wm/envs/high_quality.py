"""Recordings for people: USD stages and path-traced video.

What a model or a policy sees comes from :mod:`franka_wm.envs.camera` and never leaves the device. Here a frame
is copied to the host, once per :meth:`HighQualityRenderer.add`.
"""

from __future__ import annotations

import math
import os
import uuid
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import torch

from franka_wm.envs.camera_math import Vector, axes, camera_rotation, look_at_angles, point
from franka_wm.errors import UserError

if TYPE_CHECKING:
    import newton

    from franka_wm.envs.franka import FrankaEnv

NEEDS = {"warp": ("warp",), "rtx": ("ovrtx", "ovstage", "pyglet", "pxr"), "usd": ("pxr",)}
"""Modules that each way of rendering imports."""

ENVIRONMENTS = ("default", "studio", "none")

# environment -> (dome intensity, ((intensity, pitch, yaw) of each distant light, …)), angles in degrees.
_LIGHTS: dict[str, tuple[float, tuple[tuple[float, float, float], ...]]] = {
    "default": (300.0, ((2000.0, -45.0, 150.0),)),
    "studio": (600.0, ((1500.0, -40.0, 150.0), (700.0, -30.0, -140.0))),
    "none": (0.0, ()),
}

_SUFFIXES = (".usd", ".usda", ".usdc")

# A sensor 24 mm high, in USD's tenths of a scene unit. Only its ratio to the focal length is seen.
_VERTICAL_APERTURE = 24.0


def which_backends() -> dict[str, bool]:
    """Which ways of rendering this installation has; looks for the packages without importing them.

    Returns:
        ``{"warp": True, "rtx": …, "usd": …}``. That ``rtx`` is installed does not mean that this machine's
        GPU and driver can run it.
    """
    return {name: name == "warp" or not _missing(name) for name in NEEDS}


def _missing(backend: str) -> list[str]:
    return [module for module in NEEDS[backend] if find_spec(module) is None]


def _pxr(*names: str) -> tuple[Any, ...]:
    """Modules of the extra ``[usd]``. By name: a type checker may run without it, and they have no types."""
    return tuple(import_module(f"pxr.{name}") for name in names)


class HighQualityRenderer:
    """Records a simulation for people: as a USD stage, or as path-traced frames.

    ``backend="usd"`` writes one stage with the robot, a camera, lights, and a time sample of each for every
    :meth:`add`, for Omniverse, Blender, ``usdview`` and others. The file appears whole when the recording
    is closed, or not at all. ``backend="rtx"`` renders each frame with NVIDIA's path tracer through Newton's
    ``ViewerRTX``; that needs an RTX GPU and keeps the frames in :attr:`frames`.

    Args:
        model: The Newton model.
        backend: ``"usd"`` or ``"rtx"``.
        size: (width, height) [px]. For USD it decides the camera's aspect ratio alone.
        output_path: The stage to write, ``.usd``, ``.usda`` or ``.usdc``; replaced if it exists.
        environment: Light: ``"default"``, ``"studio"`` or ``"none"``.
        fps: Frames per second of the recording: :meth:`add` once per control step.
        up_axis: ``"X"``, ``"Y"`` or ``"Z"``. This package's models are Z up.
        fov_degrees: Vertical field of view [degrees].
        worlds: Which worlds are shown. World 0 alone by default: it stands where the simulation has it, which
            is what the camera framing fits. ``None`` shows all of them, several are laid out on a grid.
        passes: ``rtx`` only: renderings of each frame, the last of which is kept; the path tracer refines over
            time.

    Raises:
        UserError: If the backend is not installed (the message names the extra), or an option cannot be used.

    Example::

        with HighQualityRenderer(env.model, output_path="reach.usd") as renderer:
            renderer.look_at(*env.camera_framing)
            tensordict = env.reset()
            for _ in range(50):
                tensordict = env.step_and_maybe_reset(env.rand_action(tensordict))[1]
                renderer.add(env.simulation.newton_state)
    """

    def __init__(
        self,
        model: newton.Model,
        backend: Literal["usd", "rtx"] = "usd",
        size: tuple[int, int] = (1280, 720),
        output_path: str | Path = "franka.usd",
        environment: str = "default",
        fps: float = 30.0,
        up_axis: str = "Z",
        *,
        fov_degrees: float = 60.0,
        worlds: Sequence[int] | None = (0,),
        passes: int = 16,
    ):
        if backend not in ("usd", "rtx"):
            raise UserError(f"backend={backend!r}: must be usd or rtx")
        if environment not in ENVIRONMENTS:
            raise UserError(f"environment={environment!r}: must be one of {', '.join(ENVIRONMENTS)}")
        if len(size) != 2 or not all(isinstance(s, int) and s >= 1 for s in size):
            raise UserError(f"size={size}: give (width, height), whole numbers of pixels of at least 1")
        if not (math.isfinite(fps) and fps > 0):
            raise UserError(f"fps={fps}: must be above 0")
        if not 0 < fov_degrees < 180:
            raise UserError(f"fov_degrees={fov_degrees}: must be between 0 and 180")
        if passes < 1:
            raise UserError(f"passes={passes}: must be at least 1")
        axes(up_axis)
        if worlds is not None:
            wrong = [w for w in worlds if not 0 <= w < model.world_count]
            if wrong or not worlds:
                raise UserError(
                    f"worlds={tuple(worlds)}: choose from 0 to {model.world_count - 1}, or None for all"
                )
        missing = _missing(backend)
        if missing:
            raise UserError(
                f"backend={backend!r} needs {', '.join(missing)}, which is not installed: "
                f"pip install 'franka-wm[{backend}]'"
            )
        self.backend = backend
        self.size = size
        self.fps = float(fps)
        self.environment = environment
        self.up_axis = up_axis.upper()
        self.fov_degrees = float(fov_degrees)
        self.num_frames = 0
        self._passes = passes
        self._position, self._pitch, self._yaw = np.array([1.0, 0.0, 0.5]), 0.0, 180.0
        self._closed = False
        self._images: list[torch.Tensor] = []
        if backend == "usd":
            self.output_path = _usd_target(output_path)
            # In the same folder, so that the rename is atomic; its own name, so that no cached layer is reused.
            self._partial = self.output_path.with_name(
                f".{self.output_path.stem}.{uuid.uuid4().hex[:8]}{self.output_path.suffix}"
            )
            self._viewer = self._open_usd()
        else:
            self.output_path = None
            self._partial = None
            self._viewer = self._open_rtx()
        self._viewer.set_model(model)
        if worlds is not None:
            self._viewer.set_visible_worlds(list(worlds))
        if backend == "usd":
            self._camera = self._add_usd_camera()
            self._add_usd_lights()
        else:
            self._viewer.camera.fov = self.fov_degrees

    # -- what a user calls --------------------------------------------------------------------------------

    def set_camera(self, position: Vector, pitch: float, yaw: float) -> None:
        """Where the camera is from the next frame on.

        Args:
            position: In the world [m].
            pitch, yaw: [degrees], as :func:`look_at_angles` returns them. ``rtx`` clamps pitch to ±89°.
        """
        if not (math.isfinite(pitch) and math.isfinite(yaw)):
            raise UserError(f"pitch={pitch}, yaw={yaw}: must be finite, in degrees")
        self._position = point("position", position)
        self._pitch, self._yaw = float(pitch), float(yaw)

    def look_at(self, eye: Vector, target: Vector) -> None:
        """Puts the camera at ``eye``, looking at ``target``; world points [m]."""
        self.set_camera(eye, *look_at_angles(eye, target, self.up_axis))

    def add(self, state: newton.State) -> None:
        """Records ``state`` as the next frame; copies it to the host.

        Raises:
            UserError: If the recording is closed, or the path tracer cannot start on this machine.
        """
        if self._closed:
            raise UserError("this recording is closed; start another HighQualityRenderer")
        if self.backend == "usd":
            self._log(state)
            self._write_usd_camera(self.num_frames)
        else:
            self._images.append(self._trace(state))
        self.num_frames += 1

    @property
    def frames(self) -> torch.Tensor:
        """The ``rtx`` frames so far, (T, 3, H, W) uint8 on the CPU."""
        if self.backend != "rtx":
            raise UserError(
                "backend='usd' has no frames: it writes a file; use backend='rtx', or env.render()"
            )
        if not self._images:
            return torch.zeros((0, 3, self.size[1], self.size[0]), dtype=torch.uint8)
        return torch.stack(self._images)

    def close(self) -> Path | None:
        """Ends the recording; again does nothing more.

        Returns:
            The path of the stage, or ``None`` for ``rtx``.

        Raises:
            UserError: If no frame was added (nothing is left behind), or the file cannot be written.
        """
        if self._closed:
            return self.output_path
        if self.num_frames == 0:
            self._discard()
            raise UserError("nothing was recorded: call add(state) at least once before close()")
        if self.backend == "usd":
            self._publish_usd()
        else:
            self._viewer.close()
        self._closed = True
        return self.output_path

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._closed:
            return
        if kind is None:
            self.close()
        else:  # half a recording would pass for a whole one
            self._discard()

    # -- both ---------------------------------------------------------------------------------------------

    def _log(self, state: newton.State) -> None:
        self._viewer.begin_frame(self.num_frames / self.fps)
        self._viewer.log_state(state)
        self._viewer.end_frame()

    def _discard(self) -> None:
        self._closed = True
        if self._partial is None:
            self._viewer.close()
            return
        self._viewer.stage = None
        self._partial.unlink(missing_ok=True)

    # -- USD ----------------------------------------------------------------------------------------------

    def _open_usd(self) -> Any:
        from newton.viewer import ViewerUSD

        # num_frames=None: the viewer's default would end the recording at 100 frames, without a word.
        return ViewerUSD(str(self._partial), fps=self.fps, up_axis=self.up_axis, num_frames=None)  # type: ignore[arg-type]

    def _add_usd_camera(self) -> Any:
        Gf, UsdGeom = _pxr("Gf", "UsdGeom")

        stage = self._viewer.stage
        camera = UsdGeom.Camera.Define(stage, stage.GetDefaultPrim().GetPath().AppendChild("camera"))
        camera.CreateVerticalApertureAttr(_VERTICAL_APERTURE)
        camera.CreateHorizontalApertureAttr(_VERTICAL_APERTURE * self.size[0] / self.size[1])
        camera.CreateFocalLengthAttr(
            0.5 * _VERTICAL_APERTURE / math.tan(0.5 * math.radians(self.fov_degrees))
        )
        camera.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000.0))
        return camera.AddTransformOp()

    def _write_usd_camera(self, frame: int) -> None:
        """The pose at every frame: between sparse samples USD would glide from one to the next."""
        (Gf,) = _pxr("Gf")

        pose = np.eye(4)  # row vectors, as USD has it
        pose[:3, :3] = camera_rotation(self._pitch, self._yaw, self.up_axis)
        pose[3, :3] = self._position
        self._camera.Set(Gf.Matrix4d(*pose.flatten().tolist()), frame)

    def _add_usd_lights(self) -> None:
        Gf, UsdLux = _pxr("Gf", "UsdLux")

        stage = self._viewer.stage
        root = stage.GetDefaultPrim().GetPath()
        dome, distant = _LIGHTS[self.environment]
        if dome:
            UsdLux.DomeLight.Define(stage, root.AppendChild("sky")).CreateIntensityAttr(dome)
        for index, (intensity, pitch, yaw) in enumerate(distant):
            light = UsdLux.DistantLight.Define(stage, root.AppendChild(f"light_{index}"))
            light.CreateIntensityAttr(intensity)
            light.CreateAngleAttr(1.0)  # [degrees] soft edges of shadows
            pose = np.eye(4)
            pose[:3, :3] = camera_rotation(pitch, yaw, self.up_axis)
            light.AddTransformOp().Set(Gf.Matrix4d(*pose.flatten().tolist()))

    def _publish_usd(self) -> None:
        Sdf, Tf = _pxr("Sdf", "Tf")

        assert self._partial is not None and self.output_path is not None
        stage = self._viewer.stage
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(self.num_frames - 1)
        try:
            saved = stage.GetRootLayer().Save()
        except Tf.ErrorException:
            saved = False
        del stage
        self._viewer.stage = None  # not its close(), which saves again and logs the temporary name
        if not saved or not self._partial.is_file():
            self._discard()
            raise UserError(f"{self.output_path}: could not be written; is the disk full?")
        os.replace(self._partial, self.output_path)
        # Whoever in this process still holds the file that was there before would go on seeing it.
        layer = Sdf.Layer.Find(str(self.output_path))
        if layer is not None:
            layer.Reload(True)

    # -- RTX ----------------------------------------------------------------------------------------------

    def _open_rtx(self) -> Any:
        from newton.viewer import ViewerRTX

        width, height = self.size
        try:
            return ViewerRTX(
                width=width,
                height=height,
                headless=True,
                fps=self.fps,  # type: ignore[arg-type]
                up_axis=self.up_axis,  # type: ignore[arg-type]
                environment=self.environment,  # type: ignore[arg-type]
                # Each frame is read back before the next: nothing to overlap, and no frame lags.
                async_rendering=False,
            )
        except ImportError as error:  # installed, but its libraries do not load
            raise UserError(
                f"backend='rtx': {error}; pip install --force-reinstall 'franka-wm[rtx]', or use backend='usd'"
            ) from error

    def _trace(self, state: newton.State) -> torch.Tensor:
        self._viewer.set_camera(tuple(self._position.tolist()), self._pitch, self._yaw)
        try:
            for _ in range(self._passes):
                self._log(state)
            image = self._viewer.get_frame().numpy()
        except RuntimeError as error:
            raise UserError(
                f"backend='rtx' could not render ({error}); it needs an NVIDIA RTX GPU and a recent driver; "
                "use backend='usd' and render the stage elsewhere"
            ) from error
        return torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).contiguous()


def _usd_target(path: str | Path) -> Path:
    """The absolute path of the stage, in a folder that exists and can be written."""
    target = Path(path).expanduser().absolute()
    if target.suffix.lower() not in _SUFFIXES:
        raise UserError(f"output_path={path}: must end in {', '.join(_SUFFIXES)}")
    if target.is_dir():
        raise UserError(f"output_path={path}: is a folder; give a file name")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"output_path={path}: {error.strerror or error} ({target.parent})") from error
    if not os.access(target.parent, os.W_OK):
        raise UserError(f"output_path={path}: {target.parent} is not writable")
    return target


def high_quality_renderer(env: FrankaEnv, **options: Any) -> HighQualityRenderer:
    """A :class:`HighQualityRenderer` of ``env``, framed and timed as its own camera.

    Args:
        env: The environment.
        **options: Of :class:`HighQualityRenderer`; ``fps`` and ``fov_degrees`` come from the environment's
            config where they are not given.
    """
    options = {"fps": env.config.fps, "fov_degrees": env.config.camera_fov_degrees} | options
    renderer = HighQualityRenderer(env.model, **options)
    renderer.look_at(*env.camera_framing)
    return renderer
