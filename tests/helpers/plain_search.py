# pyright: reportCallIssue=false, reportArgumentType=false
"""Plain tree searches, node by node, and a random world to search in."""

import math

import torch

from franka_wm.planning.mcts import sequential_halving

MOVES, LATENT = 4, 6


class RandomModel:
    """A random smooth world in float64; about one move in eight ends the episode."""

    def __init__(self, seed: int, moves: int = MOVES) -> None:
        draw = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> torch.Tensor:
            return torch.randn(*shape, generator=draw, dtype=torch.float64)

        self.move, self.head = normal(moves, LATENT, LATENT), normal(LATENT, moves + 3)
        self.start = normal(3, LATENT)
        self.moves = moves

    def predict(self, z):
        out = z @ self.head
        return out[..., : self.moves], 3.0 * torch.sin(out[..., self.moves : self.moves + 1])

    def recurrent(self, z, action):
        after = torch.sin(torch.einsum("ed,edk->ek", z, self.move[action]) + action.unsqueeze(-1))
        out = after @ self.head
        reward = out[:, -1:]
        discount = torch.where(torch.cos(3.0 * out[:, -2:-1]) < -0.9, 0.0, 0.95)
        return after, reward, discount, *self.predict(after)

    def root(self):
        return *self.predict(self.start), self.start


class Node:
    def __init__(self, z, logits, value, reward=0.0, discount=1.0):
        self.z, self.logits, self.value = z, logits, float(value)
        self.reward, self.discount = float(reward), float(discount)
        self.prior = logits.softmax(-1).tolist()
        self.children: dict[int, Node] = {}
        self.found = [self.value]  # every return that was backed up

    @property
    def mean(self):
        return sum(self.found) / len(self.found)

    def q(self, move):
        child = self.children[move]
        return child.reward + child.discount * child.mean

    def visits(self, move):
        return len(self.children[move].found) if move in self.children else 0

    def everything(self):
        for move, child in self.children.items():
            yield self.q(move)
            yield from child.everything()


def plain_search(model, world, simulations, choose, max_depth=None):
    """Simulate with `choose(root, node, simulation) -> move` and return the root."""
    logits, value, z = (x[world] for x in model.root())
    root = Node(z, logits, value)
    for simulation in range(simulations):
        path = [root]
        while True:
            move = choose(root, path[-1], simulation)
            if move not in path[-1].children:
                after, reward, discount, logits, value = (
                    x[0] for x in model.recurrent(path[-1].z[None], torch.tensor([move]))
                )
                path[-1].children[move] = leaf = Node(after, logits, value, reward, discount)
                break
            path.append(path[-1].children[move])
            if max_depth is not None and len(path) > max_depth:
                leaf = path.pop()
                leaf.found.append(leaf.value)
                break
        back, below = leaf.value, leaf
        for node in reversed(path):
            back = below.reward + below.discount * back
            node.found.append(back)
            below = node
    return root


def puct(init=1.25, base=19652.0):
    ranges = {}

    def choose(root, node, simulation):
        if simulation not in ranges:
            seen = list(root.everything()) or [0.0]
            ranges[simulation] = (min(seen), max(seen))
        low, high = ranges[simulation]

        def score(move):
            total, visits = len(node.found), node.visits(move)
            bonus = math.sqrt(total) / (1 + visits) * (init + math.log((total + base + 1) / base))
            q = (node.q(move) - low) / (high - low) if visits and high > low else 0.0
            return q + node.prior[move] * bonus

        return max(range(len(node.prior)), key=score)

    return choose


def sigma(node, c_visit=50.0, c_scale=0.1):
    moves = range(len(node.prior))
    visited = [m for m in moves if node.visits(m)]
    total = sum(node.visits(m) for m in moves)
    mixed = node.value
    if visited:
        mass = sum(node.prior[m] for m in visited)
        average = sum(node.prior[m] * node.q(m) for m in visited) / mass
        mixed = (node.value + total * average) / (1 + total)
    q = [node.q(m) if m in visited else mixed for m in moves]
    low, high = min(q), max(q)
    scale = (c_visit + max(node.visits(m) for m in moves)) * c_scale
    return torch.tensor([scale * (x - low) / max(high - low, 1e-8) for x in q], dtype=torch.float64)


def gumbel(considered, simulations, *scales):
    """Without noise; `scales` are c_visit and c_scale."""
    levels = sequential_halving(considered, simulations)

    def choose(root, node, simulation):
        moves, improved = range(len(node.prior)), node.logits + sigma(node, *scales)
        if node is root:
            turn = [m for m in moves if root.visits(m) == levels[simulation]]
            return max(turn, key=improved.tolist().__getitem__)
        share, total = improved.softmax(-1).tolist(), len(node.found)
        return max(moves, key=lambda m: share[m] - node.visits(m) / total)

    return choose
