"""The arm in Gymnasium: one arm, and N arms as a vector environment, for LeRobot's evaluation and other NumPy code.

    import franka_wm.envs.gym  # registers the names
    env = gymnasium.make("franka_wm/Reach-v0")
    envs = gymnasium.make_vec("franka_wm/Reach-v0", num_envs=16)

Gymnasium speaks NumPy, so **each step copies its observations to the host and waits for the device**. This is
the one place in the package that does; train on :class:`~franka_wm.envs.FrankaEnv` itself.

``gymnasium.make("franka_wm.envs.gym:franka_wm/Reach-v0")`` imports this module first. Nothing is simulated before an
environment is made.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from tensordict import TensorDictBase

from franka_wm.envs.camera import whole_arm
from franka_wm.envs.config import NUM_JOINTS, FrankaConfig
from franka_wm.envs.franka import FrankaEnv
from franka_wm.envs.specs import MARKS
from franka_wm.envs.tasks import TASKS, task_class
from franka_wm.errors import UserError

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise UserError(f"franka_wm.envs.gym needs pip install 'franka-wm[gym]' ({error})") from error

CAMERA = "front"
RENAMED = ("pixels", "state", "goal", *MARKS)
"""What has another name, or no place, among Gymnasium's observations."""

REACH_V0: dict[str, Any] = {
    "observations": ("pixels", "state"),
    "goal_sampling": "reachable",
    "gravity_compensation": True,
    "limit_velocity": True,
    "action_scale": 0.085,
    "substeps": 4,
    "episode_length": 50,
}
"""What ``franka_wm/Reach-v0`` is. Published numbers refer to it: change it under another version."""


class FrankaVectorEnv(gymnasium.vector.VectorEnv):
    """N arms behind Gymnasium's vector interface, with the keys that LeRobot reads.

    Observations, a dictionary of NumPy arrays:

    =======================  ============================  ======================================
    key                      shape, dtype                  meaning
    =======================  ============================  ======================================
    ``pixels``/``front``     (N, H, W, 3) uint8            the camera; absent without ``pixels``
    ``agent_pos``            (N, 7) float32                joint angles [rad]; with a gripper (N, 28), all of ``state``
    ``environment_state``    (N, 3) float32                the goal [m]
    =======================  ============================  ======================================

    All else that ``observations`` and ``cameras`` ask for has its own name: ``objects``, ``joint_target``, ``depth``,
    ``pixels_wrist``, …, (N, …) as :class:`~franka_wm.envs.FrankaEnv` has it.

    Actions are (N, A) float32 in [−1, 1], where A is 7, or 3 with ``action_mode="ee_delta"``. Rewards are (N,)
    float32, terminations and truncations (N,) bool.

    **Autoreset is same-step**: where an episode ended, the observation returned is already the first of the
    next one. The last of the finished one is in ``info["final_obs"]`` (an object array, ``None`` elsewhere),
    its success in ``info["final_info"]["is_success"]``; the masks are under ``_final_obs`` and
    ``_final_info``. All four are absent where no episode ended. ``info["is_success"]`` (N,) belongs to the
    observation returned, so it is false where an episode has just begun.

    Args:
        num_envs: Number of worlds, N.
        env: A ready environment to view instead; it must observe ``state``. Then give nothing else.
        device: Where it simulates; the GPU where there is one.
        seed: Until the first ``reset(seed=…)``; ``None``: one that no other instance of this process has.
        render_mode: ``"rgb_array"`` for :meth:`render`, or ``None``.
        **config: Fields of :class:`~franka_wm.envs.FrankaConfig`.

    Raises:
        UserError: If an option cannot be used.
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": 30,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    task: str
    """The name of the task, as LeRobot asks for it; ``task_description`` has its words."""
    task_description: str

    def __init__(
        self,
        num_envs: int = 1,
        *,
        env: FrankaEnv | None = None,
        device: torch.device | str | None = None,
        seed: int | None = None,
        render_mode: str | None = None,
        **config: Any,
    ):
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode={render_mode!r}: must be rgb_array or None")
        if env is None:
            observations = tuple(config.pop("observations", ("pixels", "state")))
            fields_given = FrankaConfig.from_mapping({"observations": observations, **config})
            env = FrankaEnv(fields_given, num_envs=num_envs, device=device, seed=seed)
        elif named := [*config, *(["num_envs"] * (num_envs != 1)), *(["device"] * (device is not None))]:
            raise UserError(f"{named[0]}: env=… is already built; give its options to FrankaEnv")
        if "state" not in env.config.observations:
            raise UserError(
                f"observations={env.config.observations}: agent_pos is read from 'state'; add it to observations"
            )
        self.env = env
        self.task, self.task_description = env.config.task, task_class(env.config.task).words
        self.num_envs = env.num_envs
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "render_fps": round(env.config.fps)}
        self._max_episode_steps = env.config.episode_length
        entries: dict[str, spaces.Space] = {}
        if "pixels" in env.config.observations:
            side = env.config.image_size
            entries["pixels"] = spaces.Dict(
                {CAMERA: spaces.Box(0, 255, (side, side, 3 * env.config.frame_stack), np.uint8)}
            )
        # Joints may overshoot their limits a little, so the box is open.
        self._arm = env.config.state_dim if env.config.has_gripper else NUM_JOINTS
        entries["agent_pos"] = spaces.Box(-np.inf, np.inf, (self._arm,), np.float32)
        entries["environment_state"] = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self._others = [key for key in env.observation_spec if key not in RENAMED]
        for key in self._others:
            spec = env.observation_spec[key]
            image = spec.dtype == torch.uint8
            low, high, dtype = (0, 255, np.uint8) if image else (-np.inf, np.inf, np.float32)
            entries[key] = spaces.Box(low, high, tuple(spec.shape[1:]), dtype)
        self.single_observation_space = spaces.Dict(entries)
        self.single_action_space = spaces.Box(-1.0, 1.0, (env.action_dim,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._present: TensorDictBase | None = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts new episodes.

        Args:
            seed: Seed of all worlds: world k draws from (seed, k). A list (s, s + 1, …, s + N − 1), which is what
                Gymnasium makes of a number s, is taken as s; worlds have no seeds of their own.
            options: ``reset_mask`` (N,) bool resets those worlds only. Other keys are ignored.
        """
        seed = self._one_seed(seed)
        super().reset(seed=seed)
        mask = None if options is None else options.get("reset_mask")
        if mask is None:
            self._present = self.env.reset(seed=seed)
        else:
            if self._present is None:
                raise UserError("reset_mask: reset all worlds once before resetting some")
            if seed is not None:
                raise UserError("reset_mask with a seed: seeding restarts all worlds; give one of the two")
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
                raise UserError(f"reset_mask: must be a bool array of shape ({self.num_envs},)")
            where = torch.from_numpy(mask).to(self.env.device).unsqueeze(-1)
            # TorchRL keeps the other worlds' entries from what it is given.
            self._present = self.env.reset(self._present.copy().set("_reset", where))
        assert self._present is not None
        observations, success = self._to_numpy(self._present)
        return observations, {"is_success": success}

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of all worlds.

        Args:
            actions: (N, A), clipped to [−1, 1].

        Returns:
            Observations, rewards, terminations, truncations, info.
        """
        if self._present is None:
            raise UserError("step before reset: call reset() first")
        actions = np.asarray(actions, dtype=np.float32)
        if actions.shape != self.action_space.shape:
            raise UserError(f"actions has shape {actions.shape}; it must be {self.action_space.shape}")
        self._present.set("action", torch.from_numpy(actions).to(self.env.device))
        stepped, self._present = self.env.step_and_maybe_reset(self._present)
        after = stepped.get("next")
        observations, success = self._to_numpy(self._present)
        info: dict[str, Any] = {"is_success": success}
        done = _host(after.get("done"))
        if done.any():
            last, last_success = self._to_numpy(after)
            final = np.full(self.num_envs, None, dtype=object)
            for k in np.flatnonzero(done):
                final[k] = _row(last, k)
            info["final_obs"], info["_final_obs"] = final, done
            info["final_info"] = {"is_success": last_success & done, "_is_success": done}
            info["_final_info"] = done
        return (
            observations,
            _host(after.get("reward")),
            _host(after.get("terminated")),
            _host(after.get("truncated")),
            info,
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """N frames, (256, 256, 3) uint8; ``None`` without ``render_mode="rgb_array"``."""
        if self.render_mode is None:
            return None
        return tuple(self.env.render(256, samples=2, config=self._camera).cpu().numpy())

    @cached_property
    def _camera(self) -> FrankaConfig:
        """Where the frames' camera stands; the configuration of an environment never changes."""
        return whole_arm(self.env.config, self.env.kinematics)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """``name`` of each world, as ``SyncVectorEnv.call`` has it; called if it can be.

        Raises:
            AttributeError: If there is none.
        """
        value = getattr(self, name)
        if name == "render":
            return value() or (None,) * self.num_envs
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """``name`` of each world."""
        return (getattr(self, name),) * self.num_envs

    def close_extras(self, **kwargs: Any) -> None:
        self._present = None
        if not self.env.is_closed:
            self.env.close()

    def _one_seed(self, seed: int | Sequence[int] | None) -> int | None:
        if seed is None:
            return None
        given: Any = seed
        several = isinstance(given, Sequence | np.ndarray) and not isinstance(given, str)
        seeds: list[Any] = list(given) if several else [given]
        if several and seeds == [None] * self.num_envs:
            return None
        if not all(isinstance(one, int | np.integer) and one >= 0 for one in seeds):
            raise UserError(f"seed={seed!r}: must be a whole number of at least 0, or None")
        if several and (not seeds or seeds != list(range(seeds[0], seeds[0] + self.num_envs))):
            raise UserError(
                f"seed={seeds}: worlds share one seed; give a number s, or the list s, s + 1, … of {self.num_envs}"
            )
        return int(seeds[0])

    def _to_numpy(self, tensordict: TensorDictBase) -> tuple[dict[str, Any], np.ndarray]:
        """Observations and success; the copy to the host."""
        out: dict[str, Any] = {}
        if "pixels" in self.env.config.observations:
            out["pixels"] = {CAMERA: tensordict.get("pixels").contiguous().cpu().numpy()}
        out["agent_pos"] = tensordict.get("state")[:, : self._arm].contiguous().cpu().numpy()
        out["environment_state"] = tensordict.get("goal").contiguous().cpu().numpy()
        out |= {key: tensordict.get(key).contiguous().cpu().numpy() for key in self._others}
        return out, _host(tensordict.get("success"))


def _host(column: torch.Tensor) -> np.ndarray:
    """(N, 1) on the device → (N,) on the host."""
    return column.squeeze(-1).cpu().numpy()


def _row(tree: dict[str, Any], index: int) -> dict[str, Any]:
    """One world's part of a batched observation."""
    return {
        key: _row(value, index) if isinstance(value, dict) else value[index].copy()
        for key, value in tree.items()
    }


class FrankaGymEnv(gymnasium.Env):
    """One arm behind Gymnasium's interface: a :class:`FrankaVectorEnv` of one world, without its leading dimension.

    Observations are those of the vector environment: ``pixels``/``front`` (H, W, 3) uint8, ``agent_pos`` (7,)
    [rad] or (28,), ``environment_state`` (3,) [m], and what else was asked for. Actions are (A,) float32 in [−1, 1]; A
    is 7, or 3 with ``action_mode="ee_delta"``; one more with a gripper. ``info["is_success"]`` belongs to the
    observation returned. A finished episode goes on until :meth:`reset`, still finished.

    Args:
        device: Where it simulates; the GPU where there is one.
        seed: Until the first ``reset(seed=…)``; ``None``: one that no other instance of this process has.
        render_mode: ``"rgb_array"`` for :meth:`render`, or ``None``.
        **config: Fields of :class:`~franka_wm.envs.FrankaConfig`.

    Raises:
        UserError: If an option cannot be used.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(
        self,
        *,
        device: torch.device | str | None = None,
        seed: int | None = None,
        render_mode: str | None = None,
        **config: Any,
    ):
        self._vector = FrankaVectorEnv(1, device=device, seed=seed, render_mode=render_mode, **config)
        self.env = self._vector.env
        self.render_mode = render_mode
        self.metadata = {key: self._vector.metadata[key] for key in ("render_modes", "render_fps")}
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space
        self._present: TensorDictBase | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts a new episode; the first of ``seed`` if one is given. ``options`` are ignored."""
        super().reset(seed=seed)
        self._present = self.env.reset(seed=seed)
        return self._observed(self._present)

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step with ``action`` (A,), clipped to [−1, 1]."""
        if self._present is None:
            raise UserError("step before reset: call reset() first")
        action = np.asarray(action, dtype=np.float32)
        if action.shape != self.action_space.shape:
            raise UserError(f"action has shape {action.shape}; it must be {self.action_space.shape}")
        given = torch.from_numpy(action).to(self.env.device).unsqueeze(0)
        after = self.env.step(self._present.set("action", given)).get("next")
        self._present = after
        observation, info = self._observed(after)
        reward, terminated, truncated = (
            after.get(key).item() for key in ("reward", "terminated", "truncated")
        )
        return observation, float(reward), bool(terminated), bool(truncated), info

    def render(self) -> np.ndarray | None:
        """A frame, (256, 256, 3) uint8; ``None`` without ``render_mode="rgb_array"``."""
        frames = self._vector.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        self._vector.close()

    def _observed(self, tensordict: TensorDictBase) -> tuple[dict[str, Any], dict[str, Any]]:
        observation, success = self._vector._to_numpy(tensordict)
        return _row(observation, 0), {"is_success": bool(success[0])}


def register() -> None:
    """Tells Gymnasium about every task: ``franka_wm/Reach-v0``, ``franka_wm/Lift-v0``, and those of your own.

    A task with a gripper is that of ``env=TASK``: its length, rate, start and camera. Importing this module does it;
    call it again after :func:`franka_wm.envs.tasks.register`. Names that are there stay as they are. Options are every
    field of :class:`~franka_wm.envs.FrankaConfig`, ``device``, ``seed`` and ``render_mode``. ``FrankaWM/Reach-v0`` is
    the former name of the vector environment.
    """
    names = {f"franka_wm/{_camel(task)}-v0": task for task in TASKS}
    for name, task in (names | {"FrankaWM/Reach-v0": "reach"}).items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{__name__}:FrankaGymEnv" if name in names else None,
                vector_entry_point=f"{__name__}:FrankaVectorEnv",
                kwargs=REACH_V0 | _preset(task) | {"task": task},
                disable_env_checker=True,
            )


def _preset(task: str) -> dict[str, Any]:
    """What ``conf/env/TASK.yaml`` and those that it begins with say beyond reach, but for what is observed."""
    file = Path(__file__).parents[1] / "conf" / "env" / f"{task}.yaml"
    # Reach is REACH_V0 already; tasks of one's own have no file here.
    if task in ("reach", "franka") or not file.is_file():
        return {}
    own: dict[str, Any] = yaml.safe_load(file.read_text(encoding="utf-8"))
    first = next((one for one in own.pop("defaults", ()) if one != "_self_"), "reach")
    return _preset(first) | {name: value for name, value in own.items() if name != "observations"}


def _camel(task: str) -> str:
    """``raise_tool`` → ``RaiseTool``."""
    return "".join(word.capitalize() for word in task.split("_"))


register()
