"""Every family learns from parts of batches in several processes."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, distributed
from torch.overrides import TorchFunctionMode

from franka_wm import models, processes
from franka_wm.training.learner import Learner

UPDATES, BATCH, ACTIONS, MOVES = 8, 8, 2, 5
IMAGE = {"pixels": (16, 16, 3)}
VECTORS = {"state": 3, "joint_target": 2}
DENSE = dict(latent_dim=32, simnorm_dim=8, encoder_dim=32, hidden_dim=32)
VISION = dict(encoder_width=32, encoder_depth=1, encoder_heads=2, patch_size=8)
TRANSFORMER = dict(predictor_depth=1, predictor_heads=2, predictor_head_dim=16, predictor_mlp=32, dropout=0.0)
JEPA = dict(
    image_sizes=IMAGE, **VISION, predictor_width=16, predictor_depth=1, predictor_heads=2, guard_directions=16
)
LEWM = dict(
    image_sizes=IMAGE, action_dim=ACTIONS, **VISION, **TRANSFORMER, embed_dim=16, projector_hidden=32,
    sigreg_directions=16,
)  # fmt: skip
DINO = dict(
    model_type="dinov2",
    hidden_size=16,
    num_hidden_layers=1,
    num_attention_heads=2,
    image_size=16,
    patch_size=8,
)

FAMILIES: dict[str, tuple[str, dict[str, Any], int]] = {
    "tdmpc2": ("tdmpc2", dict(observation_sizes=VECTORS, action_dim=ACTIONS, discount=0.9, dropout=0.0, **DENSE), 3),
    "tdmpc2, demonstrations": (
        "tdmpc2",
        dict(observation_sizes=VECTORS, action_dim=ACTIONS, discount=0.9, dropout=0.0, imitation_coef=1.0, **DENSE),
        3,
    ),
    "muzero": ("muzero", dict(observation_sizes=VECTORS, num_actions=MOVES, discount=0.9, unroll=3, n_step=2,
                              projector_dim=16, **DENSE), 5),
    "dreamer": ("dreamer", dict(observation_sizes=VECTORS, action_dim=ACTIONS, discount=0.9, deter_dim=16,
                                hidden_dim=16, codes=3, classes=4, blocks=2, encoder_layers=2, bins=41,
                                imagination=4), 6),
    "lewm": ("lewm", dict(**LEWM), 3),
    "lewm, contrastive": ("lewm", dict(**LEWM, infonce_coef=0.1), 3),
    "action_world_model": ("action_world_model", dict(image_sizes=IMAGE, action_dim=ACTIONS, **VISION,
                                                      state_embed_dim=16, state_hidden_dim=32, grid=2,
                                                      predictor_width=32, predictor_depth=1, predictor_heads=2,
                                                      predictor_hidden_dim=32, guard_directions=32), 3),
    "jepa": ("jepa", dict(**{**JEPA, "patch_size": 4}, ema_steps=100), 2),
    "lejepa": ("jepa", dict(**JEPA, recipe="lejepa", local_views=2), 2),
    "vicreg": ("jepa", dict(**JEPA, recipe="lejepa", collapse="vicreg", local_views=2), 2),
    "dino_wm": ("dino_wm", dict(image_sizes=IMAGE, action_dim=ACTIONS, huggingface_config=DINO, grid=2,
                                **{**TRANSFORMER, "predictor_head_dim": 8}), 3),
}  # fmt: skip


if importlib.util.find_spec("transformers") is None:  # an extra
    del FAMILIES["dino_wm"]


class Regular(TorchFunctionMode):
    """Random numbers are regular ones, the same for each sample of a batch, however large the batch is."""

    def __torch_function__(self, func: Callable, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        name = getattr(func, "__name__", "")
        if name in ("rand", "rand_like", "exponential_"):
            return out.copy_(_regular(out))
        if name in ("randn", "randn_like"):
            return out.copy_(2.0 * _regular(out) - 1.0)
        if name == "randint":
            return out.zero_()
        return out


def _regular(like: Tensor) -> Tensor:
    """In (0, 1), different along the last dimension where that is not one of samples."""
    if like.ndim == 2 and like.shape[0] == 4:  # places of crops
        return torch.full_like(like, 0.4)
    return (0.37 + 0.618 * torch.arange(like.shape[-1], device=like.device)) % 1.0 * 0.98 + 0.01


def windows(name: str, length: int) -> TensorDict:
    """One batch (BATCH, length) for a family."""
    family = FAMILIES[name][0]
    discrete = family == "muzero"

    def observation() -> dict[str, Tensor]:
        images = {
            key: torch.randint(0, 256, (BATCH, length, *size), dtype=torch.uint8)
            for key, size in IMAGE.items()
        }
        vectors = {key: torch.randn(BATCH, length, size) for key, size in VECTORS.items()}
        return images | vectors

    first, after = observation(), observation()
    for key in first:  # what follows a step is the root of the following one
        after[key][:, :-1] = first[key][:, 1:]
    action = torch.randint(MOVES, (BATCH, length)) if discrete else torch.rand(BATCH, length, ACTIONS) * 2 - 1
    root: dict[str, Any] = {**first, "action": action}
    root["is_init"] = torch.zeros(BATCH, length, 1, dtype=torch.bool)
    if discrete:
        root["search_policy"] = torch.rand(BATCH, length, MOVES).softmax(-1)
        root["search_value"] = torch.randn(BATCH, length, 1)
    if "demonstrations" in name:  # not as many in each part
        root["demonstrated"] = (torch.arange(BATCH) < 3).view(BATCH, 1, 1).expand(BATCH, length, 1).clone()
    after["reward"] = torch.randn(BATCH, length, 1)
    after["terminated"] = torch.zeros(BATCH, length, 1, dtype=torch.bool)
    return TensorDict({**root, "next": after}, batch_size=[BATCH, length])


@contextmanager
def exact() -> Iterator[None]:
    """Everything in float64: what differs then is not rounding."""
    single, torch.Tensor.float = torch.Tensor.float, lambda self: self.double()  # type: ignore[method-assign]
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.Tensor.float = single  # type: ignore[method-assign]
        torch.set_default_dtype(torch.float32)


MESSAGES = ("all_reduce", "all_gather_into_tensor", "broadcast")
"""What a process sends: functions of `torch.distributed`."""


@contextmanager
def counted() -> Iterator[list[int]]:
    """How many messages a process sends; each waits for the others."""
    found = [0]
    real = {name: getattr(distributed, name) for name in MESSAGES}

    def counting(name: str) -> Callable[..., Any]:
        def send(*args: Any, **kwargs: Any) -> Any:
            found[0] += 1
            return real[name](*args, **kwargs)

        return send

    for name in MESSAGES:
        setattr(distributed, name, counting(name))
    try:
        yield found
    finally:
        for name, function in real.items():
            setattr(distributed, name, function)


@exact()
def learn(name: str, device: str = "cpu") -> tuple[dict[str, Tensor], int]:
    """A family's weights after some updates from this process's part of a batch, and the messages of an eager one.

    On a GPU the last updates are captured ones.
    """
    torch.manual_seed(0)
    family, options, length = FAMILIES[name]
    model = models.make(family, **options)
    with torch.no_grad():
        for one in model.parameters():  # heads that begin at zero, behind which gradients vanish
            if one.ndim > 1 and not one.any():
                one.normal_(std=0.5)
    learner = Learner(model.to(device), lr=1e-2)
    for group in learner.optimizer.param_groups:
        group["eps"] = 1e-6  # else Adam makes whole steps of the rounding of gradients that should be zero
    messages, generator = 0, torch.get_rng_state()
    for update in range(UPDATES):
        torch.set_rng_state(generator)
        batch = windows(name, length)
        generator = torch.get_rng_state()
        own: Any = batch.chunk(processes.count())[processes.rank()].to(device)
        with Regular(), counted() as sent:
            learner.update(own)
        messages = sent[0] if update == 0 else messages
    learner.metrics()
    assert device == "cpu" or learner._graph is not None, "nothing was captured"
    return {k: x.cpu() for k, x in model.state_dict().items() if isinstance(x, Tensor)}, messages


def together(folder: Path, *, cuda: bool = False) -> None:
    """What one process of the job does: the first writes what all families have learned into a folder."""
    processes.join(cuda=cuda)
    device = str(processes.own_gpu()) if cuda else "cpu"
    found = {name: learn(name, device) for name in FAMILIES}
    processes.wait()
    for weights, _ in found.values():
        processes.require_same(weights)
    if processes.rank() == 0:
        torch.save(found, folder / "learned.pt")
    processes.leave()
