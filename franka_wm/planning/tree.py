"""The tree of a Monte Carlo search, for E environments at once, as a fixed set of tensors."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Recurrent = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]


class CompiledRecurrent:
    """A model's `recurrent`, compiled by `torch.compile`.

    Called as `recurrent` itself it is the model alone, which the plain tree asks. `ask`, which the kernels' tree calls,
    also reads the latents from the tree and packs the answer, in the same program.
    """

    def __init__(self, recurrent: Recurrent) -> None:
        self.recurrent = recurrent
        self._programs: dict[tuple[Callable[..., Any], str], Callable[..., Any]] = {}

    def __call__(self, z: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        return self._program(self.recurrent, z.device)(z.contiguous(), action)

    def ask(
        self, embedding: Tensor, env: Tensor, at: Tensor, action: Tensor, actions: int
    ) -> tuple[Tensor, Tensor]:
        """See the function `ask`."""
        return self._program(ask, embedding.device)(self.recurrent, embedding, env, at, action, actions)

    def __reduce__(self) -> tuple[type, tuple[Recurrent]]:
        """A copy compiles its own model."""
        return CompiledRecurrent, (self.recurrent,)

    def _program(self, function: Callable[..., Any], device: torch.device) -> Callable[..., Any]:
        key = function, device.type
        if key not in self._programs:
            # On a CPU what calls the program's kernels is C++ too: for one arm Python there took a fifth of the time.
            more: dict[str, Any] = {"options": {"cpp_wrapper": True}} if device.type == "cpu" else {}
            self._programs[key] = torch.compile(function, dynamic=False, **more)
        return self._programs[key]


def ask(
    recurrent: Recurrent, embedding: Tensor, env: Tensor, at: Tensor, action: Tensor, actions: int
) -> tuple[Tensor, Tensor]:
    """What the model says of an action in one slot of each environment.

    Args:
        recurrent: see `MCTS.search`.
        embedding: (E, N, Z) latents of the slots.
        env: (E,) int64, 0 … E - 1.
        at: (E,) int64, the slots.
        action: (E,) int64.
        actions: M.

    Returns:
        The next latent (E, Z), and (E, 3 + M) in float64: reward, discount, value and logits.

    Raises:
        ValueError: the model returns another shape.
    """
    after, reward, discount, logits, value = recurrent(embedding[env, at], action)
    check_columns(len(env), reward=reward, discount=discount, value=value)
    check_logits(logits, len(env), actions)
    return after, torch.cat((reward, discount, value, logits), 1).double()


_ABOVE, _DISCOUNT, _REWARD = 0, 1, 2  # planes of `Tree.paths`
_BITS = 62  # of an int64, so that no sum of bits overflows


class Tree:
    """N slots for each of E environments: slot 0 is the root, slot n what simulation n reached.

    A slot stands for a node and for the action into it. Walking down and adding up need no loop over depth,
    because each slot keeps which slots are above it, as bits (`above`), and the discounted reward on the way
    from each of them (`paths`): to find the nodes on a chosen path is one comparison, and to update them one
    addition.

    Attributes:
        embedding: (E, N, Z) latents.
        value, reward, discount: (E, N), the model's value of the node, and what the action into it brought.
        parent, action, depth: (E, N) int64: the slot above, the action that led here, actions from the root.
        visits: (E, N), simulations that ended here or passed through; 1 at first, for the root too.
        returns: (E, N), the sum over these visits of the return from here on.
        above: (E, N, W) int64, the slots above and the slot itself as bits, `_BITS` to a word.
        paths: (E, N, 3, N), [n, :, k] for each slot n and each slot k: whether k is above n or n itself (1 or
            0), the product of discounts from k to n, the discounted sum of rewards from k to n.
        attached: (E, N) bool, or None without a limit of depth: False in slots that stand for nothing.

    Args:
        slots: N.
        value: (E, 1) of the root.
        embedding: (E, Z) of the root.
        max_depth: the longest path in actions; None: no limit.
    """

    def __init__(self, slots: int, value: Tensor, embedding: Tensor, max_depth: int | None) -> None:
        envs, device, dtype = value.shape[0], value.device, value.dtype

        def numbers(*shape: int, of: torch.dtype = dtype) -> Tensor:
            return torch.zeros(envs, slots, *shape, device=device, dtype=of)

        self.embedding = embedding.new_empty(envs, slots, embedding.shape[1])
        self.value, self.reward, self.discount = numbers(), numbers(), numbers()
        self.parent, self.action = numbers(of=torch.int64), numbers(of=torch.int64)
        self.visits, self.returns = torch.ones_like(self.value), numbers()
        self.paths = numbers(3, slots)
        self.paths[:, :, :_REWARD].diagonal(dim1=1, dim2=3).fill_(1.0)  # a slot from itself
        self.max_depth = max_depth
        self.depth = numbers(of=torch.int64)
        self.attached = None if max_depth is None else torch.ones_like(self.depth, dtype=torch.bool)
        self.slot = torch.arange(slots, device=device)
        self.env = torch.arange(envs, device=device)
        word = torch.arange((slots + _BITS - 1) // _BITS, device=device)
        bit = torch.ones_like(self.slot) << (self.slot % _BITS)
        self.bits = (self.slot.unsqueeze(-1) // _BITS == word) * bit.unsqueeze(-1)  # (N, W)
        self.above = self.bits.repeat(envs, 1, 1)
        self.embedding[:, 0] = embedding
        self.value[:, 0] = self.returns[:, 0] = value.squeeze(-1)

    def q(self, slots: int) -> Tensor:
        """Mean return (E, slots - 1) of the actions into slots 1 … slots - 1, from the slots above them."""
        held = slice(1, slots)
        mean = self.returns[:, held] / self.visits[:, held]
        return torch.addcmul(self.reward[:, held], self.discount[:, held], mean)

    def last(self, off_path: Tensor) -> Tensor:
        """The slot (E,) where the chosen path ends.

        Args:
            off_path: (E, n) bool for the first n slots: the slot above would choose another action. Where equal
                actions are all chosen, the path to the newest slot counts.
        """
        nodes = off_path.shape[1]
        off = (off_path.unsqueeze(-1) * self.bits[:nodes]).sum(1, keepdim=True)  # (E, 1, W)
        on_path = ((self.above[:, :nodes] & off) == 0).all(-1)
        if self.attached is not None:
            on_path = on_path & self.attached[:, :nodes]
        # A slot comes after the one above it, so the deepest on a path is the last.
        return (on_path * self.slot[:nodes]).amax(-1)

    def grow(
        self, node: int, last: Tensor, action: Tensor, recurrent: Recurrent
    ) -> tuple[Tensor, Tensor | None]:
        """Ask the model what `action` (E,) leads to from the slots `last` (E,), put it into slot `node`, and add
        its return to every slot above.

        Where `last` is at `max_depth` it is itself what is evaluated, once more, and slot `node` stays unused.

        Returns:
            The model's logits (E, M), and where the slot is used (E,) bool; None: everywhere.
        """
        parent, used = last, None
        if self.attached is not None and self.max_depth is not None:
            used = self.depth[self.env, last] < self.max_depth
            parent = torch.where(used, last, self.parent[self.env, last])
            action = torch.where(used, action, self.action[self.env, last])
            # A slot that stands for nothing hangs on itself.
            self.parent[:, node] = torch.where(used, parent, node)
            self.depth[:, node] = self.depth[self.env, parent] + 1
            self.attached[:, node] = used
        else:
            self.parent[:, node] = parent
        self.action[:, node] = action

        embedding, reward, discount, logits, value = recurrent(self.embedding[self.env, parent], action)
        if node == 1:
            check_columns(self.visits.shape[0], reward=reward, discount=discount, value=value)
        self.embedding[:, node] = embedding
        self.reward[:, node], self.discount[:, node] = reward.squeeze(-1), discount.squeeze(-1)
        self.value[:, node] = self.returns[:, node] = value.squeeze(-1)
        if used is not None:
            reward = torch.where(used.unsqueeze(-1), reward, 0.0)
            discount = torch.where(used.unsqueeze(-1), discount, 1.0)

        self.above[:, node] |= self.above[self.env, last]
        above, scale, gained = self.paths[self.env, last, :, :node].unbind(1)
        gained = torch.addcmul(gained, scale, reward)
        scale = scale * discount
        path = self.paths[:, node, :, :node]
        path[:, _ABOVE], path[:, _DISCOUNT], path[:, _REWARD] = above, scale, gained
        self.visits[:, :node] += above
        self.returns[:, :node] += torch.addcmul(gained, scale, value)  # 0 where not above
        return logits, used

    def root_visits(self, actions: int) -> Tensor:
        """Visits (E, M) of the root's actions."""
        under_root = (self.parent[:, 1:] == 0) * self.visits[:, 1:]
        return self.visits.new_zeros(self.visits.shape[0], actions).scatter_add_(
            1, self.action[:, 1:], under_root
        )


def check_columns(envs: int, **columns: Tensor) -> None:
    """Refuses what a model returns of another shape than (E, 1)."""
    for name, column in columns.items():
        if column.shape != (envs, 1):
            raise ValueError(f"recurrent must return {name} of shape ({envs}, 1), got {tuple(column.shape)}")


def check_logits(logits: Tensor, envs: int, actions: int) -> None:
    """Refuses what a model returns of another shape than (E, M)."""
    if logits.shape != (envs, actions):
        raise ValueError(
            f"recurrent must return logits of shape ({envs}, {actions}), got {tuple(logits.shape)}"
        )
