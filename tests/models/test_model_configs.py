"""Each picture family's file in conf/model mirrors its constructor."""

import inspect
from importlib import import_module

import pytest
from omegaconf import OmegaConf

from franka_wm.conf import FOLDER, compose
from franka_wm.models import _FAMILIES

# Known at run time only, or there to rebuild a model from its own checkpoint.
NOT_IN_FILES = {
    "self",
    "image_sizes",
    "observation_sizes",
    "action_dim",
    "episode_length",
    "reward_bounds",
    "action_masks",
    "terminates",
    "encoder_architecture",
    "huggingface_config",
}


NOT_AS_PUBLISHED = {
    "lewm": {"encoder_depth", "predictor_depth", "predictor_heads", "predictor_mlp", "inverse_coef"},
    "dreamer": {"actor_gradient", "actor_critic_lr_scale", "burn_in"},
    "dreamer_pixels": {"burn_in", "vector_coef"},
    "tdmpc2_pixels": {"random_shift", "entropy_coef", "mode_targets"},
}
"""What a run on a GPU takes otherwise, to learn more in its minutes."""


@pytest.mark.parametrize(
    "file",
    [
        "jepa",
        "vjepa",
        "lejepa",
        "lewm",
        "action_world_model",
        "tdmpc2_pixels",
        "dreamer",
        "dreamer_pixels",
        "dino_wm",
    ],
)
def test_the_file_names_every_hyper_parameter_with_its_default(file):
    assert (FOLDER / "model" / f"{file}.yaml").read_text(encoding="utf-8").startswith("# ")
    cfg = compose(f"model={file}", "scale=gpu")
    values = dict(OmegaConf.to_container(cfg.model, resolve=True))
    module, cls, _ = _FAMILIES[values.pop("name")]
    for known in ("observations", "window", "lr"):
        values.pop(known)
    for known in ("schedule", "warmup"):
        values.pop(known, None)
    signature = inspect.signature(getattr(import_module(module), cls).__init__)
    defaults = {k: p.default for k, p in signature.parameters.items() if k not in NOT_IN_FILES}
    assert set(values) == set(defaults)
    if "recipe" in values:
        assert values.pop("recipe") == ("ijepa" if file == "jepa" else file)
        defaults.pop("recipe")
    others = set()
    for name, default in defaults.items():
        value = tuple(values[name]) if isinstance(values[name], list) else values[name]
        if value != default:
            others.add(name)
    assert others == NOT_AS_PUBLISHED.get(file, set())
