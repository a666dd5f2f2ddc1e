# pyright: reportCallIssue=false, reportArgumentType=false
"""The batched search against plain searches, node by node, and against problems with known answers."""

from functools import partial

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from franka_wm.planning import mcts as mcts_module
from franka_wm.planning import tree_kernels
from franka_wm.planning.mcts import MCTS, sequential_halving
from plain_search import MOVES, RandomModel, gumbel, plain_search, puct, sigma


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


@pytest.fixture(params=[False, True], ids=["plain", "kernels"])
def mcts(request):
    """The search in plain tensor code, and in kernels."""
    return partial(MCTS, kernels=request.param)


# ------------------------------------------------------------------ the plain searches


@pytest.mark.parametrize("weights", [(), (0.5, 5.0)], ids=["default", "other"])
@pytest.mark.parametrize(
    ("simulations", "max_depth"), [(1, None), (2, None), (30, None), (70, None), (30, 1), (30, 3)]
)
def test_puct_makes_the_visits_of_a_plain_search(mcts, simulations, max_depth, weights):
    given = dict(zip(("pb_c_init", "pb_c_base"), weights, strict=False))
    for seed in range(2 if simulations < 70 else 1):
        model = RandomModel(seed)
        search = mcts(num_actions=MOVES, num_simulations=simulations, max_depth=max_depth, **given)
        found = search.search(*model.root(), model.recurrent)
        for world in range(3):
            root = plain_search(model, world, simulations, puct(*weights), max_depth)
            assert found["visits"][world].tolist() == [root.visits(m) for m in range(MOVES)]
            assert found["value"][world].item() == pytest.approx(root.mean)
            policy = torch.tensor([root.visits(m) / simulations for m in range(MOVES)], dtype=torch.float64)
            torch.testing.assert_close(found["policy"][world], policy)
            assert found["action"][world] == policy.argmax()


@pytest.mark.parametrize(
    ("simulations", "considered", "max_depth"),
    [(1, 16, None), (2, 16, None), (16, 16, None), (70, 16, None), (30, 3, None), (10, 1, None), (30, 16, 2)],
)
@pytest.mark.parametrize("scales", [(), (2.0, 0.1), (50.0, 0.01)], ids=["default", "visit", "scale"])
def test_gumbel_makes_the_visits_of_a_plain_search(mcts, simulations, considered, max_depth, scales):
    given = dict(zip(("c_visit", "c_scale"), scales, strict=False))
    for seed in range(2 if simulations < 70 else 1):
        model = RandomModel(seed, moves=6)
        found = mcts(
            num_actions=6,
            num_simulations=simulations,
            variant="gumbel",
            max_num_considered_actions=considered,
            max_depth=max_depth,
            **given,
        ).search(*model.root(), model.recurrent)
        for world in range(3):
            rule = gumbel(min(considered, 6), simulations, *scales)
            root = plain_search(model, world, simulations, rule, max_depth)
            visits = [root.visits(m) for m in range(6)]
            assert found["visits"][world].tolist() == visits
            assert found["value"][world].item() == pytest.approx(root.mean)
            score = root.logits + sigma(root, *scales)
            torch.testing.assert_close(found["policy"][world], score.softmax(-1))
            most = [m for m in range(6) if visits[m] == max(visits)]
            assert found["action"][world] == max(most, key=lambda m: float(score[m]))


def test_the_plain_searches_go_deep():
    """Otherwise the comparisons above would say little about paths."""

    def depth(node):
        return 1 + max((depth(child) for child in node.children.values()), default=0)

    assert max(depth(plain_search(RandomModel(s), 0, 70, puct())) for s in range(4)) >= 6
    # Some of these worlds end episodes inside the tree.
    ends = [
        child.discount == 0.0
        for s in range(4)
        for w in range(3)
        for child in plain_search(RandomModel(s), w, 40, puct()).children.values()
    ]
    assert any(ends) and not all(ends)


# ------------------------------------------------------------------ known answers


def table_world(after: list[list[int]], reward: list[list[float]], ends: list[list[bool]] | None = None):
    """States are one-hot latents; logits and values are zero, so only the search can know."""
    states, moves = len(after), len(after[0])
    to, gain = torch.tensor(after), torch.tensor(reward)
    over = torch.zeros(states, moves, dtype=torch.bool) if ends is None else torch.tensor(ends)

    def recurrent(z, action):
        state = z.argmax(-1)
        z = torch.eye(states)[to[state, action]]
        return (
            z,
            gain[state, action].unsqueeze(-1),
            0.99 * (~over[state, action]).float().unsqueeze(-1),
            torch.zeros(len(z), moves),
            torch.zeros(len(z), 1),
        )

    return lambda start: (
        torch.zeros(len(start), moves),
        torch.zeros(len(start), 1),
        torch.eye(states)[start],
        recurrent,
    )


VARIANTS = ("puct", "gumbel")


@pytest.mark.parametrize("variant", VARIANTS)
def test_finds_a_payoff_one_move_away(mcts, variant):
    world = table_world([[0, 0, 0]], [[0.0, 0.0, 1.0]])
    found = mcts(num_actions=3, num_simulations=16, variant=variant).search(*world([0, 0]))
    assert found["action"].tolist() == [2, 2] and found["policy"].argmax(-1).tolist() == [2, 2]


@pytest.mark.parametrize("variant", VARIANTS)
def test_finds_a_delayed_payoff_that_a_greedy_choice_misses(mcts, variant):
    # From state 0, move 0 pays 0.5 at once; move 1 pays nothing but leads to where move 1 pays 2.
    world = table_world([[2, 1], [2, 2], [2, 2]], [[0.5, 0.0], [0.0, 2.0], [0.0, 0.0]])
    one = mcts(num_actions=2, num_simulations=100, variant=variant, max_depth=1).search(*world([0]))
    two = mcts(num_actions=2, num_simulations=100, variant=variant).search(*world([0]))
    assert one["action"].item() == 0 and two["action"].item() == 1


@pytest.mark.parametrize("variant", VARIANTS)
def test_nothing_is_earned_after_the_end(mcts, variant):
    # Move 0 ends the episode; were it ignored, state 1 behind it would pay 5 with every move.
    args = ([[1, 2], [1, 1], [2, 2]], [[0.0, 0.0], [5.0, 5.0], [0.3, 0.3]])
    search = mcts(num_actions=2, num_simulations=32, variant=variant)
    assert search.search(*table_world(*args)([0]))["action"].item() == 0
    ends = [[True, False], [False, False], [False, False]]
    found = search.search(*table_world(*args, ends)([0]))
    assert found["action"].item() == 1
    assert 0.0 < found["value"].item() < 3.0


@pytest.mark.parametrize("variant", VARIANTS)
def test_environments_do_not_touch_each_other(mcts, variant):
    model = RandomModel(0)
    logits, value, z = model.root()
    search = mcts(num_actions=MOVES, num_simulations=30, variant=variant)
    together = search.search(logits, value, z, model.recurrent)
    for world in range(3):
        alone = search.search(*(x[world : world + 1] for x in (logits, value, z)), model.recurrent)
        for key in ("action", "policy", "value", "visits"):
            torch.testing.assert_close(alone[key][0], together[key][world])
    broken = value.clone()
    broken[1] = torch.nan  # and what the model says there is not a number either
    poisoned = search.search(logits, broken, torch.where(torch.arange(3)[:, None] == 1, torch.nan, z),
                             model.recurrent)  # fmt: skip
    for key in ("action", "policy", "value", "visits"):
        torch.testing.assert_close(poisoned[key][[0, 2]], together[key][[0, 2]])
    assert 0 <= poisoned["action"][1] < MOVES


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_the_unit_of_the_reward_does_not_matter(mcts, variant, scale):
    model = RandomModel(1)

    def recurrent(z, action):
        z, reward, discount, logits, value = model.recurrent(z, action)
        return z, scale * reward, discount, logits, scale * value

    search = mcts(num_actions=MOVES, num_simulations=30, variant=variant)
    logits, value, z = model.root()
    plain, scaled = (
        search.search(logits, factor * value, z, law)
        for factor, law in ((1.0, model.recurrent), (scale, recurrent))
    )
    assert torch.equal(plain["visits"], scaled["visits"])
    torch.testing.assert_close(plain["value"] * scale, scaled["value"])


# ------------------------------------------------------------------ Gumbel


def test_what_acts_may_trust_q_more_than_what_teaches(mcts):
    model = RandomModel(0, moves=6)
    low, high, both = (
        mcts(num_actions=6, num_simulations=8, variant="gumbel", **scales)
        for scales in ({"c_scale": 0.02}, {"c_scale": 2.0}, {"c_scale": 0.02, "c_scale_acting": 2.0})
    )

    def policy(search: MCTS, *, explore: bool):
        noise = torch.Generator().manual_seed(3)
        return search.search(*model.root(), model.recurrent, explore=explore, generator=noise)["policy"]

    assert torch.equal(policy(both, explore=True), policy(low, explore=True))
    assert torch.equal(policy(both, explore=False), policy(high, explore=False))
    assert not torch.equal(policy(low, explore=False), policy(high, explore=False))


def bandits(seed: int, envs: int = 200, moves: int = 8):
    """One decision, then the end. Returns the search's arguments and the true Q (E, M)."""
    draw = torch.Generator().manual_seed(seed)
    q = torch.randn(envs, moves, generator=draw)
    logits = 2.0 * torch.randn(envs, moves, generator=draw)
    value = (logits.softmax(-1) * q).sum(-1, keepdim=True)

    def recurrent(z, action):
        reward = z[:, :moves].gather(1, action.unsqueeze(-1))
        return (
            torch.zeros_like(z),
            reward,
            torch.zeros(envs, 1),
            torch.zeros(envs, moves),
            torch.zeros(envs, 1),
        )

    return (logits, value, q, recurrent), q


@pytest.mark.parametrize("simulations", [2, 4, 8, 16])
@pytest.mark.parametrize("explore", [False, True])
def test_gumbel_improves_the_policy_with_any_number_of_simulations(mcts, simulations, explore):
    args, q = bandits(0)
    found = mcts(num_actions=8, num_simulations=simulations, variant="gumbel").search(*args, explore=explore)
    prior = args[0].softmax(-1)
    before, after = (prior * q).sum(-1), (found["policy"] * q).sum(-1)
    assert (after >= before - 1e-4).all() and (after - before).mean() > 0.2
    # The action itself is better than one drawn from the prior, on average (the paper's theorem).
    gain = q.gather(1, found["action"].unsqueeze(-1)).squeeze(-1) - before
    assert gain.mean() > 0.2


def test_more_simulations_improve_the_policy_more(mcts):
    args, q = bandits(1, envs=500)
    searches = [mcts(num_actions=8, num_simulations=n, variant="gumbel") for n in (2, 4, 8, 16, 32)]
    values = [(s.search(*args, explore=True)["policy"] * q).sum(-1).mean().item() for s in searches]
    assert values == sorted(values) and values[-1] > values[0] + 0.2


def test_the_gumbel_noise_draws_root_moves_by_their_prior(mcts):
    logits = torch.tensor([[2.0, 1.0, 0.0, -1.0]]).expand(4000, 4)
    model = table_world([[0] * 4], [[0.0] * 4])
    recurrent = model([0] * 4000)[-1]
    search = mcts(num_actions=4, num_simulations=1, variant="gumbel")
    found = search.search(logits, torch.zeros(4000, 1), torch.ones(4000, 1), recurrent, explore=True)
    shares = torch.nn.functional.one_hot(found["action"], 4).float().mean(0)
    torch.testing.assert_close(shares, logits[0].softmax(-1), atol=0.03, rtol=0)


def test_sequential_halving_spends_every_simulation():
    assert sequential_halving(4, 8) == [0, 0, 0, 0, 1, 1, 2, 2]
    assert sequential_halving(1, 3) == [0, 1, 2]
    assert sequential_halving(16, 3) == [0, 0, 0]
    for considered in (2, 3, 5, 16):
        for simulations in (1, 10, 50, 200):
            visits = [0] * considered
            for wanted in sequential_halving(considered, simulations):
                visits[visits.index(wanted)] += 1  # always some move has just that many
            assert sum(visits) == simulations
    late = [0] * 16
    for wanted in sequential_halving(16, 200):
        late[late.index(wanted)] += 1
    assert sorted(late, reverse=True)[:2] == late[:2] and late[0] > 3 * late[-1]


# ------------------------------------------------------------------ noise and drawn actions


def test_dirichlet_noise_lets_puct_look_at_what_the_prior_forbids(mcts):
    logits = torch.tensor([[0.0, -20.0, -20.0]]).expand(64, 3)
    recurrent = table_world([[0] * 3], [[0.0] * 3])([0] * 64)[-1]
    args = (logits, torch.zeros(64, 1), torch.ones(64, 1), recurrent)
    search = mcts(num_actions=3, num_simulations=25)
    assert (search.search(*args)["visits"][:, 1:] == 0).all()
    explored = search.search(*args, explore=True)["visits"]
    assert (explored[:, 1:] > 0).any(1).float().mean() > 0.5
    assert len(explored.unique(dim=0)) > 3  # each environment has its own noise
    quiet = mcts(num_actions=3, num_simulations=25, dirichlet_fraction=0.0)
    assert (quiet.search(*args, explore=True)["visits"][:, 1:] == 0).all()


@pytest.mark.parametrize("alpha", [0.03, 30.0])
def test_the_noise_of_the_root_is_as_wide_as_asked(alpha):
    settings = MCTS(num_actions=4, dirichlet_alpha=alpha, dirichlet_fraction=0.5)
    found = mcts_module._root_prior(settings, torch.zeros(4000, 4), True, torch.Generator().manual_seed(0))
    expected = 0.5 * (0.25 * 0.75 / (4 * alpha + 1)) ** 0.5  # of a symmetric Dirichlet distribution
    torch.testing.assert_close(found.std(0), torch.full((4,), expected), rtol=0.05, atol=0)


@pytest.mark.parametrize(("temperature", "power"), [(1.0, 1.0), (0.5, 2.0)])
def test_puct_draws_actions_by_visits(mcts, temperature, power):
    model = RandomModel(2)
    logits, value, z = (x[:1].expand(2000, -1) for x in model.root())
    search = mcts(num_actions=MOVES, num_simulations=12, temperature=temperature, dirichlet_fraction=0.0)
    found = search.search(logits, value, z, model.recurrent, explore=True)
    weights = found["visits"][0] ** power
    shares = torch.nn.functional.one_hot(found["action"], MOVES).double().mean(0)
    torch.testing.assert_close(shares, weights / weights.sum(), atol=0.04, rtol=0)
    cold = mcts(num_actions=MOVES, num_simulations=20, temperature=0.0)
    found = cold.search(logits[:50], value[:50], z[:50], model.recurrent, explore=True)
    chosen = found["visits"].gather(1, found["action"].unsqueeze(-1)).squeeze(-1)
    assert torch.equal(chosen, found["visits"].amax(-1))


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_generator_makes_the_noise_repeat(variant, mcts):
    model = RandomModel(0)
    search = mcts(num_actions=MOVES, num_simulations=8, variant=variant)

    def visits(seed):
        noise = torch.Generator().manual_seed(seed)
        logits, value, z = (x[:1].expand(100, -1) for x in model.root())
        return search.search(logits, value, z, model.recurrent, explore=True, generator=noise)["visits"]

    assert torch.equal(visits(1), visits(1)) and not torch.equal(visits(1), visits(2))


# ------------------------------------------------------------------ form


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("max_depth", [None, 3])
def test_nothing_waits_for_the_host_or_depends_on_the_data(variant, max_depth):
    """Fake tensors hold no data: reading one, or branching on it, raises. Shapes must come out all the same."""
    with FakeTensorMode():
        search = MCTS(num_actions=5, num_simulations=9, variant=variant, max_depth=max_depth, kernels=False)

        def recurrent(z, action):
            return z + action.unsqueeze(-1), z[:, :1], z[:, 1:2], z[:, :5], z[:, 2:3]

        found = search.search(
            torch.randn(3, 5), torch.randn(3, 1), torch.randn(3, 8), recurrent, explore=True
        )
    assert found["action"].shape == (3,) and found["action"].dtype == torch.int64
    assert found["policy"].shape == found["visits"].shape == (3, 5) and found["value"].shape == (3, 1)


def test_kernels_are_the_default(monkeypatch):
    used, kernel_tree = [], tree_kernels.KernelTree
    monkeypatch.setattr(
        tree_kernels, "KernelTree", lambda *args, **options: used.append(1) or kernel_tree(*args, **options)
    )
    model = RandomModel(0)
    for options, count in (({"kernels": False}, 0), ({}, 1), ({"kernels": True}, 2)):
        MCTS(num_actions=MOVES, num_simulations=2, **options).search(*model.root(), model.recurrent)
        assert len(used) == count


@pytest.mark.parametrize("variant", VARIANTS)
def test_kernels_draw_the_same_actions(variant, monkeypatch):
    """What is explored does not depend on how a tree is walked: a GPU draws other numbers in another precision."""
    model, found, drawn, noise_of = RandomModel(0), [], [], mcts_module._gumbel_noise
    monkeypatch.setattr(
        mcts_module, "_gumbel_noise", lambda like, *args: drawn.append(like.dtype) or noise_of(like, *args)
    )
    z = model.start[:1].float() + torch.randn(
        256, model.start.shape[1], generator=torch.Generator().manual_seed(1)
    )
    model.move, model.head = model.move.float(), model.head.float()
    for kernels in (False, True):
        search = MCTS(num_actions=MOVES, num_simulations=9, variant=variant, kernels=kernels)
        noise = torch.Generator().manual_seed(0)
        answer = search.search(*model.predict(z), z, model.recurrent, explore=True, generator=noise)
        found.append(answer["action"])
    assert (found[0] == found[1]).float().mean() > 0.95  # rounding may turn a tie
    assert drawn == [torch.float32] * 2


@pytest.mark.parametrize("variant", VARIANTS)
def test_no_gradient_is_recorded_and_inputs_are_left_alone(mcts, variant):
    model = RandomModel(0)
    inputs = [x.clone().requires_grad_() for x in model.root()]
    kept = [x.detach().clone() for x in inputs]
    found = mcts(num_actions=MOVES, num_simulations=8, variant=variant).search(
        *inputs, model.recurrent, explore=True
    )
    assert not any(value.requires_grad for value in found.values())
    assert all(torch.equal(a, b) for a, b in zip(inputs, kept, strict=True))


@pytest.mark.parametrize(
    "setting",
    [
        dict(num_actions=0),
        dict(num_simulations=0),
        dict(variant="alpha"),
        dict(max_depth=0),
        dict(temperature=-1.0),
        dict(dirichlet_alpha=0.0),
        dict(dirichlet_fraction=1.1),
        dict(pb_c_base=0.0),
        dict(c_scale=-0.1),
        dict(max_num_considered_actions=0),
    ],
)
def test_settings_that_cannot_work_are_refused(setting):
    (name,) = setting
    with pytest.raises(ValueError, match=name):
        MCTS(**{"num_actions": 3, **setting})


def test_wrong_shapes_are_named(mcts):
    model = RandomModel(0)
    logits, value, z = model.root()
    search = mcts(num_actions=MOVES, num_simulations=2)
    with pytest.raises(ValueError, match="root_logits"):
        search.search(logits[:, :2], value, z, model.recurrent)
    with pytest.raises(ValueError, match="root_value"):
        search.search(logits, value.squeeze(-1), z, model.recurrent)
    with pytest.raises(ValueError, match="root_embedding"):
        search.search(logits, value, z[:2], model.recurrent)

    def flat(z, action):
        z, reward, discount, logits, value = model.recurrent(z, action)
        return z, reward.squeeze(-1), discount, logits, value

    with pytest.raises(ValueError, match="reward"):
        search.search(logits, value, z, flat)
    for wrong in (logits[:, :2], logits[:1], logits[0], logits.unsqueeze(-1)):
        with pytest.raises(ValueError, match=r"logits of shape \(\d+, \d+\), got"):
            search.search(
                logits, value, z, lambda z, a, wrong=wrong: (*model.recurrent(z, a)[:3], wrong, value)
            )
