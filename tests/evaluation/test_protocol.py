"""The protocol on a trained agent: held out, the same twice, everything from the checkpoint alone."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from franka_wm.errors import UserError
from franka_wm.evaluation import diagnose
from franka_wm.evaluation.closed_loop import summarize
from franka_wm.evaluation.protocol import evaluate_agent, held_out_seeds, numbers_to_log
from franka_wm.evaluation.robustness import SHIFTS, UNSHIFTED, Shift, note, robustness, verdict
from franka_wm.evaluation.rollouts import (
    discounted_returns,
    encode_episodes,
    encoded_validly,
    gather_episodes,
    mixture,
)
from franka_wm.models import WorldModel
from franka_wm.policies.scripted import NoopPolicy, SmoothRandomPolicy
from franka_wm.report.diagnostics import evaluation_markdown
from franka_wm.seeding import seeded
from franka_wm.training.load import load_agent


def test_twice_gives_the_same_numbers(agent) -> None:
    """Planner and random policies draw random numbers; whatever was drawn in between does not matter."""
    first = evaluate_agent(agent, episodes=6)
    torch.rand(17)
    second = evaluate_agent(agent, episodes=6, timing=False)
    assert set(first.policies) == {"planner", "policy", "noop", "random", "ik"}
    assert first.policies == second.policies
    assert evaluation_markdown(first) == evaluation_markdown(second)
    for name, episodes in first.episodes.items():
        assert (episodes == second.episodes[name]).all(), name
    assert first.policies["random"] != first.policies["noop"]
    assert set(first.seconds) == set(first.policies) and second.seconds == {}


def test_an_agent_loaded_anew_gives_the_same_numbers(agent, run_folder: Path) -> None:
    again = load_agent(run_folder, num_envs=6, device="cpu", seed=0)
    expected = evaluate_agent(agent, episodes=6, timing=False)
    assert evaluate_agent(again, episodes=6, timing=False).policies == expected.policies


def test_one_planner_whoever_asks(run_folder: Path) -> None:
    """The end of a run, its curves and ``franka-wm evaluate`` play the same agent: equal to the last bit."""
    table = json.loads((run_folder / "evaluation.json").read_text())["policies"]
    again = load_agent(run_folder, num_envs=2, device="cpu", seed=5)
    assert evaluate_agent(again, episodes=2, timing=False).policies == table
    again.model.train()  # as it is while training
    told = numbers_to_log(again.env, {"planner": again.policies["planner"]})
    assert told["eval/planner/final_distance"] == table["planner"]["final_distance"]["mean"]
    assert told["eval/planner/success"] == table["planner"]["success"]["0.05"]["mean"]
    assert told["eval/planner/return"] == table["planner"]["return"]["mean"]


def test_torch_s_own_random_numbers_are_left_alone(agent) -> None:
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    evaluate_agent(agent, episodes=2, policies={"random": agent.policies["random"]}, timing=False)
    assert torch.equal(torch.rand(3), expected)


def test_more_episodes_than_worlds_are_played_in_rounds(agent) -> None:
    noop = {"noop": agent.policies["noop"]}
    evaluation = evaluate_agent(agent, episodes=15, policies=noop, timing=False)
    rows = evaluation.episodes["noop"]
    assert evaluation.policies["noop"]["episodes"] == len(rows) == 15
    assert evaluation.seeds == held_out_seeds(3) and len(set(evaluation.seeds)) == 3
    assert rows["final_distance"].unique().numel() == 15  # no episode twice
    one = evaluate_agent(agent, episodes=6, seeds=[held_out_seeds(2)[1]], policies=noop, timing=False)
    assert torch.equal(one.episodes["noop"]["final_distance"], rows["final_distance"][6:12])
    assert summarize(rows) == evaluation.policies["noop"]


def test_fewer_episodes_than_worlds_are_the_first_and_only_they_are_decided_for(agent) -> None:
    """While training: planning takes its time. A policy that carries entries along (plans) keeps its own."""
    planner = agent.policies["planner"]
    asked = []
    handle = planner.register_forward_pre_hook(lambda module, inputs: asked.append(inputs[0].batch_size[0]))
    few = evaluate_agent(agent, episodes=2, policies={"planner": planner}, timing=False)
    handle.remove()
    assert set(asked) == {2} and len(asked) == agent.env.config.episode_length
    alone = load_agent(agent.folder, num_envs=2, device="cpu")
    same = evaluate_agent(alone, episodes=2, policies={"planner": alone.policies["planner"]}, timing=False)
    assert few.policies == same.policies and few.policies["planner"]["episodes"] == 2
    noop = {"noop": agent.policies["noop"]}
    every, some = (evaluate_agent(agent, episodes=n, policies=noop, timing=False) for n in (6, 4))
    assert (every.episodes["noop"][:4] == some.episodes["noop"]).all()
    assert "eval/noop/success" in numbers_to_log(agent.env, noop, episodes=500)  # more than there are: all


def test_what_cannot_be_evaluated(agent) -> None:
    with pytest.raises(UserError, match="episodes=1"):
        evaluate_agent(agent, episodes=1)
    with pytest.raises(UserError, match="3 rounds"):
        evaluate_agent(agent, episodes=13, seeds=[1, 2])


def test_the_table_names_its_intervals(agent) -> None:
    noop = {"noop": agent.policies["noop"]}
    text = evaluation_markdown(evaluate_agent(agent, episodes=6, policies=noop, timing=False))
    for word in ("noop: does nothing", "6 episodes", "bootstrap", "Wilson", str(held_out_seeds(1)[0])):
        assert word in text, word


def test_every_generator_inside_a_policy_is_seeded() -> None:
    hidden = SmoothRandomPolicy(generator=torch.Generator().manual_seed(9))
    outer = torch.nn.ModuleList([NoopPolicy(), hidden])
    draws = []
    for _ in range(2):
        with seeded(4, outer):
            draws.append(torch.randn(3, generator=hidden.generator))
    assert torch.equal(*draws)


# -- held-out episodes -------------------------------------------------------------------------------------


def test_half_at_random_half_by_the_model(agent) -> None:
    episodes, pictures = gather_episodes(
        agent.env, mixture(agent.policies, agent.env), keys=["state", "joint_target"], image_size=32, images=3
    )
    assert episodes.batch_size == (6, 12) and pictures is not None
    assert pictures.shape == (3, 12, 32, 32, 3) and pictures.float().std() > 10
    again, _ = gather_episodes(agent.env, mixture(agent.policies, agent.env), keys=["state"])
    assert torch.equal(episodes["action"], again["action"])
    # Odd worlds do what the model's policy does, even ones do not.
    with torch.no_grad():
        wanted = agent.model.policy(agent.model.encode(episodes), deterministic=True)
    torch.testing.assert_close(episodes["action"][1::2], wanted[1::2])
    assert (episodes["action"][::2] - wanted[::2]).abs().mean() > 0.1
    assert episodes["valid"].all()
    torch.testing.assert_close(episodes["physical"][:, 1:], episodes["next", "physical"][:, :-1])


def test_worlds_that_nobody_looks_at_are_not_kept(agent) -> None:
    keys = list(agent.model.observation_sizes)
    whole, _ = gather_episodes(agent.env, agent.policies["random"], keys=keys)
    part, _ = gather_episodes(agent.env, agent.policies["random"], keys=keys, keep=2)
    assert part.batch_size == (2, 12) and whole.batch_size == (6, 12)
    for key, values in part.items(True, True):
        assert torch.equal(values, whole[key][:2]), key
    more, _ = gather_episodes(agent.env, agent.policies["random"], keys=keys, keep=60, steps=1)
    assert more.batch_size == (6, 1)


def test_the_diagnostics_keep_what_they_look_at(agent, monkeypatch) -> None:
    kept = []

    def gathered(env, policy, *, keep=None, images=0, **options):
        kept.append(keep)
        return gather_episodes(env, policy, keep=keep, images=images, **options)

    monkeypatch.setattr(diagnose, "gather_episodes", gathered)
    monkeypatch.setattr(diagnose, "EPISODES", 4)
    held = diagnose.hold_out(agent, images=False)
    assert held.episodes.batch_size == (4, 12) and held.latents.shape[:2] == held.valid.shape == (4, 13)
    latents, images = diagnose._starts(agent, decoder_size=16)
    assert len(latents) == len(images) == 6 * 6 * 8 and kept == [4] + [6] * 6


def test_latents_of_whole_episodes(agent) -> None:
    keys = list(agent.model.observation_sizes)
    episodes, _ = gather_episodes(agent.env, agent.policies["random"], keys=keys)
    latents = encode_episodes(agent.model, episodes, chunk=7)
    assert latents.shape == (6, 13, agent.model.latent_dim)
    with torch.no_grad():
        torch.testing.assert_close(latents[:, :-1], agent.model.encode(episodes))
        torch.testing.assert_close(latents[:, 1:], agent.model.encode(episodes["next"]))
    assert encoded_validly(episodes).shape == (6, 13)


def test_a_model_with_memory_sees_its_episode_from_the_beginning(agent) -> None:
    """Its latent counts the steps: 0 where it encodes afresh, one more at every observation."""

    class Counting(WorldModel):
        observation_sizes = {"state": 20}

        def encode(self, observation):
            return torch.zeros(*observation.batch_size, 1)

        def observe(self, observation, previous_z, action, is_init):
            return previous_z + 1

    model = Counting()
    episodes, _ = gather_episodes(agent.env, agent.policies["noop"], keys=["state"])
    latents = encode_episodes(model, episodes)
    assert torch.equal(latents[..., 0], torch.arange(13.0).expand(6, 13))


def test_discounted_returns_by_hand() -> None:
    reward = torch.tensor([1.0, 2.0, 4.0, 8.0]).view(1, 4, 1)
    ended = torch.tensor([False, True, False, False]).view(1, 4, 1)
    never = torch.zeros_like(ended)
    assert discounted_returns(reward, never, 0.5).flatten().tolist() == [4.0, 6.0, 8.0, 8.0]
    assert discounted_returns(reward, ended, 0.5).flatten().tolist() == [2.0, 2.0, 8.0, 8.0]


# -- robustness --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_what_a_shift_does(agent) -> None:
    """The oracle aims with the servo's own targets: joint noise does not touch it, delay does."""
    shifts = {
        "late": Shift({"action_latency": 10}),
        "unseen": Shift({"observation_noise": 0.05}),
        "looks": SHIFTS["colours ± 0.3"],
    }
    told = []
    results = robustness(
        agent, episodes=8, shifts=shifts, policies=["ik"], report=lambda case, r: told.append(case)
    )
    assert told == list(results) == [UNSHIFTED, "late", "unseen"]  # the model reads no pictures
    plain, late, unseen = (results[case]["ik"] for case in results)
    assert plain["change"] is None and plain["verdict"] == ""
    assert late["change"]["low"] > 0.01 and late["verdict"] in ("worse", "breaks")
    assert unseen["final_distance"] == plain["final_distance"] and unseen["verdict"] == "holds"
    assert unseen["change"] == {"mean": 0.0, "low": 0.0, "high": 0.0}  # the very same episodes


@pytest.mark.parametrize(
    ("unshifted", "grown", "says"),
    [
        (1.06, 0.0, "never worked"),  # an untrained planner, a metre away
        (1.06, 0.2, "never worked"),
        (0.0, 2e-5, "holds"),  # surely further away, by 0.02 mm
        (0.02, 0.004, "holds"),
        (0.02, 0.006, "worse"),
        (0.049, 0.002, "breaks"),  # hardly further away, but all successes are gone
        (0.02, 0.2, "breaks"),
        (0.02, -0.01, "holds"),
    ],
)
def test_verdicts(unshifted: float, grown: float, says: str) -> None:
    before = torch.full((40,), unshifted)
    assert judged(before + grown, before) == says


def judged(after: torch.Tensor, before: torch.Tensor) -> str:
    played, then = (
        TensorDict(
            {"final_distance": x, "success": (x < 0.05).float(), "cut_short": torch.zeros(len(x))}, [len(x)]
        )
        for x in (after, before)
    )
    return verdict(played, then)


def test_a_few_lost_successes_are_worse_only_if_they_are_more_than_luck_and_2_percent() -> None:
    before = torch.full((400,), 0.0499)
    for lost, says in ((6, "holds"), (40, "worse"), (300, "breaks")):
        after = before.clone()
        after[:lost] = 0.0501
        assert judged(after, before) == says


def test_a_policy_that_works_in_a_tenth_of_the_episodes_works() -> None:
    before = torch.full((40,), 0.5)
    before[:4] = 0.01
    assert judged(before, before) == "holds"
    before[0] = 0.5
    assert judged(before, before) == "never worked"


def test_few_episodes_are_noted() -> None:
    assert "only 8 episodes" in note(8) and "only 19" in note(19)
    assert note(20) == ""


def test_what_cannot_be_shifted(agent) -> None:
    with pytest.raises(UserError, match="no policy 'nobody'"):
        robustness(agent, policies=["nobody"])
    with pytest.raises(UserError, match="only the arm"):
        robustness(SimpleNamespace(env=object()))
    with pytest.raises(UserError, match="episodes=1"):
        robustness(agent, episodes=1)
