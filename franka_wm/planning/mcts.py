"""Monte Carlo tree search in a learned model, for all environments at once and without a loop over depth."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.options import COEFFICIENT, FRACTION, POSITIVE, Bounds, check_arguments
from franka_wm.planning.tree import Recurrent, Tree, check_logits
from franka_wm.seeding import of_worlds


@dataclass(kw_only=True, eq=False)
class MCTS:
    """Tree search over a model of E environments, as MuZero or as Gumbel MuZero acts.

    Every simulation walks from the root to an action not tried yet, asks the model for what it leads to, and adds
    the return found to every action on the way. The two variants differ in how they walk, act and teach:

    `puct` (MuZero, Schrittwieser et al., arXiv:1911.08265). At each node the action of the largest
    Q̂ + P · √N / (1 + n) · (`pb_c_init` + log((N + `pb_c_base` + 1) / `pb_c_base`)), with n the visits of the
    action, N those of the node, and Q̂ the mean return of the action, scaled to [0, 1] by the smallest and largest
    in the tree; 0 where n = 0. With `explore`, the priors of the root are mixed with Dirichlet noise, and the
    action is drawn from visits^(1/`temperature`); else the most visited one is taken. The policy target is the
    share of visits.

    `gumbel` (Danihelka et al., "Policy improvement by planning with Gumbel", ICLR 2022). The root takes the
    `max_num_considered_actions` best by Gumbel noise + logits and halves them in rounds by noise + logits +
    σ(Q). σ(Q) = (`c_visit` + max n) · `c_scale` · Q, with Q completed (an action without visits counts as the
    mixed value of its node) and scaled to [0, 1] within its node. Other nodes take, without noise, the action
    whose share of visits lags furthest behind softmax(logits + σ(Q)). The action is the best of the most
    visited; the policy target is softmax(logits + σ(Q)) at the root. The noise is there with `explore` alone.
    It improves the policy with any number of simulations, 2 as well, where PUCT may worsen it.

    What differs from the papers' own code: a node counts itself as a visit (N = 1 + Σ n), also the root, so
    the root's priors matter in the first simulation; the smallest and largest Q̂ are those of the tree as it
    stands, without the history; equal scores are not broken at random.

    Static shapes, no host synchronisation. What a search does is defined by plain tensor code without
    data-dependent control flow: all nodes choose at once and the tree (`franka_wm.planning.tree`) needs no loop over
    depth, so every simulation is the same few operations, however deep it goes. Memory is about
    E · N · (Z + 2 M + 3 N) numbers with N = `num_simulations` + 1. Warp kernels
    (`franka_wm.planning.tree_kernels`, see `kernels`) make the same choices in fewer launches.

    Args:
        num_actions: M.
        num_simulations: model calls per search, one new node each.
        variant: `puct` or `gumbel`.
        max_depth: the longest path in actions; None: as deep as the simulations reach.
        pb_c_init, pb_c_base: weight of the prior, see above (PUCT).
        dirichlet_alpha, dirichlet_fraction: noise of the root (PUCT).
        temperature: of the drawn action (PUCT); 0 takes the most visited.
        max_num_considered_actions: at the root (Gumbel).
        c_visit, c_scale: σ, see above (Gumbel).
        c_scale_acting: in place of `c_scale` without `explore`: what acts may trust Q more than what teaches, whose
            policy must keep what it has not tried enough; None: the same.
        kernels: False: walk and add up in the plain tensor code; True or None: in Warp kernels, with sums in float64.

    Raises:
        ValueError: a setting that cannot work.
    """

    num_actions: int
    num_simulations: int = 50
    variant: Literal["puct", "gumbel"] = "puct"
    max_depth: int | None = None
    pb_c_init: float = 1.25
    pb_c_base: float = 19652.0
    dirichlet_alpha: float = 0.3
    dirichlet_fraction: float = 0.25
    temperature: float = 1.0
    max_num_considered_actions: int = 16
    c_visit: float = 50.0
    c_scale: float = 0.1
    c_scale_acting: float | None = None
    kernels: bool | None = None

    ranges: ClassVar[Mapping[str, Bounds]] = {
        **dict.fromkeys(("num_actions", "num_simulations", "max_depth"), POSITIVE),
        "max_num_considered_actions": POSITIVE,
        **dict.fromkeys(("pb_c_base", "dirichlet_alpha"), Bounds(above=0)),
        **dict.fromkeys(("pb_c_init", "temperature", "c_visit", "c_scale", "c_scale_acting"), COEFFICIENT),
        "dirichlet_fraction": FRACTION,
    }

    def __post_init__(self) -> None:
        check_arguments(MCTS, vars(self), "planner", self.ranges)

    @torch.no_grad()
    def search(
        self,
        root_logits: Tensor,
        root_value: Tensor,
        root_embedding: Tensor,
        recurrent: Recurrent,
        *,
        explore: bool = False,
        generator: torch.Generator | None = None,
    ) -> TensorDict:
        """Search for E environments.

        Args:
            root_logits: (E, M) prior of the actions; need not be normalised.
            root_value: (E, 1) the model's value of the root.
            root_embedding: (E, Z) latent of the root.
            recurrent: the model: (z (E, Z), action (E,) int64) -> next z (E, Z), reward (E, 1), discount
                (E, 1), logits (E, M) and value (E, 1) of the next z. A discount of 0 ends the episode.
            explore: noise at the root and, with PUCT, a drawn action.
            generator: source of the noise, on the device of the tensors.

        Returns:
            TensorDict of batch size [E]: `action` (E,) int64; `policy` (E, M), the improved policy to learn
            from; `value` (E, 1), the root's mean return over all simulations and the model's own value;
            `visits` (E, M), which sum to `num_simulations`.

        Raises:
            ValueError: a tensor of another shape.
        """
        envs, actions = root_logits.shape[0], self.num_actions
        if root_logits.shape != (envs, actions):
            raise ValueError(f"root_logits must be (E, {actions}), got {tuple(root_logits.shape)}")
        if root_value.shape != (envs, 1):
            raise ValueError(f"root_value must be ({envs}, 1), got {tuple(root_value.shape)}")
        if root_embedding.dim() != 2 or root_embedding.shape[0] != envs:
            raise ValueError(f"root_embedding must be ({envs}, Z), got {tuple(root_embedding.shape)}")
        if self.kernels is not False:
            return self._walked(root_logits, root_value, root_embedding, recurrent, explore, generator)
        tree = Tree(self.num_simulations + 1, root_value, root_embedding, self._limit())
        rule = (_Puct if self.variant == "puct" else _Gumbel)(self, tree, root_logits, explore, generator)
        for node in range(1, self.num_simulations + 1):
            off_path, actions_of = rule.choose(node)
            last = tree.last(off_path)
            action = actions_of(last)
            logits, used = tree.grow(node, last, action, recurrent)
            check_logits(logits, envs, actions)
            rule.add(node, logits, last, used)
        action, policy, visits = rule.result()
        value = (tree.returns[:, 0] / tree.visits[:, 0]).unsqueeze(-1)
        return TensorDict(
            {"action": action, "policy": policy, "value": value, "visits": visits}, batch_size=[envs]
        )

    def _walked(
        self,
        logits: Tensor,
        value: Tensor,
        embedding: Tensor,
        recurrent: Recurrent,
        explore: bool,
        generator: torch.Generator | None,
    ) -> TensorDict:
        """The same search in kernels."""
        from franka_wm.planning.tree_kernels import KernelTree

        if self.variant == "puct":
            prior, noise, considered = _root_prior(self, logits, explore, generator), None, None
            options = self.pb_c_init, self.pb_c_base
        else:
            prior, noise = logits.log_softmax(-1), _root_noise(logits, explore, generator)
            considered, options = self._halving(), (self.c_visit, self._c_scale(explore))
        tree = KernelTree(
            self.num_simulations,
            value,
            embedding,
            prior,
            noise,
            max_depth=self._limit(),
            tiny=_tiny(value),
            options=options,
            considered=considered,
        )
        for node in range(1, self.num_simulations + 1):
            tree.simulate(node, recurrent)
        visits, total = tree.tries[:, 0], tree.visits[:, :1]
        if noise is None:
            # In the model's precision: the same draws as of the plain search.
            action, policy = _act_by_visits(self, visits.to(value.dtype), explore, generator)
        else:
            sigma = completed_sigma(
                visits,
                tree.q[:, 0],
                tree.prior[:, 0],
                total,
                tree.value[:, :1],
                self.c_visit,
                options[1],
                _tiny(value),
            )
            score = _root_score(noise, tree.prior[:, 0], sigma, visits, visits.amax(-1, keepdim=True))
            action, policy = score.argmax(-1), (tree.prior[:, 0] + sigma).softmax(-1)
        found = {"policy": policy, "value": tree.returns[:, :1] / total, "visits": visits}
        return TensorDict(
            {"action": action} | {key: x.to(value.dtype) for key, x in found.items()},
            batch_size=[len(logits)],
        )

    def _limit(self) -> int | None:
        """`max_depth` where it matters: no path is longer than the number of simulations."""
        return None if self.max_depth is None or self.max_depth >= self.num_simulations else self.max_depth

    def _halving(self) -> list[int]:
        return sequential_halving(
            min(self.max_num_considered_actions, self.num_actions), self.num_simulations
        )

    def _c_scale(self, explore: bool) -> float:
        return self.c_scale if explore or self.c_scale_acting is None else self.c_scale_acting


class _Puct:
    """MuZero's rule for choosing actions.

    Among the actions of a node that were not tried yet, the one of the largest prior scores highest. So actions
    are tried in the order of their priors, which is sorted once, and a node has one candidate besides the
    actions that have slots: everything is (E, n) for n slots, whatever the number of actions.
    """

    def __init__(
        self, settings: MCTS, tree: Tree, logits: Tensor, explore: bool, generator: torch.Generator | None
    ) -> None:
        self.settings, self.tree, self.explore, self.generator = settings, tree, explore, generator
        (envs, actions), slots = logits.shape, tree.slot.shape[0]
        self.actions = actions
        # One more column than actions: nothing is left to try.
        self.priors = logits.new_full((envs, slots, actions + 1), -math.inf)
        self.order = torch.zeros(envs, slots, actions + 1, device=logits.device, dtype=torch.int64)
        self.tried = torch.zeros_like(tree.parent)
        self.prior = torch.zeros_like(tree.value)  # of the action into each slot
        count = torch.arange(slots + 2, device=logits.device, dtype=logits.dtype)
        self.weight = count.sqrt() * (
            ((count + settings.pb_c_base + 1.0) / settings.pb_c_base).log() + settings.pb_c_init
        )
        self._sort(0, _root_prior(settings, logits, explore, generator))

    def _sort(self, node: int, prior: Tensor) -> None:
        self.priors[:, node, : self.actions], self.order[:, node, : self.actions] = prior.sort(
            dim=-1, descending=True, stable=True
        )

    def choose(self, nodes: int) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        tree = self.tree
        visits = tree.visits[:, :nodes]
        weight = self.weight[visits.long()]
        untried = self.priors[:, :nodes].gather(2, self.tried[:, :nodes, None]).squeeze(-1)
        best = weight * untried
        off_path = torch.zeros_like(best, dtype=torch.bool)
        if nodes > 1:
            q, parent = tree.q(nodes), tree.parent[:, 1:nodes]
            low, high = self._range(q)
            score = (q - low) / (high - low).clamp_min(_tiny(q))
            score = torch.addcmul(
                score, weight.gather(1, parent), self.prior[:, 1:nodes] / (visits[:, 1:] + 1.0)
            )
            best.scatter_reduce_(1, parent, score, "amax")
            off_path[:, 1:] = score < best.gather(1, parent)
        return off_path, lambda last: self.order[tree.env, last, self.tried[tree.env, last]]

    def _range(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """The smallest and largest Q of the tree (E, 1)."""
        attached = self.tree.attached
        if attached is None:
            return torch.aminmax(q, dim=1, keepdim=True)
        unused = ~attached[:, 1 : q.shape[1] + 1]
        return (
            q.masked_fill(unused, math.inf).amin(1, keepdim=True),
            q.masked_fill(unused, -math.inf).amax(1, keepdim=True),
        )

    def add(self, node: int, logits: Tensor, last: Tensor, used: Tensor | None) -> None:
        env = self.tree.env
        tried = self.tried[env, last]
        self.prior[:, node] = self.priors[env, last, tried]
        self.tried[env, last] = tried + 1 if used is None else tried + used
        self._sort(node, logits.softmax(-1))

    def result(self) -> tuple[Tensor, Tensor, Tensor]:
        visits = self.tree.root_visits(self.actions)
        return *_act_by_visits(self.settings, visits, self.explore, self.generator), visits


class _Gumbel:
    """Gumbel MuZero's rule for choosing actions; scores of all actions of all nodes, (E, n, M)."""

    def __init__(
        self, settings: MCTS, tree: Tree, logits: Tensor, explore: bool, generator: torch.Generator | None
    ) -> None:
        self.settings, self.tree = settings, tree
        self.c_scale = settings._c_scale(explore)
        self.actions, slots = logits.shape[1], tree.slot.shape[0]
        self.logits = logits.new_zeros(logits.shape[0], slots, self.actions)
        self.logits[:, 0] = logits.log_softmax(-1)
        self.noise = _root_noise(logits, explore, generator)
        self.schedule = settings._halving()

    def _sigma(self, nodes: int, slots: int) -> tuple[Tensor, Tensor]:
        """Visits, and σ of the completed Q, of the actions of the first `nodes` (E, nodes, M).

        Args:
            slots: how many are filled.
        """
        tree, shape = self.tree, (self.logits.shape[0], nodes, self.actions)
        visits = self.logits.new_zeros(shape[0], slots * self.actions)
        q = torch.zeros_like(visits)
        if slots > 1:
            index = torch.add(tree.action[:, 1:slots], tree.parent[:, 1:slots], alpha=self.actions)
            visits.scatter_(1, index, tree.visits[:, 1:slots])
            q.scatter_(1, index, tree.q(slots))
        visits, q = (x[:, : nodes * self.actions].view(shape) for x in (visits, q))
        total, value = tree.visits[:, :nodes, None], tree.value[:, :nodes, None]
        sigma = completed_sigma(
            visits, q, self.logits[:, :nodes], total, value, self.settings.c_visit, self.c_scale, _tiny(q)
        )
        return visits, sigma

    def choose(self, nodes: int) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        tree = self.tree
        visits, sigma = self._sigma(nodes, nodes)
        improved = (self.logits[:, :nodes] + sigma).softmax(-1)
        choice = (improved - visits / tree.visits[:, :nodes, None]).argmax(-1)
        choice[:, 0] = _root_score(
            self.noise, self.logits[:, 0], sigma[:, 0], visits[:, 0], self.schedule[nodes - 1]
        ).argmax(-1)
        off_path = choice.gather(1, tree.parent[:, :nodes]) != tree.action[:, :nodes]
        off_path[:, 0] = False
        return off_path, lambda last: choice[tree.env, last]

    def add(self, node: int, logits: Tensor, last: Tensor, used: Tensor | None) -> None:
        self.logits[:, node] = logits.log_softmax(-1)

    def result(self) -> tuple[Tensor, Tensor, Tensor]:
        visits, sigma = self._sigma(1, self.tree.slot.shape[0])
        visits, sigma, logits = visits[:, 0].clone(), sigma[:, 0], self.logits[:, 0]
        score = _root_score(self.noise, logits, sigma, visits, visits.amax(-1, keepdim=True))
        return score.argmax(-1), (logits + sigma).softmax(-1), visits


def sequential_halving(considered: int, simulations: int) -> list[int]:
    """How many visits a root action must have to be eligible, for each simulation in turn.

    The actions with that many visits are the ones still considered; each round gives them equally many visits
    and keeps the better half, never fewer than two (Danihelka et al., ICLR 2022, figure 1).

    Args:
        considered: actions in the first round.
        simulations: length of the result.
    """
    if considered <= 1:
        return list(range(simulations))
    rounds = math.ceil(math.log2(considered))
    visits, sequence, left = [0] * considered, [], considered
    while len(sequence) < simulations:
        for _ in range(max(1, simulations // (rounds * left))):
            sequence.extend(visits[:left])
            visits[:left] = [count + 1 for count in visits[:left]]
        left = max(2, left // 2)
    return sequence[:simulations]


def _root_prior(settings: MCTS, logits: Tensor, explore: bool, generator: torch.Generator | None) -> Tensor:
    """Prior (E, M) of the root's actions in PUCT; with `explore` mixed with Dirichlet noise."""
    prior = logits.softmax(-1)
    if not explore:
        return prior
    # torch.distributions takes no generator. A draw may underflow, hence the smallest number.
    draw = of_worlds(
        lambda shape: torch._standard_gamma(  # pyright: ignore[reportPrivateImportUsage]
            prior.new_full(shape, settings.dirichlet_alpha), generator=generator
        ),
        prior.shape,
    ).clamp_min(torch.finfo(prior.dtype).tiny)
    return prior.lerp(draw / draw.sum(-1, keepdim=True), settings.dirichlet_fraction)


def _act_by_visits(
    settings: MCTS, visits: Tensor, explore: bool, generator: torch.Generator | None
) -> tuple[Tensor, Tensor]:
    """Actions (E,) and the policy (E, M) to learn from, in PUCT."""
    score = visits
    if explore and settings.temperature > 0.0:
        # The largest of log p + Gumbel noise is a draw from p; an action without visits has p = 0.
        score = visits.log() / settings.temperature + _gumbel_noise(visits, generator)
    return score.argmax(-1), visits / visits.sum(-1, keepdim=True)


def completed_sigma(
    visits: Tensor,
    q: Tensor,
    logits: Tensor,
    total: Tensor,
    value: Tensor,
    c_visit: float,
    c_scale: float,
    tiny: float,
) -> Tensor:
    """σ of the completed Q of all actions (..., M) of nodes, in Gumbel MuZero.

    Args:
        visits, q, logits: (..., M); q counts where there are visits.
        total, value: (..., 1) visits of the node, itself counted, and the model's value of it.
        tiny: the least range of Q that counts as a difference.
    """
    visited = visits > 0
    # The mixed value: the model's own, and the mean Q of what was visited, by prior.
    smallest = torch.finfo(q.dtype).tiny
    prior = logits.exp().clamp_min(smallest).masked_fill(~visited, 0.0)
    weighted = (prior * q).sum(-1, keepdim=True) / prior.sum(-1, keepdim=True).clamp_min(smallest)
    q = torch.where(visited, q, weighted + (value - weighted) / total)
    low, high = torch.aminmax(q, dim=-1, keepdim=True)
    scale = (c_visit + visits.amax(-1, keepdim=True)) * c_scale
    return scale * ((q - low) / (high - low).clamp_min(tiny))


def _root_score(
    noise: Tensor, logits: Tensor, sigma: Tensor, visits: Tensor, considered: Tensor | int
) -> Tensor:
    """noise + logits + σ(Q) of the root's actions (E, M); -inf unless they have `considered` visits."""
    # A floor, or an action with a prior of nearly 0 would be no better than one out of turn.
    return (noise + logits + sigma).clamp_min(-1e9).masked_fill(visits != considered, -math.inf)


def _root_noise(logits: Tensor, explore: bool, generator: torch.Generator | None) -> Tensor:
    return _gumbel_noise(logits, generator) if explore else torch.zeros_like(logits)


def _gumbel_noise(like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Standard Gumbel noise of the shape of `like`: -log of an exponential draw."""
    # The draw may be 0 in float32, whose logarithm would beat everything.
    draw = of_worlds(lambda shape: like.new_empty(shape).exponential_(generator=generator), like.shape)
    return -draw.clamp_min(torch.finfo(like.dtype).tiny).log()


def _tiny(q: Tensor) -> float:
    """The least range of Q that counts as a difference: below it rounding decides."""
    return 1e-8 if q.dtype == torch.float64 else 1e-6
