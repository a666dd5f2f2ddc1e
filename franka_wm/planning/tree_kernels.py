# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportAssignmentType=false, reportReturnType=false
# pyright: reportGeneralTypeIssues=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""The tree of a Monte Carlo search in Warp kernels: one thread walks down and adds up for each environment.

The same choices as `franka_wm.planning.mcts` makes with plain tensors, which say what is meant; a simulation is one
launch instead of some fifty operations. Sums are in float64, so equal scores need not be told apart alike.
"""

# Warp reads annotations as types: no `from __future__ import annotations` here.
from functools import partial
from typing import cast

import torch
import warp as wp
from torch import Tensor

from franka_wm.planning.tree import CompiledRecurrent, Recurrent, ask
from franka_wm.quiet import start_warp

NOTHING = wp.constant(-1)
SMALLEST = wp.constant(wp.float64(2.2250738585072014e-308))


@wp.struct
class Statistics:
    """The tree of E environments with N slots (slot 0 is the root) and M actions.

    parent, action, depth: (E, N), of the slot; -1 where it stands for nothing and at the root.
    value, reward, discount, visits, returns: (E, N), as in `franka_wm.planning.tree.Tree`.
    child: (E, N, M), the slot that an action leads to, or -1.
    tries, q: (E, N, M), visits and mean return of an action, 0 before the first.
    prior: (E, N, M), probabilities (PUCT) or their logarithms (Gumbel).
    last: (E), where the walk ended.
    """

    parent: wp.array2d[wp.int32]
    action: wp.array2d[wp.int32]
    depth: wp.array2d[wp.int32]
    value: wp.array2d[wp.float64]
    reward: wp.array2d[wp.float64]
    discount: wp.array2d[wp.float64]
    visits: wp.array2d[wp.float64]
    returns: wp.array2d[wp.float64]
    child: wp.array3d[wp.int32]
    tries: wp.array3d[wp.float64]
    q: wp.array3d[wp.float64]
    prior: wp.array3d[wp.float64]
    last: wp.array[wp.int32]


@wp.func
def leave(
    tree: Statistics,
    env: int,
    slot: int,
    deepest: int,
    at: wp.array[wp.int64],
    taken: wp.array[wp.int64],
    chosen: int,
):
    """Notes where the walk ended, and what the model is asked: `chosen` there, or once more for what led to it."""
    tree.last[env] = slot
    if tree.depth[env, slot] < deepest:
        at[env] = wp.int64(slot)
        taken[env] = wp.int64(chosen)
    else:
        at[env] = wp.int64(tree.parent[env, slot])
        taken[env] = wp.int64(tree.action[env, slot])


@wp.func
def walk_puct(
    tree: Statistics,
    env: int,
    node: int,
    deepest: int,
    init: wp.float64,
    base: wp.float64,
    tiny: wp.float64,
    at: wp.array[wp.int64],
    taken: wp.array[wp.int64],
):
    """From the root by the action of the largest score to one that leads to no slot yet.

    Args:
        node: how many slots there are.
    """
    one = wp.float64(1.0)
    low, high = wp.float64(0.0), wp.float64(0.0)
    found = int(0)
    for slot in range(1, node):
        above = tree.parent[env, slot]
        if above != NOTHING:
            q = tree.q[env, above, tree.action[env, slot]]
            if found == 0:
                low, high = q, q
            low, high = wp.min(low, q), wp.max(high, q)
            found = 1
    width = wp.max(high - low, tiny)
    slot = int(0)
    chosen = int(0)
    down = int(1)
    while down == 1:
        total = tree.visits[env, slot]
        weight = wp.sqrt(total) * (wp.log((total + base + one) / base) + init)
        best = wp.float64(-wp.inf)
        chosen = int(0)
        for action in range(tree.prior.shape[2]):
            tries = tree.tries[env, slot, action]
            score = weight * tree.prior[env, slot, action] / (tries + one)
            if tries > wp.float64(0.0):
                score += (tree.q[env, slot, action] - low) / width
            # Of equal scores the newest slot's, and before all slots the first action that has none.
            newer = tree.child[env, slot, action] > tree.child[env, slot, chosen]
            if score > best or (score == best and newer):
                best, chosen = score, action
        below = tree.child[env, slot, chosen]
        if below == NOTHING or tree.depth[env, slot] >= deepest:
            down = 0
        else:
            slot = below
    leave(tree, env, slot, deepest, at, taken, chosen)


@wp.func
def completed(tree: Statistics, env: int, slot: int, action: int, mixed: wp.float64) -> wp.float64:
    """Mean return of an action; of one without visits the mixed value of its node."""
    if tree.tries[env, slot, action] > wp.float64(0.0):
        return tree.q[env, slot, action]
    return mixed


@wp.func
def walk_gumbel(
    tree: Statistics,
    env: int,
    noise: wp.array2d[wp.float64],
    considered: int,
    deepest: int,
    c_visit: wp.float64,
    c_scale: wp.float64,
    tiny: wp.float64,
    at: wp.array[wp.int64],
    taken: wp.array[wp.int64],
):
    """From the root by sequential halving there and the improved policy below to an action that leads to no slot yet.

    Args:
        considered: the visits that an action of the root must have to be chosen.
    """
    actions = tree.prior.shape[2]
    slot = int(0)
    chosen = int(0)
    down = int(1)
    while down == 1:
        # The mixed value, of actions without visits: the model's own, and the mean Q of what was visited, by prior.
        weighted = wp.float64(0.0)
        share = wp.float64(0.0)
        most = wp.float64(0.0)
        for action in range(actions):
            tries = tree.tries[env, slot, action]
            if tries > wp.float64(0.0):
                p = wp.max(wp.exp(tree.prior[env, slot, action]), SMALLEST)
                weighted += p * tree.q[env, slot, action]
                share += p
                most = wp.max(most, tries)
        if share > wp.float64(0.0):
            weighted = weighted / share
        total = tree.visits[env, slot]
        mixed = weighted + (tree.value[env, slot] - weighted) / total
        low, high = wp.float64(wp.inf), wp.float64(-wp.inf)
        for action in range(actions):
            q = completed(tree, env, slot, action, mixed)
            low, high = wp.min(low, q), wp.max(high, q)
        scale = (c_visit + most) * c_scale / wp.max(high - low, tiny)
        # Scores are logits + σ(Q); the softmax takes off the largest.
        top = wp.float64(-wp.inf)
        mass = wp.float64(0.0)
        if slot > 0:
            for action in range(actions):
                q = completed(tree, env, slot, action, mixed)
                top = wp.max(top, tree.prior[env, slot, action] + scale * (q - low))
            for action in range(actions):
                q = completed(tree, env, slot, action, mixed)
                mass += wp.exp(tree.prior[env, slot, action] + scale * (q - low) - top)
        best = wp.float64(-wp.inf)
        chosen = int(0)
        for action in range(actions):
            tries = tree.tries[env, slot, action]
            q = completed(tree, env, slot, action, mixed)
            score = tree.prior[env, slot, action] + scale * (q - low)
            if slot > 0:
                score = wp.exp(score - top) / mass - tries / total
            else:
                # A floor, or an action with a prior of nearly 0 would be no better than one out of turn.
                score = wp.max(score + noise[env, action], wp.float64(-1.0e9))
                if tries != wp.float64(considered):
                    score = wp.float64(-wp.inf)
            if score > best:
                best, chosen = score, action
        below = tree.child[env, slot, chosen]
        if below == NOTHING or tree.depth[env, slot] >= deepest:
            down = 0
        else:
            slot = below
    leave(tree, env, slot, deepest, at, taken, chosen)


@wp.func
def add(
    tree: Statistics,
    env: int,
    node: int,
    deepest: int,
    logarithms: int,
    found: wp.array2d[wp.float64],
    taken: wp.array[wp.int64],
):
    """Puts what the model says of an action into slot `node`, and its return into every slot above.

    Args:
        logarithms: 1: priors are kept as logarithms.
        found: (E, 3 + M), reward, discount, value and logits of what the action led to.
    """
    one = wp.float64(1.0)
    slot = tree.last[env]
    gained = found[env, 2]
    if tree.depth[env, slot] < deepest:
        action = int(taken[env])
        tree.parent[env, node] = slot
        tree.action[env, node] = action
        tree.depth[env, node] = tree.depth[env, slot] + 1
        tree.reward[env, node] = found[env, 0]
        tree.discount[env, node] = found[env, 1]
        tree.value[env, node] = gained
        tree.returns[env, node] = wp.float64(0.0)
        tree.visits[env, node] = wp.float64(0.0)
        tree.child[env, slot, action] = node
        actions = tree.prior.shape[2]
        top = found[env, 3]
        for k in range(1, actions):
            top = wp.max(top, found[env, 3 + k])
        mass = wp.float64(0.0)
        for k in range(actions):
            mass += wp.exp(found[env, 3 + k] - top)
        for k in range(actions):
            if logarithms == 1:
                tree.prior[env, node, k] = found[env, 3 + k] - top - wp.log(mass)
            else:
                tree.prior[env, node, k] = wp.exp(found[env, 3 + k] - top) / mass
        slot = node
    while slot != NOTHING:
        tree.visits[env, slot] = tree.visits[env, slot] + one
        tree.returns[env, slot] = tree.returns[env, slot] + gained
        above = tree.parent[env, slot]
        if above != NOTHING:
            action = tree.action[env, slot]
            reward = tree.reward[env, slot]
            discount = tree.discount[env, slot]
            tree.tries[env, above, action] = tree.visits[env, slot]
            tree.q[env, above, action] = reward + discount * tree.returns[env, slot] / tree.visits[env, slot]
            gained = reward + discount * gained
        slot = above


@wp.kernel(enable_backward=False)
def add_and_walk_puct(
    tree: Statistics,
    node: int,
    deepest: int,
    init: wp.float64,
    base: wp.float64,
    tiny: wp.float64,
    found: wp.array2d[wp.float64],
    at: wp.array[wp.int64],
    taken: wp.array[wp.int64],
):
    """Adds the answer of simulation `node` (0: there is none yet) and walks for the next one, if there is one."""
    env = wp.tid()
    if node > 0:
        add(tree, env, node, deepest, 0, found, taken)
    if node + 1 < tree.parent.shape[1]:
        walk_puct(tree, env, node + 1, deepest, init, base, tiny, at, taken)


@wp.kernel(enable_backward=False)
def add_and_walk_gumbel(
    tree: Statistics,
    node: int,
    considered: int,
    noise: wp.array2d[wp.float64],
    deepest: int,
    c_visit: wp.float64,
    c_scale: wp.float64,
    tiny: wp.float64,
    found: wp.array2d[wp.float64],
    at: wp.array[wp.int64],
    taken: wp.array[wp.int64],
):
    """As `add_and_walk_puct`; `considered` is of the next simulation."""
    env = wp.tid()
    if node > 0:
        add(tree, env, node, deepest, 1, found, taken)
    if node + 1 < tree.parent.shape[1]:
        walk_gumbel(tree, env, noise, considered, deepest, c_visit, c_scale, tiny, at, taken)


class KernelTree:
    """What `franka_wm.planning.tree.Tree` and a rule of `franka_wm.planning.mcts` do, in one launch a simulation.

    Args:
        simulations: N - 1.
        value, embedding: (E, 1) and (E, Z) of the root.
        prior: (E, M) of the root, probabilities, or with `noise` their logarithms.
        noise: (E, M), Gumbel's; None: PUCT.
        max_depth: the longest path in actions; None: no limit.
        tiny: the least range of Q that counts as a difference.
        options: `init` and `base` of PUCT, or `c_visit` and `c_scale` of Gumbel.
        considered: of Gumbel, the visits that an action of the root must have, for each simulation.
    """

    def __init__(
        self,
        simulations: int,
        value: Tensor,
        embedding: Tensor,
        prior: Tensor,
        noise: Tensor | None,
        *,
        max_depth: int | None,
        tiny: float,
        options: tuple[float, float],
        considered: list[int] | None,
    ) -> None:
        start_warp()
        (envs, actions), slots, device = prior.shape, simulations + 1, prior.device

        def numbers(*shape: int) -> Tensor:
            return torch.zeros(envs, *shape, device=device, dtype=torch.float64)

        def integers(*shape: int, fill: int = 0) -> Tensor:
            return torch.full((envs, *shape), fill, device=device, dtype=torch.int32)

        self.value, self.visits, self.returns = numbers(slots), numbers(slots), numbers(slots)
        self.tries, self.q, self.prior = (numbers(slots, actions) for _ in range(3))
        self.embedding = embedding.new_empty(envs, slots, embedding.shape[1])
        self.env = torch.arange(envs, device=device)
        self.at, self.taken = (torch.zeros(envs, device=device, dtype=torch.int64) for _ in range(2))
        self.found = numbers(3 + actions)
        self.embedding[:, 0] = embedding
        self.value[:, 0] = self.returns[:, 0] = value.squeeze(-1)
        self.visits[:, 0] = 1.0
        self.prior[:, 0] = prior
        tensors = {
            "parent": integers(slots, fill=NOTHING),
            "action": integers(slots),
            "depth": integers(slots),
            "value": self.value,
            "reward": numbers(slots),
            "discount": numbers(slots),
            "visits": self.visits,
            "returns": self.returns,
            "child": integers(slots, actions, fill=NOTHING),
            "tries": self.tries,
            "q": self.q,
            "prior": self.prior,
            "last": integers(),
        }
        tree = Statistics()
        for name, tensor in tensors.items():
            setattr(tree, name, wp.from_torch(tensor))
        deepest = slots if max_depth is None else max_depth
        memory = [wp.from_torch(x) for x in (self.found, self.at, self.taken)]
        if noise is None:
            kernel, inputs = add_and_walk_puct, [tree, 0, deepest, *options, tiny, *memory]
        else:
            assert considered is not None
            kernel = add_and_walk_gumbel
            inputs = [tree, 0, considered[0], wp.from_torch(noise.double()), deepest, *options, tiny, *memory]
        self._considered = considered
        self._recorded = cast(
            wp.Launch, wp.launch(kernel, envs, inputs=inputs, device=memory[0].device, record_cmd=True)
        )
        self._held = inputs, tensors  # what the launch points to
        self._stream = (
            wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None
        )
        self._recorded.launch(self._stream)

    def simulate(self, node: int, recurrent: Recurrent) -> None:
        """Simulation `node`: asks the model, puts its answer into slot `node`, and walks for the next one.

        To be called for 1, 2, … in turn: where the model is asked is what the call before walked to.
        """
        asked = recurrent.ask if isinstance(recurrent, CompiledRecurrent) else partial(ask, recurrent)
        after, found = asked(self.embedding, self.env, self.at, self.taken, self.prior.shape[2])
        self.embedding[:, node] = after
        self.found.copy_(found)
        self._recorded.set_param_at_index(1, node)
        if self._considered is not None and node < len(self._considered):
            self._recorded.set_param_at_index(2, self._considered[node])
        self._recorded.launch(self._stream)
