"""Planners rebuilt with other settings."""

from franka_wm.live.sliders import rebuilt
from franka_wm.planning import MCTS


def test_a_longest_path_comes_back_with_more_simulations() -> None:
    """With as few as its length it does not matter, and must not be forgotten."""
    search = MCTS(num_actions=3, num_simulations=16, max_depth=4)
    few = rebuilt(search, num_simulations=2)
    assert few.num_simulations == 2
    again = rebuilt(few, num_simulations=16)
    assert again.max_depth == search.max_depth == 4
