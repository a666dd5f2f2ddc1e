"""One update: weights move, gradients are clipped, metrics are means."""

from __future__ import annotations

import copy
from collections import Counter
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from franka_wm import models
from franka_wm.errors import UserError
from franka_wm.training import build
from franka_wm.training.learner import Learner


class Line(models.WorldModel):
    """y = w x + b with two clip groups; the loss is known by hand."""

    def __init__(self) -> None:
        super().__init__()
        self.w, self.b, self.frozen = (nn.Parameter(torch.full((1,), v)) for v in (1.0, 2.0, 3.0))
        self.frozen.requires_grad_(False)
        self.after = 0

    def parameter_groups(self, lr: float) -> list[dict[str, Any]]:
        return [
            {"params": [self.w], "lr": lr, "clip": "slope"},
            {"params": [self.b], "lr": 0.1 * lr, "clip": "offset"},
        ]

    def loss(self, batch: TensorDict) -> TensorDict:
        error = (self.w * batch["x"] + self.b + 0 * self.frozen).square().mean()
        return TensorDict({"loss": error, "x_mean": batch["x"].mean()})

    def after_update(self) -> None:
        self.after += 1


def batch(value: float) -> TensorDict:
    return TensorDict({"x": torch.full((4, 2), value)}, batch_size=[4, 2])


def test_metrics_are_means_since_the_last_call() -> None:
    model = Line()
    learner = Learner(model, lr=1e-9)
    assert learner.metrics() == {}
    for value in (1.0, 2.0, 6.0):
        learner.update(batch(value))
    metrics = learner.metrics()
    assert metrics["x_mean"] == pytest.approx(3.0)
    assert metrics["loss"] == pytest.approx((9 + 16 + 64) / 3, rel=1e-5)
    # d/dw = 2 (x + 2) x, d/db = 2 (x + 2): norms before clipping, one for each group.
    assert metrics["grad_norm_slope"] == pytest.approx((6 + 16 + 96) / 3, rel=1e-5)
    assert metrics["grad_norm_offset"] == pytest.approx((6 + 8 + 16) / 3, rel=1e-5)
    assert learner.metrics() == {}
    learner.update(batch(5.0))
    assert learner.metrics()["x_mean"] == pytest.approx(5.0)
    assert learner.updates == model.after == 4


def test_gradients_are_clipped_in_each_group() -> None:
    model = Line()
    learner = Learner(model, lr=1e-9, grad_clip=10.0)
    learner.update(batch(6.0))  # gradients 96 and 16
    assert model.w.grad is not None and model.b.grad is not None
    assert model.w.grad.item() == pytest.approx(10.0, rel=1e-4)
    assert model.b.grad.item() == pytest.approx(10.0, rel=1e-4)
    learner.update(batch(0.5))  # gradients 2.5 and 5: as they are, and not on top of the last ones
    assert model.w.grad.item() == pytest.approx(2.5, rel=1e-4)
    assert model.b.grad.item() == pytest.approx(5.0, rel=1e-4)


def test_learning_rates_are_the_group_s() -> None:
    model = Line()
    Learner(model, lr=0.01).update(batch(1.0))
    assert model.w.item() == pytest.approx(1 - 0.01, abs=1e-5)  # Adam's first step is the learning rate
    assert model.b.item() == pytest.approx(2 - 0.001, abs=1e-5)
    assert model.frozen.item() == 3.0


def test_it_learns() -> None:
    model = Line()
    learner = Learner(model, lr=0.05)
    for _ in range(200):
        learner.update(batch(1.0))
    learner.metrics()
    learner.update(batch(1.0))
    assert learner.metrics()["loss"] < 1e-3


@pytest.mark.parametrize("options", [{"lr": 0.0}, {"lr": -1.0}, {"grad_clip": 0.0}, {"lr": float("nan")}])
def test_impossible_options(options: dict[str, float]) -> None:
    with pytest.raises(UserError):
        Learner(Line(), **options)


def test_capture_without_cuda() -> None:
    with pytest.raises(UserError, match="cuda"):
        Learner(Line(), capture=True)


def test_what_is_captured_reads_the_memory_of_the_updates_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """A compiled loss is compiled for strides: others while it is captured would compile it then; CUDA refuses that."""
    stream = SimpleNamespace(wait_stream=lambda _: None)
    for name, fake in {
        "Stream": lambda: stream,
        "current_stream": lambda: stream,
        "stream": nullcontext,
        "CUDAGraph": lambda: SimpleNamespace(replay=lambda: None),
        "graph": lambda *_, **__: nullcontext(),
    }.items():
        monkeypatch.setattr(torch.cuda, name, fake)
    model, seen = Line(), []
    learner = Learner(model, lr=1e-3)
    learner.capture = True

    def loss(batch: TensorDict) -> TensorDict:
        seen.append((batch["x"].stride(), batch["x"].data_ptr(), batch["x"][0, 0].item()))
        return Line.loss(model, batch)

    learner._loss = loss
    for k in range(Learner.EAGER_UPDATES + 2):
        one = torch.full((4, 1), float(k)).expand(
            4, 2
        )  # as one later frame stands for every step of a window
        learner.update(TensorDict({"x": one}, batch_size=[4, 2]))
    assert len({(strides, memory) for strides, memory, _ in seen}) == 1
    assert [value for *_, value in seen] == [float(k) for k in range(Learner.EAGER_UPDATES + 1)]
    assert learner._batch is not None and learner._batch["x"][0, 0].item() == Learner.EAGER_UPDATES + 1


def test_every_part_of_the_world_model_moves(settled, small_env) -> None:
    cfg = settled("scale=smoke", "device=cpu")
    torch.manual_seed(0)
    model = build.make_model(cfg, small_env(2))
    learner = Learner(model, lr=1e-3)
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    data = TensorDict(
        {
            "state": torch.randn(16, 3, 20),
            "joint_target": torch.randn(16, 3, 7),
            "action": torch.rand(16, 3, 7) * 2 - 1,
            "next": TensorDict(
                {
                    "state": torch.randn(16, 3, 20),
                    "joint_target": torch.randn(16, 3, 7),
                    "reward": -torch.rand(16, 3, 1),
                    "terminated": torch.zeros(16, 3, 1, dtype=torch.bool),
                },
                batch_size=[16, 3],
            ),
        },
        batch_size=[16, 3],
    )
    for _ in range(3):
        learner.update(data)
    metrics = learner.metrics()
    assert all(torch.tensor(value).isfinite() for value in metrics.values())
    still = [
        name
        for name, p in model.named_parameters()
        if p.requires_grad and torch.equal(p.detach(), before[name])
    ]
    assert not still


def test_schedule() -> None:
    """Up over the warm-up, down to zero along a cosine; the optimiser is given these rates."""
    learner = Learner(Line(), lr=0.1, schedule="cosine", warmup=10, total_updates=110)
    assert learner.rate(0) == pytest.approx(0.1)
    assert learner.rate(9) == pytest.approx(1.0)
    assert learner.rate(60) == pytest.approx(0.5)
    assert learner.rate(110) == pytest.approx(0.0)
    shortest = Learner(Line(), lr=0.1, schedule="cosine", warmup=2, total_updates=3)
    assert shortest.rate(2) == pytest.approx(1.0) and shortest.rate(3) == pytest.approx(0.0)
    only_warm = Learner(Line(), lr=0.1, schedule="cosine", warmup=2, total_updates=2)
    assert only_warm.rate(2) == pytest.approx(1.0)
    assert (
        Learner(Line(), lr=0.1, schedule="cosine", total_updates=0).rate(0) == 1.0
    )  # a run that trains nothing
    assert Learner(Line(), lr=0.1).rate(0) == 1.0
    for _ in range(5):
        learner.update(batch(1.0))
    assert learner.optimizer.param_groups[0]["lr"] == pytest.approx(0.1 * 0.5)


def test_bfloat16_is_close_to_float32(settled, small_env) -> None:
    cfg = settled("scale=smoke", "device=cpu")

    def losses(precision: str) -> dict[str, float]:
        torch.manual_seed(0)
        learner = Learner(build.make_model(cfg, small_env(2)), precision=precision)
        generator = torch.Generator().manual_seed(0)

        def draw(*shape: int) -> torch.Tensor:
            return torch.randn(8, 3, *shape, generator=generator)

        after = {"state": draw(20), "joint_target": draw(7), "reward": -draw(1).abs()}
        after["terminated"] = torch.zeros(8, 3, 1, dtype=torch.bool)
        root = {"state": draw(20), "joint_target": draw(7), "action": draw(7).tanh()}
        data = TensorDict(root | {"next": TensorDict(after, batch_size=[8, 3])}, batch_size=[8, 3])
        learner.update(data)
        return learner.metrics()

    exact, low = losses("float32"), losses("bfloat16")
    for name in ("loss_consistency", "loss_reward"):
        assert low[name] == pytest.approx(exact[name], rel=0.05, abs=1e-3)
    assert all(torch.tensor(value).isfinite() for value in low.values())


@pytest.mark.parametrize("options", [{"precision": "int3"}, {"schedule": "up"}, {"schedule": "cosine"}])
def test_options_that_do_not_exist(options: dict[str, str]) -> None:
    with pytest.raises(UserError):
        Learner(Line(), **options)


CALLS = {"tdmpc2": {}, "dreamer": {"_embed": 2, "_step": 3, "_imagined_step": 4}}
"""Of one loss of three steps, where not one: Dreamer's step is called for the one before a window, and two in it."""
PARTED = {
    "tdmpc2": {"latent_dim": 16, "episode_length": 20},
    "dreamer": {
        "deter_dim": 16,
        "hidden_dim": 16,
        "codes": 3,
        "classes": 4,
        "blocks": 2,
        "burn_in": 1,
        "imagination": 4,
    },
}


@pytest.mark.parametrize("family", PARTED)
def test_parts_of_a_loss_are_compiled_one_by_one(family: str, monkeypatch, capsys) -> None:
    """Numbers are the same. As one program TD-MPC2 would not run side by side, Dreamer's steps compile for minutes."""
    torch.manual_seed(0)
    model: Any = models.make(family, observation_sizes={"state": 5}, action_dim=2, **PARTED[family])
    model.eval()  # no dropout: both losses draw the same
    before = copy.deepcopy(model.state_dict())
    compiled: list[str] = []
    called: Counter[str] = Counter()

    def noted(function: Any, *, dynamic: bool | None = None) -> Any:
        assert dynamic is False  # windows of images and those before them have two shapes, not any
        compiled.append(function.__name__)
        return lambda *inputs: (called.update([function.__name__]), function(*inputs))[1]

    monkeypatch.setattr(torch, "compile", noted)
    learner = Learner(model, compile=True)
    assert len(compiled) > 1 and tuple(compiled) == model.parts_of_loss
    data = TensorDict(
        {
            "state": torch.randn(4, 3, 5),
            "action": torch.rand(4, 3, 2) * 2 - 1,
            "is_init": torch.zeros(4, 3, 1, dtype=torch.bool),
            "next": TensorDict(
                {
                    "state": torch.randn(4, 3, 5),
                    "reward": torch.randn(4, 3, 1),
                    "terminated": torch.zeros(4, 3, 1, dtype=torch.bool),
                },
                batch_size=[4, 3],
            ),
        },
        batch_size=[4, 3],
    )
    torch.manual_seed(1)
    plain = model.loss(data)
    called.clear()
    torch.manual_seed(1)
    assert torch.equal(model.compiled_loss()(data)["loss"], plain["loss"])
    assert called == dict.fromkeys(model.parts_of_loss, 1) | CALLS[family]
    assert not vars(model).keys() & set(model.parts_of_loss)
    torch.manual_seed(1)
    learner.update(data)
    assert "compiling the loss …" in capsys.readouterr().out
    learner.update(data)
    assert not capsys.readouterr().out
    learner.metrics()
    torch.manual_seed(1)
    model.load_state_dict(before)
    learner.update(data)
    assert learner.metrics()["loss"] == pytest.approx(plain["loss"].item())


def test_a_loss_of_a_subclass_is_compiled_as_a_whole(monkeypatch) -> None:
    """The parts of the loss that it replaces are not those of its own."""

    class Other(models.family("tdmpc2")):
        def loss(self, batch: TensorDict) -> TensorDict:
            return TensorDict({"loss": self.policy_head.weight.sum()})

    monkeypatch.setattr(torch, "compile", lambda function: function.__name__)
    options: dict[str, Any] = {"observation_sizes": {"state": 5}, "action_dim": 2, **PARTED["tdmpc2"]}
    assert Other(**options).compiled_loss() == "loss"


def test_parts_that_an_instance_had_come_back_also_after_an_error(monkeypatch) -> None:
    monkeypatch.setattr(torch, "compile", lambda function, **_: function)
    options: dict[str, Any] = {"observation_sizes": {"state": 5}, "action_dim": 2, **PARTED["tdmpc2"]}
    model: Any = models.make("tdmpc2", **options)
    model._unroll = own = model._unroll
    with pytest.raises((ValueError, KeyError, AttributeError)):
        model.compiled_loss()(TensorDict({}, batch_size=[4, 3]))
    assert vars(model).keys() & set(model.parts_of_loss) == {"_unroll"} and model._unroll is own


def test_a_subclass_names_the_parts_of_its_own_loss(monkeypatch) -> None:
    class Other(models.family("tdmpc2")):
        parts_of_loss = ("_unroll",)

        def loss(self, batch: TensorDict) -> TensorDict:
            return TensorDict({"loss": self._unroll(batch)})

    compiled: list[str] = []
    monkeypatch.setattr(torch, "compile", lambda function, **_: compiled.append(function.__name__))
    options: dict[str, Any] = {"observation_sizes": {"state": 5}, "action_dim": 2, **PARTED["tdmpc2"]}
    Other(**options).compiled_loss()
    assert compiled == ["_unroll"]
    Other.parts_of_loss = ("_unrol",)
    with pytest.raises(UserError, match=r"Other\.parts_of_loss names _unrol, which is no method"):
        Other(**options).compiled_loss()


def test_a_batch_in_new_memory_is_captured_anew() -> None:
    """A replay that grew draws into other memory; frames of goals are views there, which nothing can be copied into."""
    learner = Learner(Line())
    first, second = (TensorDict({"x": torch.ones(4, 1).expand(4, 2)}, [4, 2]) for _ in range(2))
    assert learner._kept(first, True) is first
    learner._graph = graph = cast("torch.cuda.CUDAGraph", object())
    assert learner._kept(first, True) is first and learner._graph is graph
    assert learner._kept(second, True) is second and learner._graph is None


def test_all_of_a_batch_is_copied_into_the_memory_that_a_capture_reads() -> None:
    """Also what lies under `next`; what the first batch did not have is no part of it."""

    def steps(value: float) -> TensorDict:
        after = TensorDict({"x": torch.full((4, 2), value + 0.5)}, [4, 2])
        return TensorDict({"x": torch.full((4, 2), value), "next": after}, [4, 2])

    learner = Learner(Line())
    kept = learner._kept(steps(1.0), False)
    assert learner._kept(steps(2.0).set(("next", "y"), torch.zeros(4, 2)), False) is kept
    assert (kept == steps(2.0)).all()
    with pytest.raises(KeyError):  # rather than learned from with what a batch before had
        learner._kept(steps(3.0).exclude(("next", "x")), False)


def test_a_loss_of_another_form_is_told_in_one_line():
    class Plain(Line):
        def loss(self, batch):
            return super().loss(batch)["loss"]

    class Nameless(Line):
        def loss(self, batch):
            return super().loss(batch).select("x_mean")

    for model in (Plain(), Nameless()):
        name = type(model).__name__
        with pytest.raises(
            UserError, match=rf"{name}\.loss must return a TensorDict: loss, and numbers to log"
        ):
            Learner(cast(Any, model), lr=0.1).update(batch(1.0))


@pytest.mark.parametrize(
    ("entries", "says"),
    [
        (lambda loss: {"loss": loss.detach()}, "loss has no gradient; compute it without detach"),
        (lambda loss: {"loss": loss.expand(4)}, r"loss must be one number \(\), not \(4,\); take its mean"),
        (
            lambda loss: {"loss": loss, "more": torch.ones(2, 3)},
            r"more must be one number \(\), not \(2, 3\)",
        ),
    ],
)
def test_a_loss_that_cannot_be_learned_from_is_told_in_one_line(entries, says):
    class Own(Line):
        def loss(self, batch):
            return TensorDict(entries(super().loss(batch)["loss"]), [])

    with pytest.raises(UserError, match=rf"Own\.loss: {says}"):
        Learner(Own(), lr=0.1).update(batch(1.0))


@pytest.mark.parametrize(
    ("groups", "says"),
    [
        (lambda w: None, " must return a list of dicts with params, not NoneType"),
        (lambda w: {"params": [w]}, " must return a list of dicts with params, not dict"),
        (lambda w: [w], ": each group must be a dict whose params is a list of parameters"),
        (lambda w: [{"lr": 0.1}], ": each group must be a dict whose params"),
        (
            lambda w: [{"params": iter([w])}],
            ": each group must be a dict whose params",
        ),  # it can be read once
        (lambda w: [{"params": ["w"]}], ": each group must be a dict whose params"),
        (lambda w: [{"params": []}], ": there is no parameter to train"),
    ],
)
def test_groups_of_no_parameters_are_told_in_one_line(groups, says):
    class Own(Line):
        def parameter_groups(self, lr):
            return groups(self.w)

    with pytest.raises(UserError, match=rf"Own\.parameter_groups{says}"):
        Learner(Own())


def test_a_model_without_parameters_is_told_in_one_line():
    with pytest.raises(UserError, match=r"WorldModel\.parameter_groups: there is no parameter to train"):
        Learner(models.WorldModel())
