"""Publishing trained models, and reading what others have published; the Hub is that of conftest.py."""

from __future__ import annotations

import json

import pytest
import torch

from franka_wm.data.lerobot.hub import check_repo_id, explained
from franka_wm.errors import UserError
from franka_wm.training.checkpoint import load_checkpoint, save_checkpoint
from franka_wm.training.publish import stage_model


@pytest.fixture
def run_folder(tmp_path):
    config = {
        "seed": 4,
        "resume": "/home/someone/run",
        "model": {"name": "tdmpc2", "encoder_from": "/home/someone/jepa"},
        "dataset": {"root": "/home/someone/set", "cache_dir": "~/someone/cache"},
        "env": {"kind": "franka", "urdf_path": "/home/someone/arm.urdf", "image_size": 64},
    }
    model = torch.nn.Linear(3, 2)
    save_checkpoint(
        tmp_path / "run" / "checkpoints" / "latest",
        model=model,
        optimizer=torch.optim.AdamW(model.parameters()),
        config=config,
        counters={"updates": 7, "env_steps": 70},
        extra={"spaces": {"action_dim": 2}, "rows": [1.0], "moment": {"worlds": torch.full((4,), 7.0)}},
    )
    (tmp_path / "run" / "config.yaml").touch()
    (tmp_path / "run" / "evaluation.md").write_text("| policy | distance |\n|---|---|\n| planner | 1 cm |\n")
    (tmp_path / "run" / "video.mp4").write_bytes(b"a film")
    return tmp_path / "run", model


def test_a_model_goes_without_what_only_training_needs(hub, publish, run_folder, tmp_path) -> None:
    folder, model = run_folder
    done = publish(f"checkpoint={folder}", "repo_id=user/model")
    assert done.returncode == 0, done.stderr
    repo = hub.repos["models/user/model"]
    assert repo["private"] is True
    assert set(repo["files"]) == {
        ".gitattributes",
        "README.md",
        "config.yaml",
        "counters.json",
        "evaluation.md",
        "extra.json",
        "extra.safetensors",
        "manifest.json",
        "model.safetensors",
        "video.mp4",
    }
    assert "planner | 1 cm" in repo["files"]["README.md"].decode()
    assert (
        'src="https://huggingface.co/user/model/resolve/main/video.mp4"'
        in repo["files"]["README.md"].decode()
    )
    assert b"someone" not in b"".join(repo["files"].values())
    assert "a simulated Franka arm" in repo["files"]["README.md"].decode()
    there = tmp_path / "there"
    there.mkdir()
    for name, content in repo["files"].items():
        (there / name).write_bytes(content)
    opened = load_checkpoint(there)  # its manifest fits
    copy = torch.nn.Linear(3, 2)
    opened.load_model(copy)
    assert torch.equal(copy.weight, model.weight)
    assert opened.extra() == {"spaces": {"action_dim": 2}}
    assert opened.counters == {"updates": 7, "env_steps": 70}


def test_a_models_card_has_the_newest_evaluation_and_the_right_world(tmp_path) -> None:
    worlds = [
        ({"kind": "gym", "name": "CartPole-v1"}, "`gym CartPole-v1`", "load_agent"),
        ({"kind": "none"}, "recorded episodes", "load_model"),
    ]
    for i, (env, says, use) in enumerate(worlds):
        run, place = tmp_path / f"run{i}", tmp_path / f"place{i}"
        config = {"seed": 4, "model": {"name": "dreamer"}, "env": env}
        save_checkpoint(
            run / "checkpoints" / "latest", model=torch.nn.Linear(3, 2), config=config, counters={}
        )
        (run / "config.yaml").touch()
        (run / "evaluation").mkdir()
        (run / "evaluation.md").write_text("the older numbers")
        (run / "evaluation" / "evaluation.md").write_text("the verb's numbers of /home/someone/run")
        (run / "evaluation" / "evaluation.json").write_text('{"checkpoint": "/home/someone/run"}')
        place.mkdir()
        stage_model(run, place, repo_id="user/model", license="mit")
        card = (place / "README.md").read_text()
        assert f"(dreamer) of {says}, trained" in card
        assert use in card
        assert "Franka arm, trained" not in card
        assert "- franka\n" not in card
        assert "the verb's numbers of run" in card
        assert "older" not in card
        assert json.loads((place / "evaluation.json").read_text()) == {"checkpoint": "run"}
        load_checkpoint(place)


TASKS = {"kind": "multitask", "tasks": {"reach": {}, "push": {}}}


@pytest.mark.parametrize(
    ("family", "env", "dataset", "says", "not_said"),
    [
        (
            "tdmpc2",
            TASKS,
            "none",
            ("of a simulated Franka arm in 2 tasks (reach, push)", "- franka\n", "70 environment steps"),
            ("`multitask`", "recorded episodes"),
        ),
        (
            "tdmpc2",
            {"kind": "franka"},
            "lerobot",
            ("7 updates on recorded episodes, seed", 'policies["planner"]', 'src="https'),
            ("environment steps",),
        ),
        (
            "jepa",
            {"kind": "franka"},
            "none",
            ("An encoder (jepa) for images of a simulated", "load_model(", "- encoder\n", "does not act"),
            ("world-model", "A latent world model", "policies[", "load_agent", "<video"),
        ),
        (
            "of_ones_own",
            {"kind": "dm_control", "name": "walker", "task": "run"},
            "none",
            ("A latent world model (of_ones_own) of `dm_control walker run`", 'policies["planner"]'),
            (),
        ),
    ],
)
def test_a_models_card_says_what_the_run_was(
    family: str, env: dict, dataset: str, says: tuple, not_said: tuple, run_folder, tmp_path
) -> None:
    """Several tasks, recorded data that trained without a step, and an encoder, which has no planner."""
    run, place = run_folder[0], tmp_path / "place"
    config = {"seed": 4, "model": {"name": family}, "env": env, "dataset": {"kind": dataset}}
    save_checkpoint(
        run / "checkpoints" / "latest",
        model=run_folder[1],
        config=config,
        counters={"updates": 7, "env_steps": 70},
    )
    place.mkdir()
    card = (stage_model(run, place, repo_id="user/model", license="mit") / "README.md").read_text()
    assert all(text in card for text in says), card
    assert not any(text in card for text in not_said), card
    assert "planner | 1 cm" in card


@pytest.mark.parametrize(("verbs", "shown"), [(3, "the run's"), (4, "the verb's")])
def test_of_two_evaluations_the_one_of_more_episodes_is_published(run_folder, tmp_path, verbs, shown) -> None:
    run, place = run_folder[0], tmp_path / "place"
    (run / "evaluation").mkdir()
    for folder, name, episodes in ((run, "the run's", 4), (run / "evaluation", "the verb's", verbs)):
        told = {"protocol": {}, "policies": {"planner": {"episodes": episodes}}}
        (folder / "evaluation.json").write_text(json.dumps(told))
        (folder / "evaluation.md").write_text(name)
    place.mkdir()
    stage_model(run, place, repo_id="user/model", license="mit")
    assert (place / "evaluation.md").read_text() == shown


def test_an_evaluation_of_other_weights_is_not_published(run_folder, tmp_path, capsys) -> None:
    """More episodes do not make up for it; where there is no other, none goes along, and a line says so."""
    run, place = run_folder[0], tmp_path / "place"
    counters = json.loads((run / "checkpoints" / "latest" / "counters.json").read_text())
    (run / "evaluation").mkdir()
    for folder, name, updates, episodes in (
        (run, "the last weights", counters["updates"], 4),
        (run / "evaluation", "half of them", counters["updates"] - 1, 9),
    ):
        told = {"protocol": {"updates": updates}, "policies": {"planner": {"episodes": episodes}}}
        (folder / "evaluation.json").write_text(json.dumps(told))
        (folder / "evaluation.md").write_text(name)
    place.mkdir()
    stage_model(run, place, repo_id="user/model", license="mit")
    assert (place / "evaluation.md").read_text() == "the last weights"
    for name in ("evaluation.json", "evaluation.md"):
        (run / name).unlink()
    (other := tmp_path / "other").mkdir()
    stage_model(run, other, repo_id="user/model", license="mit")
    assert not [*other.glob("evaluation.*")] and "is of other weights" in capsys.readouterr().out
    assert (place / "video.mp4").is_file()  # that of the run's own evaluation
    told = {"protocol": {"updates": counters["updates"] - 1}, "policies": {}}
    (run / "evaluation.json").write_text(json.dumps(told))
    (film := tmp_path / "film").mkdir()
    stage_model(run, film, repo_id="user/model", license="mit")
    assert not (film / "video.mp4").exists()


def test_a_staged_model_is_damaged_if_changed(run_folder, tmp_path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    stage_model(run_folder[0], place, repo_id="user/model", license="mit")
    manifest = json.loads((place / "manifest.json").read_text())
    assert set(manifest["files"]) >= {"model.safetensors", "config.yaml"}
    weights = bytearray((place / "model.safetensors").read_bytes())
    weights[-1] ^= 1
    (place / "model.safetensors").write_bytes(weights)
    with pytest.raises(UserError, match="damaged"):
        load_checkpoint(place)


def test_downloads_take_tensors_and_plain_values_only(monkeypatch, tmp_path) -> None:
    import huggingface_hub

    from franka_wm.data import lerobot
    from franka_wm.data.lerobot.hub import download_model

    assert lerobot.__all__ == [
        "open_dataset"
    ]  # beside it a name like `download` would be read as a dataset's

    asked = {}

    def snapshot(repo_id, **options):
        asked.update(options, repo_id=repo_id)
        return str(tmp_path)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot)
    with pytest.raises(UserError, match="holds no model"):
        download_model("user/model")
    (tmp_path / "manifest.json").write_text("{}")
    assert download_model("user/model@v1") == tmp_path
    assert asked["repo_id"] == "user/model"
    assert asked["revision"] == "v1"
    assert sorted(asked["allow_patterns"]) == ["*.json", "*.safetensors", "*.yaml"]
    for name in ("model", "../model", "user/../x", "https://x/y", ""):
        with pytest.raises(UserError, match="must be user/name"):
            check_repo_id(name)


def test_a_missing_repository_is_one_line() -> None:
    import httpx

    with pytest.raises(UserError, match="cannot be reached"), explained("user/name"):
        raise httpx.ConnectError("no route")


@pytest.mark.parametrize(
    "name", ["evaluation.md", "evaluation/evaluation.md", "checkpoints/latest/counters.json"]
)
def test_links_out_of_a_run_are_not_followed(name: str, run_folder, tmp_path) -> None:
    run, place, secret = run_folder[0], tmp_path / "place", tmp_path / "secret"
    place.mkdir()
    (run / name).parent.mkdir(exist_ok=True)
    secret.write_bytes((run / name).read_bytes() if (run / name).exists() else b"of this machine")
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(secret)
    with pytest.raises(UserError, match="is a link to"):
        stage_model(run, place, repo_id="user/model", license="mit")
    assert not (place / "evaluation.md").exists()
