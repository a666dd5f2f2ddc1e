"""What a Franka environment is made of: one frozen, validated dataclass."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

from franka_wm.envs.constants import HAND_DIM, HOME, JOINT_DIM, NUM_FINGERS, NUM_JOINTS, OBJECT_DIM, STATE_DIM
from franka_wm.envs.ranges import Randomization
from franka_wm.envs.scene import Scene
from franka_wm.errors import UserError
from franka_wm.options import OF_ONES_OWN, ROBOT_OF_ONES_OWN, check_whole, is_real

if TYPE_CHECKING:
    from franka_wm.envs.tasks import Task

OBSERVATIONS = (
    *("pixels", "depth", "segmentation", "goal_pixels"),
    *("state", "joint_target", "objects", "contacts"),
)
"""Observation groups that can be asked for; ``goal`` is always emitted."""

IMAGES = ("pixels", "depth", "segmentation", "goal_pixels")
CAMERAS = ("front", "side", "wrist")
ACTION_MODES = {"joint_delta": 7, "joint_position": 7, "ee_delta": 3}
"""Meaning of an action, and its size."""

MAX_IMAGE_SIZE = 2048


@dataclass(frozen=True, kw_only=True)
class FrankaConfig:
    """Everything that defines the simulated arm and its task. Frozen; each field is validated.

    The defaults are those of a plain, stiff, not gravity-compensated servo at 30 Hz, kept because results
    published with them can be compared. The Hydra presets in ``conf/env`` choose faster and more faithful
    values and say why.

    Attributes:
        image_size: Side of the square ``pixels`` observation [px].
        action_scale: Change of the joint targets per unit of action [rad]; for ``"ee_delta"`` a joint's largest.
        fps: Control rate [Hz].
        substeps: Physics steps per control step.
        joint_armature: Rotor inertia added to every joint [kg·m²].
        target_ke: Stiffness of the position servo [N·m/rad].
        target_kd: Damping of the position servo [N·m·s/rad].
        pose_noise: Half-width of the uniform noise on the initial joint angles [rad].
        goal: Reach target in the world frame [m]; the fixed goal, and the one shown before sampling.
        action_penalty: Weight of the mean squared action in the reward.
        camera_distance: The eye's x [m].
        camera_height: The eye's z [m].
        camera_target_height, camera_target_distance: The camera looks at (distance, 0, height) [m].
        camera_fov_degrees: Vertical field of view [degrees].
        enable_shadows: Cast shadows in ``pixels`` (about half the rendering speed).
        enable_textures: Use mesh textures where the robot has them.
        mesh_detail: Details of meshes smaller than this are not drawn [m], nor shapes (middle times longest side) of
            less than half its square; 0 draws every triangle. ``None``: a pixel
            and a half at the distance that the fixed cameras look at, at most 3 cm; 8 mm where no images are
            observed, or the wrist camera's are. ``robot="panda_meshes_full"`` always draws every triangle.
        solver: ``"mujoco"``, ``"featherstone"``, or ``"auto"``, which is ``"mujoco"`` on every device.
        asset_name: Newton's downloadable asset, for ``robot="newton_asset"``.
        urdf_relative_path: URDF inside that asset.
        robot: ``"embedded"`` (ships with the package), ``"newton_asset"`` (downloaded), ``"panda_meshes"``
            or ``"panda_meshes_full"`` (extra ``meshes``), ``"urdf"`` (give ``urdf_path`` to the environment), or
            one of your own (``docs/robots.md``).
        action_mode: ``"joint_delta"`` (change of the joint targets, × ``action_scale``), ``"joint_position"``
            (the targets themselves, −1 and 1 at the joint limits) or ``"ee_delta"`` (tool displacement in the
            world, × ``ee_scale``, through differential inverse kinematics).
        ee_scale: Tool displacement per unit of action, for ``"ee_delta"`` [m], as far as ``action_scale`` allows.
        task: What is asked of the arm; ``docs/tasks.md`` lists the tasks. It also says which scene, gripper and home
            pose there are, where the config does not.
        task_options: Options that the task brings itself, ``option_defaults`` of its class, by name. Those left out
            have their defaults once the config is made.
        gripper: Drive both fingers by one command: one more action, −1 closed and 1 open. ``None``: if the task
            needs it.
        gripper_force: Largest force of each finger [N]; the Franka Hand's is 70 continuously.
        scene: What stands around the arm: :class:`~franka_wm.envs.scene.Scene`, or the same as a mapping. ``None``:
            the task's. With objects or obstacles there are contacts; they need the gripper.
        collisions: What of the robot touches the scene: ``"hand"`` (fingers and palm), ``"arm"`` (all links) or
            ``"self"`` (all links, and these one another, but not those next to each other).
        collision_pipeline: Who finds contacts: ``"mujoco"``, or ``"newton"``, Newton's own ``CollisionPipeline``.
            Their forces are MuJoCo's either way.
        max_contacts: Contacts for which there is room in each world, on average. ``None``: by the scene.
        end_when_lost: End the episode where an object has left the table.
        drawer_opening: ``task="drawer"`` is solved where the drawer is open so far [m]. ``None``: 90 % of its travel.
        disc_radius, disc_spread: Radius of push's disc, and how much nearer or farther than 20 cm it may be [m].
        home: Joint angles at the start, before noise [rad]. ``None``: the task's.
        reward: ``"dense"`` (−tanh distance), ``"sparse"`` (1 where solved, else 0) or ``"normalized"`` (the part
            of the episode's initial distance that has been closed, at least −1); all minus the action penalty.
        track_radius, track_period: Radius of the circle [m] and time of one turn [s], for ``task="track"``.
        cameras: Which of ``("front", "side", "wrist")`` the image observations come from. The first one's keys
            are ``pixels``, ``depth``, …; another's ``pixels_wrist``, …. ``side`` is ``front`` a quarter turn
            around the base's vertical axis: it sees the depth that the front camera cannot.
        frame_stack: Images in ``pixels`` and ``pixels_…``, oldest first along the channels: the present one
            and those of the steps before it. An episode begins with copies of its first.
        show_goal: Draw the goal in every image: a small red ball, blue where there are objects; a disc for push.
        randomization: Ranges that each episode of each world draws from; :class:`Randomization`.
        finger_opening: Each finger's distance from the closed position [m]; without a gripper it is held there.
        observations: Which of ``("pixels", "depth", "segmentation", "goal_pixels", "state", "joint_target",
            "objects", "contacts")`` are emitted. ``goal`` always is.
        episode_length: Control steps after which an episode is truncated.
        goal_sampling: ``"fixed"`` (``goal``) or ``"reachable"`` (the tool position of a random pose, drawn per world
            and episode). Tasks with a gripper draw their own goals per world and episode: they refuse ``"fixed"``,
            ``goal`` and ``goal_noise``. ``None``: as the task does, ``"fixed"`` for ``reach`` and ``track``.
        goal_noise: For ``goal_sampling="reachable"``: half-width of the uniform noise around the home pose
            from which the goal pose is drawn [rad].
        success_distance: The task is solved where the tool is closer to the goal than this [m].
        terminate_on_success: End the episode at the first success.
        gravity_compensation: Cancel gravity's load on the arm, as the real robot's controller does.
        limit_velocity: Keep the servo from driving a joint faster than the robot's own limit, and its target from
            running ahead of what the arm can follow. By the gains as they are given, also where they are randomized.
        solver_iterations: Constraint solver iterations per physics step (MuJoCo).
        solver_ls_iterations: Line-search iterations of each of those.
        auto_reset: How ``step_and_maybe_reset``, the call of TorchRL's collectors, begins new episodes:
            ``"native"`` (finished worlds restart inside the step, no host sync) or ``"standard"`` (TorchRL asks
            whether a world is done and resets by mask; slower). The numbers are the same.
    """

    image_size: int = 64
    action_scale: float = 0.25
    fps: float = 30.0
    substeps: int = 16
    joint_armature: float = 0.1
    target_ke: float | tuple[float, ...] = 800.0
    target_kd: float | tuple[float, ...] = 40.0
    pose_noise: float = 0.35
    goal: tuple[float, float, float] = (0.30, 0.15, 0.55)
    action_penalty: float = 0.01
    camera_distance: float = 1.15
    camera_height: float = 0.65
    camera_target_height: float = 0.45
    camera_target_distance: float = 0.0
    camera_fov_degrees: float = 60.0
    enable_shadows: bool = False
    enable_textures: bool = False
    mesh_detail: float | None = None
    solver: str = "auto"
    asset_name: str = "franka_emika_panda"
    urdf_relative_path: str = "urdf/fr3_franka_hand.urdf"
    robot: str = "embedded"
    action_mode: str = "joint_delta"
    ee_scale: float = 0.05
    task: str = "reach"
    task_options: Mapping[str, Any] = field(default_factory=dict, hash=False)  # a mapping has no hash
    gripper: bool | None = None
    gripper_force: float = 20.0
    scene: Scene | None = None
    collisions: str = "hand"
    collision_pipeline: str = "mujoco"
    max_contacts: int | None = None
    end_when_lost: bool = True
    drawer_opening: float | None = None
    disc_radius: float = 0.1
    disc_spread: float = 0.0
    home: tuple[float, ...] | None = None
    reward: str = "dense"
    track_radius: float = 0.1
    track_period: float = 4.0
    cameras: tuple[str, ...] = ("front",)
    frame_stack: int = 1
    show_goal: bool = False
    randomization: Randomization = field(default_factory=lambda: Randomization())
    finger_opening: float = 0.02
    observations: tuple[str, ...] = ("pixels", "state")
    episode_length: int = 50
    goal_sampling: str | None = None
    goal_noise: float = 0.8
    success_distance: float = 0.05
    terminate_on_success: bool = False
    gravity_compensation: bool = False
    limit_velocity: bool = False
    solver_iterations: int = 10
    solver_ls_iterations: int = 10
    auto_reset: str = "native"

    def __post_init__(self) -> None:
        for name in ("goal", "observations", "cameras", "target_ke", "target_kd"):  # Hydra hands lists over
            value = getattr(self, name)
            if isinstance(value, Sequence) and not isinstance(value, str):
                object.__setattr__(self, name, tuple(value))
            elif name in ("goal", "observations", "cameras"):
                raise UserError(f"{name}={value!r}: must be a list")
        if isinstance(self.randomization, Mapping):
            object.__setattr__(self, "randomization", Randomization.from_mapping(self.randomization))
        elif not isinstance(self.randomization, Randomization):
            raise UserError(f"randomization={self.randomization!r}: must be a mapping of ranges")
        self._check_whole("image_size", 1, MAX_IMAGE_SIZE, "pixels")
        self._check_whole("frame_stack", 1, 64, "images along the channels")
        self._check_whole("substeps", 1, 1000, "physics steps per control step")
        self._check_whole("episode_length", 1, 1_000_000, "control steps")
        self._check_whole("solver_iterations", 1, 1000, "iterations")
        self._check_whole("solver_ls_iterations", 1, 1000, "iterations")
        for name, low, high, unit in (
            ("action_scale", 0.0, math.pi, "rad per unit of action"),
            ("fps", 0.0, 10_000.0, "Hz"),
            ("ee_scale", 0.0, 1.0, "m per unit of action"),
            ("track_radius", 0.0, 1.0, "m"),
            ("track_period", 0.0, 1e6, "s"),
            ("success_distance", 0.0, 10.0, "m"),
            ("camera_fov_degrees", 0.0, 180.0, "degrees"),
        ):
            self._check_real(name, low, high, unit, open_low=True)
        if self.camera_fov_degrees >= 180:
            raise UserError(f"camera_fov_degrees={self.camera_fov_degrees}: must be below 180; try 60")
        for name, low, high, unit in (
            ("joint_armature", 0.0, 100.0, "kg·m²"),
            ("pose_noise", 0.0, math.pi, "rad"),
            ("goal_noise", 0.0, math.pi, "rad"),
            ("action_penalty", 0.0, 1e6, "reward per mean squared action"),
            ("finger_opening", 0.0, 0.04, "m"),
            ("camera_distance", -100.0, 100.0, "m"),
            ("camera_height", -100.0, 100.0, "m"),
            ("camera_target_height", -100.0, 100.0, "m"),
            ("camera_target_distance", -100.0, 100.0, "m"),
            ("gripper_force", 1.0, 70.0, "N"),
            ("disc_radius", 0.02, 0.1, "m"),
            ("disc_spread", 0.0, 0.09, "m"),  # so no cube begins on its disc
        ):
            self._check_real(name, low, high, unit)
        if self.mesh_detail is not None:
            self._check_real("mesh_detail", 0.0, 0.1, "m")
        if self.drawer_opening is not None:
            self._check_real(
                "drawer_opening", 0.0, math.tau, "m, or rad of a door; for task=drawer", open_low=True
            )
        if (self.camera_distance, self.camera_height) == (
            self.camera_target_distance,
            self.camera_target_height,
        ):
            raise UserError(
                f"camera_distance={self.camera_distance:g} and camera_height=camera_target_height: the eye sits on "
                "its target; move one"
            )
        for name in ("target_ke", "target_kd"):
            value = getattr(self, name)
            gains = value if isinstance(value, tuple) else (value,) * NUM_JOINTS
            if len(gains) != NUM_JOINTS or not all(is_real(g) and g >= 0 for g in gains):
                raise UserError(
                    f"{name}={getattr(self, name)}: give one gain ≥ 0 for all joints or {NUM_JOINTS} of them"
                )
        if len(self.goal) != 3 or not all(is_real(g) for g in self.goal):
            raise UserError(f"goal={self.goal}: give three finite numbers (x, y, z) in metres")
        self._check_choice("solver", ("auto", "mujoco", "featherstone"))
        from franka_wm.envs.robots.sources import SOURCES  # here: robots need this module
        from franka_wm.envs.task_options import task_options
        from franka_wm.envs.tasks import TASKS

        self._check_choice("robot", tuple(SOURCES), more=ROBOT_OF_ONES_OWN)
        if self.goal_sampling is not None:
            self._check_choice("goal_sampling", ("fixed", "reachable"))
        self._check_choice("action_mode", tuple(ACTION_MODES))
        self._check_choice("task", TASKS, more=OF_ONES_OWN)
        object.__setattr__(self, "task_options", task_options(self))
        self._check_choice("reward", self.task_class.rewards)
        self._check_choice("auto_reset", ("native", "standard"))
        for name in (f.name for f in fields(self) if isinstance(f.default, bool) or f.name == "gripper"):
            if not isinstance(getattr(self, name), bool) and (name != "gripper" or self.gripper is not None):
                raise UserError(f"{name}={getattr(self, name)!r}: must be true or false")
        for name, known in (("observations", OBSERVATIONS), ("cameras", CAMERAS)):
            chosen = getattr(self, name)
            if not chosen or any(c not in known for c in chosen) or len(set(chosen)) != len(chosen):
                raise UserError(f"{name}={chosen}: choose one or more of {known}, each once")
        if "goal_pixels" in self.observations and self.task == "track":
            raise UserError("goal_pixels shows a goal that stands still; leave it out with task=track")
        if self.randomization.any() and self.solver == "featherstone":
            raise UserError("randomization needs solver=mujoco")
        if self.limit_velocity and not all(
            k > 0 for name in ("target_ke", "target_kd") for k in self.gains(name)
        ):
            raise UserError(
                "limit_velocity needs target_ke and target_kd above 0: they say how far a set point leads"
            )
        self._check_scene()
        self._check_own_options()
        if self.solver == "featherstone" and self.substeps % 2:
            raise UserError(
                f"substeps={self.substeps} with solver=featherstone: must be even (it swaps two state buffers); "
                f"try {self.substeps + 1}"
            )

    @property
    def task_class(self) -> type[Task]:
        """The class of the task."""
        from franka_wm.envs.tasks import task_class

        return task_class(self.task)

    @property
    def has_gripper(self) -> bool:
        """Whether the fingers are driven: as asked for, or because the task needs it."""
        return self.task_class.gripper if self.gripper is None else self.gripper

    @property
    def resolved_scene(self) -> Scene | None:
        """What stands around the arm: as given, or the task's; ``None``: nothing."""
        return self.task_class.scene if self.scene is None else self.scene

    @property
    def start_pose(self) -> tuple[float, ...]:
        """Joint angles at the start, before noise, (7,) [rad]."""
        return self.home or self.task_class.home or HOME

    @property
    def fixed_goal(self) -> bool:
        """Whether every episode has the same goal, ``goal``."""
        return self.goal_sampling != "reachable" and not self.task_class.draws_goals

    @property
    def action_dim(self) -> int:
        """Size of an action; the gripper's is the last."""
        return ACTION_MODES[self.action_mode] + self.has_gripper

    @property
    def state_dim(self) -> int:
        """Size of ``state``."""
        return STATE_DIM + HAND_DIM * self.has_gripper

    @property
    def target_dim(self) -> int:
        """Size of ``joint_target``: the joints', and the fingers' with a gripper."""
        return NUM_JOINTS + self.has_gripper

    @property
    def num_objects(self) -> int:
        """How many bodies move freely."""
        return len(self.resolved_scene.objects) if self.resolved_scene else 0

    @property
    def num_articulated(self) -> int:
        """How many bodies have a joint."""
        return len(self.resolved_scene.articulated) if self.resolved_scene else 0

    @property
    def object_dim(self) -> int:
        """Size of ``objects``: of each body, and of each joint."""
        return OBJECT_DIM * (self.num_objects + self.num_articulated) + JOINT_DIM * self.num_articulated

    @property
    def images(self) -> tuple[str, ...]:
        """The image observations that were asked for, without cameras' names."""
        return tuple(o for o in self.observations if o in IMAGES)

    def gains(self, name: str) -> tuple[float, ...]:
        """``target_ke`` or ``target_kd`` for each of the seven joints."""
        value = getattr(self, name)
        return (float(value),) * NUM_JOINTS if isinstance(value, (int, float)) else tuple(value)

    @classmethod
    def from_mapping(cls, values) -> FrankaConfig:
        """Builds a config from a mapping (a Hydra node); an unknown name is an error that lists the known ones."""
        known = {f.name for f in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise UserError(f"unknown environment option {unknown[0]!r}; known: {', '.join(sorted(known))}")
        return cls(**dict(values))

    @property
    def contact_dim(self) -> int:
        """Size of ``contacts``: a force of each finger; 0 where it is not asked for."""
        return NUM_FINGERS * ("contacts" in self.observations)

    def _check_own_options(self) -> None:
        """Refuses options of other tasks, and those of a gripper or a scene without one: they would do nothing."""
        from franka_wm.envs.task_options import check_own_options
        from franka_wm.envs.tasks import own_options

        check_own_options(self, own_options())
        for name, there, what in (
            ("gripper_force", self.has_gripper, "the gripper"),
            ("max_contacts", self.resolved_scene, "a scene"),
            ("end_when_lost", self.num_objects, "objects"),
        ):
            if getattr(self, name) != getattr(type(self), name) and not there:
                raise UserError(
                    f"{name}={getattr(self, name)}: needs {what}; task={self.task} has none; leave it out"
                )

    def _check_scene(self) -> None:
        """Scene, gripper and what they need of the rest."""
        if self.scene is not None:
            object.__setattr__(self, "scene", Scene.of(self.scene))
        if self.home is not None:
            ok = isinstance(self.home, Sequence) and not isinstance(self.home, str)
            if not ok or len(self.home) != NUM_JOINTS or not all(is_real(q) for q in self.home):
                raise UserError(f"home={self.home!r}: give {NUM_JOINTS} joint angles [rad], or null")
            object.__setattr__(self, "home", tuple(float(q) for q in self.home))
        self._check_choice("collisions", ("hand", "arm", "self"))
        if self.collisions != "hand" and not self.resolved_scene:
            raise UserError(
                f"collisions={self.collisions}: task={self.task} touches nothing; give a scene, {{}} is a table alone"
            )
        self._check_choice("collision_pipeline", ("mujoco", "newton"))
        if self.collision_pipeline != "mujoco" and not self.resolved_scene:
            raise UserError(
                f"collision_pipeline={self.collision_pipeline}: task={self.task} touches nothing; leave it at mujoco"
            )
        if self.max_contacts is not None:
            self._check_whole("max_contacts", 1, 10_000, "contacts of a world")
            least, enough = self.resolved_scene.contacts(self.collisions) if self.resolved_scene else (0, 0)
            if self.max_contacts < least:
                raise UserError(
                    f"max_contacts={self.max_contacts}: this scene needs at least {least} (4 under each object, 8 for "
                    f"the hand); {enough} are enough, which null means"
                )
        if self.task_class.gripper and not self.has_gripper:
            raise UserError(f"gripper=false: task={self.task} needs the gripper; leave it at null")
        if self.resolved_scene and not self.has_gripper:
            raise UserError("scene: contacts need the fingers as bodies of their own; set gripper=true")
        if self.has_gripper and "goal_pixels" in self.observations:
            self.task_class.check_goal_image()
        if self.has_gripper and self.solver == "featherstone":
            raise UserError("gripper and scene need solver=mujoco")
        if self.contact_dim and not self.resolved_scene:
            raise UserError(
                f"observations: task={self.task} touches nothing; leave contacts out, give a scene, or name a task "
                "that has one"
            )
        if "objects" in self.observations and not self.object_dim:
            raise UserError(
                f"observations: task={self.task} has no objects here; leave objects out, give a scene with some (it "
                "takes the place of the task's whole one), or name a task that has them"
            )
        for name, there, what in (
            ("contact_friction", self.resolved_scene, "a scene"),
            ("table_height", self.resolved_scene, "a scene"),
            ("grip_force", self.has_gripper, "the gripper"),
            ("object_size", self.num_objects, "objects"),
            ("object_noise", self.object_dim, "objects"),
        ):
            if getattr(self.randomization, name) and not there:
                raise UserError(f"randomization.{name}: needs {what}; task={self.task} has none; set it to 0")
        if self.randomization.object_size and self.resolved_scene:
            self.resolved_scene.check_sizes(self.randomization.object_size)
        self.task_class.check(self)

    def _check_whole(self, name: str, low: int, high: int, unit: str) -> None:
        check_whole(name, getattr(self, name), least=low, most=high, unit=unit)

    def _check_real(self, name: str, low: float, high: float, unit: str, *, open_low: bool = False) -> None:
        value = getattr(self, name)
        if not is_real(value) or value > high or value < low or (open_low and value == low):
            bounds = f"above {low:g} and at most {high:g}" if open_low else f"from {low:g} to {high:g}"
            raise UserError(f"{name}={value!r}: must be {bounds} ({unit})")

    def _check_choice(self, name: str, allowed: Sequence[str], more: str = "") -> None:
        value = getattr(self, name)
        if value not in allowed:
            raise UserError(f"{name}={value!r}: must be one of {', '.join(allowed)}{more}")
