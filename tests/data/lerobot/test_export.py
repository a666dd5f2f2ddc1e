"""The end of a run that exports: what it finds of itself when it goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import huggingface_hub
import numpy as np
import pytest
import torch
from huggingface_hub import constants
from tensordict import TensorDict

from fake_hub import TOKEN, Hub
from franka_wm.commands.main import main
from franka_wm.data.lerobot import export, publish
from franka_wm.data.lerobot.export import (
    check_export,
    check_export_place,
    export_replay,
    export_run,
    written_before,
)
from franka_wm.data.lerobot.provenance import describe
from franka_wm.data.lerobot.schema import ACTION, PROVENANCE
from franka_wm.envs import FrankaConfig
from franka_wm.envs.discretize import discrete_action_table
from franka_wm.errors import UserError
from franka_wm.training.checkpoint import save_checkpoint

RUN: dict[str, Any] = {
    "resume": None,
    "device": "cpu",
    "seed": 0,
    "trainer": {"updates": 4},
    "model": {"name": "tdmpc2", "value_low": None},
    "export": {"kind": "lerobot", "out": None, "format": "exact", "repo_id": None},
    "env": {"kind": "franka", "image_size": 16},
}


def test_a_dataset_is_that_of_the_run_which_goes_on(tmp_path: Path, make_schema, make_episode, write) -> None:
    schema = make_schema()
    out = write(
        tmp_path / "set",
        schema,
        [make_episode(schema, 0)],
        provenance=describe(policy="p", seed=0, config=RUN),
    )
    again = RUN | {"resume": "run", "device": "cuda", "model": {"name": "tdmpc2", "value_low": -3.2}}
    exports = {"export": RUN["export"] | {"out": str(out)}}
    assert written_before(again, out) and not written_before(again, tmp_path / "none")
    assert written_before(
        again | {"export": RUN["export"] | {"repo_id": "user/set"}}, out
    )  # where it goes then
    # From the beginning, farther, and of another family.
    for other in (RUN, again | {"trainer": {"updates": 8}}, again | {"model": {"name": "dreamer"}}):
        assert not written_before(other, out)
        with pytest.raises(UserError, match=r"export\.out=.*set exists"):
            check_export(other | exports)
        with pytest.raises(UserError, match=r"set exists, from another run or from this one"):
            check_export_place(other, out)
    check_export_place(again, out)
    check_export_place(RUN, tmp_path / "none")
    for damaged in ("{}", '{"sessions": 3}', '{"sessions": [{}]}'):
        (out / PROVENANCE).write_text(damaged)
        with pytest.raises(UserError, match=r"another form than was written.*choose another export\.out"):
            written_before(again, out)


def test_a_dataset_that_was_published_is_not_published_again(
    hub: Hub, monkeypatch, tmp_path: Path, make_schema, make_episode, write, capsys
) -> None:
    """A run that dies after it has published, and goes on, is neither refused by its own repository nor sent twice."""
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    api = huggingface_hub.HfApi(endpoint=hub.url, token=TOKEN)
    monkeypatch.setattr(publish, "hub_client", lambda repo_id: api)
    demos = {"replay": {"demos": str(tmp_path / "shown")}}  # a path, which is not published whole
    run = RUN | demos | {"export": RUN["export"] | {"repo_id": "user/set"}}
    schema = make_schema()
    write(
        tmp_path / "dataset",
        schema,
        [make_episode(schema, 0)],
        provenance=describe(policy="p", seed=0, config=run),
    )
    again = run | {"resume": str(tmp_path)}
    assert export_run(again, None, folder=tmp_path, actor="policy") is None  # it had died before it published
    repo = hub.repos["datasets/user/set"]
    sent, tag = repo["commits"], dict(repo["tags"])
    assert tag and "published:" in capsys.readouterr().out
    for tags in (dict(tag), {}):  # killed after all, and before the tag
        repo["tags"] = tags
        export_run(again, None, folder=tmp_path, actor="policy")
        assert "user/set was published before" in capsys.readouterr().out
        assert repo["commits"] == sent and repo["tags"] == tag
    monkeypatch.setattr(export, "written_before", lambda *_: True)
    for other in (
        run,
        again | {"trainer": {"updates": 8}},
    ):  # from the beginning, and farther: another dataset
        with pytest.raises(UserError, match="user/set exists already"):
            export_run(other, None, folder=tmp_path, actor="policy")
    assert repo["commits"] == sent
    repo["files"][PROVENANCE] = b'{"sessions": [{}]}'
    repo["commits"] += 1
    with pytest.raises(UserError, match=r"user/set.*choose another export\.repo_id"):
        export_run(again, None, folder=tmp_path, actor="policy")


def test_a_run_without_experience_says_why(tmp_path: Path) -> None:
    for resume, says in ((None, "that it was trained on"), ("run", r"trainer\.checkpoint_replay=true")):
        with pytest.raises(UserError, match=rf"has gathered nothing.*{says}"):
            export_run(RUN | {"resume": resume}, None, folder=tmp_path, actor="policy")


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"env": {"kind": "multitask", "tasks": {}}}, "several tasks at once"),
        ({"env": {"kind": "none"}, "dataset": {"kind": "lerobot"}}, "learned from recorded episodes"),
        ({"dataset": {"kind": "lerobot"}}, "learned from recorded episodes"),
        ({"env": {"kind": "gym"}, "dataset": {"kind": "none"}}, "is not the arm"),
    ],
)
def test_what_has_no_dataset_says_why(other: dict[str, Any], says: str, tmp_path: Path, capsys) -> None:
    """Whether a replay was saved or not: a run on recorded data was told to save one."""
    save_checkpoint(tmp_path / "run", model=torch.nn.Linear(2, 2), config=RUN | other, counters={})
    assert main(["export", f"source={tmp_path / 'run'}", f"out={tmp_path / 'set'}"]) == 1
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1 and not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("repo_id", "offline", "token", "says"),
    [
        ("set", False, "hf_x", r"must be user/name"),
        ("user/set", True, "hf_x", "HF_HUB_OFFLINE is set"),
        ("user/set", False, None, "no token for the Hub"),
        ("user/set", False, "hf_x", None),
    ],
)
def test_what_cannot_be_published_is_said_before_the_run(repo_id, offline, token, says, monkeypatch) -> None:
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", offline)
    monkeypatch.setattr(huggingface_hub, "get_token", lambda: token)
    run = RUN | {"export": RUN["export"] | {"repo_id": repo_id}}
    if says is None:
        return check_export(run)
    with pytest.raises(UserError, match=rf"export\.repo_id={repo_id}: .*{says}") as refused:
        check_export(run)
    assert "\n" not in str(refused.value)
    return None


def test_discrete_actions_are_stored_with_what_they_tell_the_fingers(tmp_path: Path, load) -> None:
    config = FrankaConfig(task="push", episode_length=5, observations=("state", "objects"))
    sizes = {"state": 28, "objects": 13, "goal": 3}
    seen = {key: torch.zeros(1, 5, size) for key, size in sizes.items()}
    flag = torch.zeros(1, 5, 1, dtype=torch.bool)
    after = {**seen, "reward": torch.zeros(1, 5, 1), "terminated": flag}
    moves = torch.tensor([[3, 14, 18, 29, 0]])
    starts = torch.tensor([True, False, False, False, False]).view(1, 5, 1)
    data = TensorDict({**seen, "action": moves, "is_init": starts, "next": after}, batch_size=[1, 5])
    told: dict[str, Any] = {"seed": 0, "policy": "p", "settings": {}, "workers": 0}
    dataset = load(export_replay(data, config=config, out=tmp_path / "set", **told).out)
    stored = np.stack([dataset[k][ACTION].numpy() for k in range(5)])
    assert np.array_equal(stored, discrete_action_table(8, gripper=True)[moves[0]].numpy())
    assert stored[:, 7].tolist() == [1.0, 1.0, -1.0, -1.0, 1.0]


def test_the_command_of_one_of_several_processes_can_be_typed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["/site/franka_wm/__main__.py", "collect", "env.cameras=[front, wrist]"])
    assert (
        describe(policy="p", seed=1, config={})["command"] == "franka-wm collect 'env.cameras=[front, wrist]'"
    )
    assert describe(policy="p", seed=1, config={}, command="mine")["command"] == "mine"
