"""Whether a model answers in the shapes that `WorldModel` promises, tried once on invented observations."""

from functools import partial
from inspect import Parameter, signature

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from franka_wm.errors import UserError, trying
from franka_wm.models.base import ABILITIES, WorldModel
from franka_wm.models.groups import ParameterGroup

METHODS = (
    *(
        "encode",
        "loss",
        *(method for methods in ABILITIES.values() for method in methods),
        "terminated",
        "embed",
    ),
    *(
        "set_observation_statistics",
        "set_image_statistics",
        "parameter_groups",
        "after_update",
        "rebuild_overrides",
    ),
)
"""What others call of a model."""


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
    if "_modules" not in vars(model):
        raise UserError(f"{name}.__init__ must begin with super().__init__(), which is missing")
    for method in METHODS:
        _check_arguments(model, name, method)
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


def check_groups(model: WorldModel, groups: object) -> list[ParameterGroup]:
    """What `parameter_groups` returned, if an optimiser can be built of it.

    Raises:
        UserError: one line: it is no list of dicts with `params`, or there is nothing to train.
    """
    name = f"{type(model).__name__}.parameter_groups"
    if not isinstance(groups, list | tuple):
        raise UserError(f"{name} must return a list of dicts with params, not {_shown(groups)}")
    for group in groups:
        params = group.get("params") if isinstance(group, dict) else None
        # Not a generator: they are read more than once.
        if not isinstance(params, list | tuple | nn.ParameterList) or not all(map(torch.is_tensor, params)):
            raise UserError(f"{name}: each group must be a dict whose params is a list of parameters")
    if not any(len(group["params"]) for group in groups):
        raise UserError(f"{name}: there is no parameter to train")
    return list(groups)


def check_losses(model: WorldModel, losses: object) -> None:
    """Whether what `loss` returned can be differentiated and logged; reads no value, so nothing waits.

    Raises:
        UserError: one line: it is no TensorDict with `loss`, an entry is no number, or `loss` has no gradient.
    """
    name = f"{type(model).__name__}.loss"
    loss = losses.get("loss", None) if isinstance(losses, TensorDictBase) else None
    if not isinstance(losses, TensorDictBase) or loss is None:
        raise UserError(f"{name} must return a TensorDict: loss, and numbers to log (docs/models.md)")
    for key, value in losses.items():
        if not isinstance(value, Tensor) or value.numel() != 1:
            raise UserError(
                f"{name}: {key} must be one number (), not {_shown(value)}; take its mean, or leave it out"
            )
    if not loss.requires_grad:
        raise UserError(
            f"{name}: loss has no gradient; compute it without detach(), .item() and torch.no_grad()"
        )


def _check_arguments(model: WorldModel, name: str, method: str) -> None:
    """Refuses a method that cannot be called as `WorldModel`'s: what has a default there is given by its name."""
    wanted = [*signature(getattr(WorldModel, method)).parameters.values()][1:]
    takes = signature(getattr(model, method))
    named = {one.name: None for one in wanted if one.default is not Parameter.empty}
    try:
        takes.bind(*wanted[: len(wanted) - len(named)], **named)
    except TypeError:
        arguments, given = (
            ", ".join(one.name for one in some) for some in (wanted, takes.parameters.values())
        )
        raise UserError(
            f"{name}.{method} must take ({arguments}), not ({given}); see docs/models.md"
        ) from None


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
