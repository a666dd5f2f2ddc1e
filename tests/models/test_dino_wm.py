"""DINO-WM on a small random encoder: its patches stay, what the predictor may see, what it learns."""

import pytest
import torch
from tensordict import TensorDict

from franka_wm.errors import UserError
from franka_wm.models import make
from franka_wm.models.dino_wm import DINOWM
from franka_wm.models.windows import window_of

DINO = dict(model_type="dinov2", hidden_size=16, num_hidden_layers=1, num_attention_heads=2, image_size=28)
DINO |= dict(patch_size=7, mlp_ratio=2)
SMALL = dict(
    action_dim=2,
    huggingface_config=DINO,
    grid=2,
    predictor_depth=1,
    predictor_heads=2,
    predictor_head_dim=8,
    predictor_mlp=32,
    dropout=0.0,
)


@pytest.fixture(autouse=True)
def _seed():
    pytest.importorskip("transformers")
    torch.manual_seed(0)


def small(**overrides) -> DINOWM:
    return make("dino_wm", **{"image_sizes": {"pixels": (16, 16, 3)}, **SMALL, **overrides})  # type: ignore[return-value]


def randomise(model: DINOWM) -> DINOWM:
    with torch.no_grad():
        model.leave.weight.normal_(std=0.3)
    return model


def test_the_encoder_stays_as_it_is_and_needs_no_file_to_be_rebuilt(dots):
    model = randomise(small())
    before = {name: value.clone() for name, value in model.encoder.state_dict().items()}
    optimiser = torch.optim.AdamW(model.parameter_groups(1e-2))
    model.loss(dots.windows(4, 3))["loss"].backward()
    optimiser.step()
    assert all(torch.equal(value, before[name]) for name, value in model.encoder.state_dict().items())
    assert not any(module.training for module in model.train().encoder.modules())
    trained = {id(p) for group in model.parameter_groups(1.0) for p in group["params"]}
    own = {id(p) for p in model.encoder.parameters()}
    assert not trained & own and trained | own == {id(p) for p in model.parameters()}
    assert {g["weight_decay"] for g in small(weight_decay=0.3).parameter_groups(1.0)} == {0.3, 0.0}
    assert all(p.grad is not None for p in model.parameters() if p.requires_grad)
    again = small(**{**model.rebuild_overrides(), "grid": 2})
    again.load_state_dict(model.state_dict())
    batch = dots.windows(2, 1)[:, 0]
    assert torch.equal(again.encode(batch), model.encode(batch))


def test_a_hugging_face_model_by_name_and_an_encoder_of_ones_own(tmp_path, dots):
    transformers = pytest.importorskip("transformers")
    settings = {key: value for key, value in DINO.items() if key != "model_type"}
    transformers.Dinov2Model(transformers.Dinov2Config(**settings)).save_pretrained(tmp_path / "dino")
    model = small(
        huggingface_config=None, huggingface=str(tmp_path / "dino"), local_files_only=True, grid=None
    )
    assert model.patches == 16 and model.patch_dim == 16
    assert model.encode_goal(dots.windows(2, 1)[:, 0]).shape == (2, 16 * 16)
    with pytest.raises(ValueError, match="it needs a pretrained encoder"):
        small(huggingface_config=None)
    with pytest.raises(UserError, match=r"model\.predictor_mlp=0"):
        DINOWM.validate({"predictor_mlp": 0})


def test_without_training_nothing_changes_and_goals_are_compared_on_patches(dots):
    model = small(observation_sizes={"position": 2})
    window = dots.windows(3, 2)
    z = model.encode(window[:, 0])
    after = model.next(z, window["action"][:, 0])
    torch.testing.assert_close(model.history.last(after), model.history.last(z))
    torch.testing.assert_close(model.embed(z), model.encode_goal(window[:, 0]))
    torch.testing.assert_close(model.history.last(z)[:, -2:], window["position"][:, 0])
    assert model.loss(window)["relative_error"] == 1.0
    still = window.clone()
    for frames in (still, still["next"]):
        frames["pixels"] = torch.full_like(frames["pixels"], 7)
    assert model.loss(still)["relative_error"] == 0.0
    with torch.no_grad():
        model.leave.bias[-2:] = 0.5  # of the state
    both, actions = torch.stack((z, z)), torch.stack((window["action"][:, 0],) * 2)
    after = model.next(both, actions)
    assert after.shape == both.shape
    torch.testing.assert_close(model.history.last(after)[1, :, -2:], window["position"][:, 0] + 0.5)


def test_every_patch_sees_action_and_state_and_no_later_frame(dots):
    model = randomise(small(observation_sizes={"position": 2}))
    frames = model.encode_frame(dots.windows(3, 3)).float()
    actions = torch.rand(3, 3, 2)
    predicted = model._predict(frames, actions, None)

    def changed(frames, actions) -> torch.Tensor:
        """(frame, patch) whose prediction differs."""
        delta = (model._predict(frames, actions, None) - predicted)[..., : model.feature_dim].abs()
        return (delta.unflatten(-1, (model.patches, -1)).amax((0, -1)) > 1e-7).cpu()

    other = actions.clone()
    other[:, 1] += 0.5
    assert torch.equal(changed(frames, other), torch.tensor([[False] * 4, [True] * 4, [True] * 4]))
    moved = frames.clone()
    moved[:, 1, model.feature_dim :] += 0.5
    assert torch.equal(changed(moved, actions), torch.tensor([[False] * 4, [True] * 4, [True] * 4]))
    # A short history predicts as a window that starts there.
    z = model.history.start(frames[:, 0])
    torch.testing.assert_close(model.history.last(model.next(z, actions[:, 0])), predicted[:, 0])
    z = model.history.push(z, actions[:, 0], frames[:, 1])
    torch.testing.assert_close(model.history.last(model.next(z, actions[:, 1])), predicted[:, 1])


def test_the_loss_is_the_squared_error_of_the_next_patches_and_state(dots):
    model = randomise(small(observation_sizes={"position": 2})).eval()
    window = dots.windows(4, 3)
    losses = model.loss(window)
    now, after = model.encode_frame(window), model.encode_frame(window["next"])
    predicted = model._predict(now, window["action"], None)
    f = model.feature_dim
    patches = (predicted - after)[..., :f].square().mean()
    state = (predicted - after)[..., f:].square().mean()
    torch.testing.assert_close(losses["loss_prediction"], patches)
    torch.testing.assert_close(losses["loss_state"], state)
    torch.testing.assert_close(losses["loss"], patches + state)
    # Windows longer than the history are cut into all runs of its length.
    window = dots.windows(4, 4)
    frames = model.encode_frame(window_of(window, model.observation_keys))
    runs = []
    for start in (0, 1):
        part, actions = frames[:, start : start + 4], window["action"][:, start : start + 3]
        runs.append((model._predict(part[:, :-1], actions, None) - part[:, 1:])[..., :f].square().mean())
    torch.testing.assert_close(model.loss(window)["loss_prediction"], torch.stack(runs).mean())


def test_it_learns_where_the_dot_goes(dots):
    model = small(predictor_depth=2, predictor_head_dim=16, predictor_mlp=64, grid=4)
    optimiser = torch.optim.AdamW(model.parameter_groups(3e-3))
    for _ in range(150):
        losses = model.loss(dots.windows(32, 3))
        optimiser.zero_grad()
        losses["loss"].backward()
        optimiser.step()
    assert losses["relative_error"] < 0.5
    # The right action leads nearer to the goal's patches than others do.
    window = dots.windows(64, 1)
    z, goal = model.encode(window[:, 0]), model.encode_goal(window["next"][:, 0])
    with torch.no_grad():
        right = (model.embed(model.next(z, window["action"][:, 0])) - goal).square().mean(-1)
        wrong = (model.embed(model.next(z, -window["action"][:, 0])) - goal).square().mean(-1)
    assert (right < wrong).float().mean() > 0.8


def test_no_constant_is_added_to_a_loss_of_one_term(dots):
    """See `summed`: compiled, it would have no gradient."""
    loss = small().loss(dots.windows(4, 3))["loss"]
    assert loss.grad_fn is not None and "Add" not in loss.grad_fn.name()


def test_the_loss_traces_without_graph_breaks_or_host_reads(dots):
    model, batch = small(), dots.windows(4, 3)

    def loss(pixels, last, action):
        return model.loss(TensorDict({"pixels": pixels, "action": action, "next": {"pixels": last}}, [4, 3]))[
            "loss"
        ]

    traced = torch.compile(loss, backend="eager", fullgraph=True)
    inputs = (batch["pixels"], batch["next", "pixels"], batch["action"])
    torch.testing.assert_close(traced(*inputs), loss(*inputs))
