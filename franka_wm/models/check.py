"""Whether a model answers in the shapes that `WorldModel` promises, tried once on invented observations."""

from functools import partial

import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.errors import UserError, trying
from franka_wm.models.base import WorldModel


@torch.no_grad()
def check_model(model: WorldModel, *, action_dim: int | None = None) -> None:
    """Ask a model for latents, what follows them, rewards, values and actions, and look at their shapes.

    For tests of a model of your own; a run does it before it builds anything. `loss` is not called: what a batch
    holds depends on the run.

    Args:
        model: as it was built; its mode and torch's random numbers are left as they are.
        action_dim: A; None: its actions are discrete, and `encode` alone is tried.

    Raises:
        UserError: one line: a method fails, or answers in another shape.
    """
    name, count = type(model).__name__, 3
    modes = {part: part.training for part in model.modules()}
    vectors = {key: torch.zeros(count, size) for key, size in model.observation_sizes.items()}
    images = {key: torch.zeros(count, *size, dtype=torch.uint8) for key, size in model.image_sizes.items()}
    begins = {"is_init": torch.ones(count, 1, dtype=torch.bool)}  # policies have it, too
    observation = TensorDict({**vectors, **images, **begins}, batch_size=[count])
    try:
        model.eval()
        with torch.random.fork_rng(devices=[]):
            _ask(model, name, observation, action_dim)
    finally:
        for part, training in modes.items():
            part.training = training  # what its constructor froze stays so


def _ask(model: WorldModel, name: str, observation: TensorDict, action_dim: int | None) -> None:
    count = len(observation)
    with trying(f"{name}.encode"):
        z = model.encode(observation)
    if not isinstance(z, Tensor) or z.ndim < 2 or len(z) != count:
        raise UserError(
            f"{name}.encode of {count} observations must return a tensor ({count}, …), not {_shown(z)}"
        )
    if action_dim is not None and not model.discrete:
        action = torch.zeros(count, action_dim)
        for has, method, arguments, shape in (
            (model.has_next, "next", (z, action), tuple(z.shape)),
            (model.has_reward, "reward", (z, action), (count, 1)),
            (model.has_value, "value", (z,), (count, 1)),
            (model.has_policy, "policy", (z,), (count, action_dim)),
        ):
            if not has:
                continue
            ask = getattr(model, method)
            with trying(f"{name}.{method}"):
                found = (partial(ask, deterministic=True) if method == "policy" else ask)(*arguments)
            if not isinstance(found, Tensor) or tuple(found.shape) != shape:
                raise UserError(
                    f"{name}.{method} for {count} latents must return {shape}, not {_shown(found)}"
                )


def _shown(x: object) -> str:
    return str(tuple(x.shape)) if isinstance(x, Tensor) else type(x).__name__
