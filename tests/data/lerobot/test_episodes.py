"""Whole episodes out of batches, whatever the batches' sizes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from franka_wm.data.lerobot.episodes import UNKNOWN_EPISODE, EpisodeCutter, cut_replay
from franka_wm.data.lerobot.schema import (
    ACTION,
    DONE,
    EPISODE_KEY,
    JOINTS,
    REWARD,
    SEED,
    STATE,
    SUCCESS,
    TERMINATED,
    TOOL,
    TRUNCATED,
    episode_key,
)
from franka_wm.data.lerobot.stats import aggregate, episode_stats
from franka_wm.errors import UserError

WORLDS, STEPS, LENGTH = 5, 60, 8


def stream(ends: np.ndarray, seed: int = 0) -> TensorDict:
    """(worlds, time) as a collector gives it, with an end wherever ``ends`` says so; values are all different."""
    rng = torch.Generator().manual_seed(seed)
    done = torch.as_tensor(ends).unsqueeze(-1)
    first = torch.ones_like(done)
    first[:, 1:] = done[:, :-1]

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*ends.shape, *shape, generator=rng)

    state, after = noise(20), noise(20)
    inside = ~done[:, :-1]  # o of the next step is what this one led to, except across an end
    state[:, 1:] = torch.where(inside, after[:, :-1], state[:, 1:])
    pixels = torch.randint(0, 255, (*ends.shape, 16, 16, 3), generator=rng, dtype=torch.uint8)
    late = torch.as_tensor(rng_bool(ends.shape, seed)).unsqueeze(-1)
    root = {"state": state, "joint_target": noise(7), "goal": noise(3), "pixels": pixels, "action": noise(7)}
    following = {
        "state": after,
        "joint_target": noise(7),
        "goal": noise(3),
        "pixels": pixels.flip(-1),
        "reward": noise(1),
        "done": done,
        "terminated": done & ~late,
        "truncated": done & late,
        "success": done & ~late,
    }
    return TensorDict(root | {"is_init": first, "next": following}, batch_size=ends.shape)


def rng_bool(shape, seed: int, share: float = 0.5) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < share


@pytest.mark.parametrize("sizes", [[60], [1] * 60, [7] * 8 + [4], [3, 40, 17]])
def test_cutting_does_not_depend_on_the_batches(sizes, make_schema) -> None:
    data = stream(rng_bool((WORLDS, STEPS), 3, 0.15))
    cutter = EpisodeCutter(make_schema(), seed=11)
    episodes, begin = [], 0
    for size in sizes:
        episodes += cutter.push(data[:, begin : begin + size])
        begin += size
    done = data["next", "done"][..., 0].numpy()
    expected = {}  # by a plain loop
    for world in range(WORLDS):
        start = number = 0
        for t in range(STEPS):
            if done[world, t]:
                expected[world, number] = (start, t + 1)
                start, number = t + 1, number + 1
    assert len(episodes) == len(expected)
    for episode in episodes:
        run, world, number = episode.rows[SEED][0]
        assert run == 11
        begin, end = expected.pop((int(world), int(number)))
        part = data[int(world), begin:end]
        for feature, key in ((STATE, "state"), (ACTION, "action"), ("observation.images.front", "pixels")):
            assert np.array_equal(episode.rows[feature], part[key].numpy())
        for feature in (REWARD, DONE, TERMINATED, TRUNCATED, SUCCESS):
            assert np.array_equal(episode.rows[feature], part["next", feature.removeprefix("next.")].numpy())
        assert np.array_equal(episode.terminal[STATE], part["next", "state"][-1].numpy())
        assert np.array_equal(
            episode.terminal["observation.images.front"], part["next", "pixels"][-1].numpy()
        )
        assert np.array_equal(episode.rows[JOINTS], episode.rows[STATE][:, :7])
        assert np.array_equal(episode.terminal[TOOL], episode.terminal[STATE][14:17])
        assert episode.key == episode_key(episode.rows)


def test_an_episode_whose_start_was_not_seen_is_left_out(make_schema) -> None:
    ends = np.zeros((2, 12), bool)
    ends[:, [3, 9]] = True
    data = stream(ends)
    data["is_init"][0, 0] = False
    cutter = EpisodeCutter(make_schema(), seed=0)
    lengths = [len(episode.rows[STATE]) for episode in cutter.push(data)]
    assert lengths == [4, 6, 6] and cutter.lost == 0


def test_episodes_without_numbers_are_the_same_but_for_that(make_schema) -> None:
    data = stream(rng_bool((2, STEPS), 3, 0.2))
    numbered = EpisodeCutter(make_schema(), seed=4).push(data)
    unknown = EpisodeCutter(make_schema(), seed=4, numbered=False).push(data)
    assert len(unknown) == len(numbered) > 10
    for one, other in zip(unknown, numbered, strict=True):
        assert [*one.rows] == [*other.rows] and one.key == episode_key(one.rows) != other.key
        assert (one.rows[SEED] == [4, other.rows[SEED][0, 1], UNKNOWN_EPISODE]).all()
        for feature in {*one.rows} - {SEED, EPISODE_KEY}:
            assert np.array_equal(one.rows[feature], other.rows[feature])


def test_what_is_lost_counts_for_its_own_episode_alone(make_schema) -> None:
    ends = np.zeros((1, 12), bool)
    ends[0, [3, 9]] = True
    for step, whole in ((3, [6]), (4, [4])):
        data = stream(ends)
        data["next", "overflow"] = torch.zeros(1, 12, 1, dtype=torch.bool)
        data["next", "overflow"][0, step] = True
        cutter = EpisodeCutter(make_schema(), seed=0)
        assert [len(episode.rows[STATE]) for episode in cutter.push(data)] == whole
        assert cutter.lost == 1


def test_keys_differ_even_where_numbers_agree(make_schema) -> None:
    data = stream(rng_bool((1, STEPS), 3, 0.2)).expand(3, STEPS)
    episodes = EpisodeCutter(make_schema(), seed=0).push(data.contiguous())
    assert len({episode.key for episode in episodes}) == len(episodes)


def test_moves_become_the_actions_they_stand_for(make_schema) -> None:
    from franka_wm.envs.discretize import discrete_action_table

    table = discrete_action_table(7)
    data = stream(rng_bool((2, STEPS), 3, 0.2))
    data["action"] = torch.randint(0, 15, (2, STEPS))
    episode = EpisodeCutter(make_schema(), seed=0, discrete=table).push(data)[0]
    world = int(episode.rows[SEED][0, 1])
    assert np.array_equal(episode.rows[ACTION], table[data["action"][world, : episode.length]].numpy())


def test_missing_observations_are_named(make_schema) -> None:
    data = stream(rng_bool((2, 9), 3, 0.2)).exclude("joint_target")
    with pytest.raises(UserError, match="no 'joint_target'"):
        EpisodeCutter(make_schema(), seed=0).push(data)


@pytest.mark.parametrize("keeps", [True, False], ids=["with truncated", "without"])
def test_a_replay_gives_whole_episodes_only(make_schema, keeps: bool) -> None:
    """Those that were cut short are whole; without a flag for it, nobody knows that they ended."""
    ends = np.zeros((2, STEPS), bool)
    ends[0, LENGTH - 1 :: LENGTH] = True  # all by time
    ends[1, [2, 10, 14, 22, 30, 38, 46, 54]] = True  # 3 (cut short), 8, 4 (terminated), 8, 8, …
    data = stream(ends)
    data["next", "terminated"] = torch.zeros_like(data["next", "terminated"])
    data["next", "terminated"][1, 14] = True
    data["next", "terminated"][1, 54] = True  # at its last step: it is over, and was not cut off
    data["next", "truncated"] = data["next", "done"] & ~data["next", "terminated"]
    data["is_init"][0, 0] = False  # the oldest has lost its start
    kept = data.clone()
    for key in ("done", *(() if keeps else ("truncated",))):
        del data["next", key]
    episodes, partial, _ = cut_replay(data, make_schema(), seed=4, episode_length=LENGTH)
    lengths = {world: [e.length for e in episodes if e.rows[SEED][0, 1] == world] for world in (0, 1)}
    assert lengths == {0: [8] * 6, 1: [3] * keeps + [8, 4, 8, 8, 8, 8, 8]}
    assert partial == 4 - keeps  # the first of each world, and the steps after the last end of each
    if keeps:
        cut = next(e for e in episodes if e.length == 3)
        assert cut.rows[TRUNCATED][:, 0].tolist() == cut.rows[DONE][:, 0].tolist() == [False, False, True]
        assert not cut.rows[TERMINATED].any()
        assert np.array_equal(cut.terminal[STATE], kept["next", "state"][1, 2].numpy())
    ended = next(e for e in episodes if e.length == 4)
    assert ended.rows[TERMINATED][-1, 0]
    assert not ended.rows[TRUNCATED][-1, 0]
    assert np.array_equal(ended.rows[STATE], kept["state"][1, 11:15].numpy())
    assert np.array_equal(ended.terminal[STATE], kept["next", "state"][1, 14].numpy())
    last = next(e for e in reversed(episodes) if e.rows[SEED][0, 1] == 1)
    assert last.length == 8 and last.rows[TERMINATED][-1, 0] and not last.rows[TRUNCATED].any()
    by_time = next(e for e in episodes if e.length == 8)
    assert by_time.rows[TRUNCATED][-1, 0]
    assert not by_time.rows[TRUNCATED][:-1].any()
    assert list(by_time.rows[SEED][0, [0, 2]]) == [4, -1]


@pytest.mark.parametrize("steps", [STEPS, 7], ids=["one batch", "several"])
def test_episodes_that_lost_contacts_are_left_out_and_counted(make_schema, steps: int) -> None:
    ends = np.zeros((2, STEPS), bool)
    ends[:, LENGTH - 1 :: LENGTH] = True
    data = stream(ends)
    lost = torch.zeros_like(data["is_init"])
    lost[0, 10] = lost[1, 0] = lost[1, 58] = (
        True  # of its second episode; of its first; of one that has not ended
    )
    data["next", "overflow"] = lost
    cutter = EpisodeCutter(make_schema(), seed=4)
    found = [episode for part in data.split(steps, dim=1) for episode in cutter.push(part)]
    kept = {(world, number) for world in (0, 1) for number in range(STEPS // LENGTH)} - {(0, 1), (1, 0)}
    assert {tuple(episode.rows[SEED][0, 1:].tolist()) for episode in found} == kept and cutter.lost == 2
    # Such an episode is over, also where nothing else says so: a replay keeps no flag for the end by time.
    early = stream(ends | (np.arange(STEPS) == 2))
    early["next", "overflow"] = (torch.arange(STEPS) == 2).expand(2, -1).unsqueeze(-1)
    del early["next", "done"], early["next", "truncated"]
    early["next", "terminated"] = torch.zeros_like(early["next", "terminated"])
    assert cut_replay(early, make_schema(), seed=4, episode_length=LENGTH)[2] == 2


def plain_stats(values: np.ndarray) -> dict[str, np.ndarray]:
    """Of (N, D), by numpy alone."""
    quantiles = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
    found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    for name, q in quantiles.items():
        found[name] = np.quantile(values, q, axis=0, method="inverted_cdf")
    return found


@pytest.mark.parametrize("length", [1, 2, 10, 37, 200])
def test_statistics_of_an_episode_are_those_of_its_values(length: int) -> None:
    """Without LeRobot's histograms; of images so few frames that all are looked at are compared."""
    rng = np.random.default_rng(length)
    columns = {
        "vector": rng.normal(size=(length, 3)).astype(np.float32),
        "number": rng.integers(-5, 5, (length,)),
        "flag": rng.integers(0, 2, (length, 1)).astype(bool),
        "bytes": rng.integers(0, 255, (length, 4)).astype(np.uint8),
    }
    stats = episode_stats(columns)
    for name, array in columns.items():
        wide = array.reshape(length, -1).astype(np.float64)
        assert stats[name].pop("count").tolist() == [length]
        for stat, value in plain_stats(wide).items():
            np.testing.assert_allclose(
                stats[name][stat], value, rtol=1e-5, atol=1e-6, err_msg=f"{name} {stat}"
            )


@pytest.mark.parametrize(("length", "frames"), [(1, 1), (3, 3), (100, 100), (900, 164)])
def test_statistics_of_images_are_those_of_the_frames_that_are_looked_at(length: int, frames: int) -> None:
    images = np.random.default_rng(0).integers(3, 251, (length, 4, 5, 3)).astype(np.uint8)
    images[..., 1] //= 2
    stats = episode_stats({"pixels": images})["pixels"]
    chosen = images[np.round(np.linspace(0, length - 1, frames)).astype(int)]
    assert stats.pop("count").tolist() == [frames]
    for stat, value in plain_stats(chosen.reshape(-1, 3) / 255.0).items():
        assert stats[stat].shape == (3, 1, 1)
        np.testing.assert_allclose(stats[stat].ravel(), value, atol=1e-9, err_msg=stat)


def test_statistics_of_episodes_together_are_those_of_all_values() -> None:
    """But for quantiles, which are means of the episodes', weighted by their lengths."""
    rng = np.random.default_rng(0)
    episodes = [rng.normal(k, 1 + k, (n, 2)) for k, n in enumerate((5, 30, 12))]
    pictures = [rng.integers(10 * k, 90 + k, (n, 2, 2, 3)).astype(np.uint8) for k, n in enumerate((2, 3, 4))]
    stats = [episode_stats({"x": x, "pixels": y}) for x, y in zip(episodes, pictures, strict=True)]
    alone = aggregate(stats[:1])["x"]
    assert all(np.allclose(alone[stat], value) for stat, value in stats[0]["x"].items())
    for name, parts in (("x", episodes), ("pixels", [one.reshape(-1, 3) / 255.0 for one in pictures])):
        found = aggregate(stats)[name]
        counts = [int(one[name]["count"][0]) for one in stats]
        assert found["count"].tolist() == [sum(counts)]
        for stat, value in plain_stats(np.concatenate(parts)).items():
            if stat.startswith("q"):
                value = np.average([plain_stats(part)[stat] for part in parts], axis=0, weights=counts)
            assert found[stat].shape == ((3, 1, 1) if name == "pixels" else (2,))
            np.testing.assert_allclose(found[stat].ravel(), value, atol=1e-9, err_msg=f"{name} {stat}")
