"""Seeds that never meet: each purpose of a run draws from its own."""

from __future__ import annotations

import hashlib


def derive_seed(purpose: str, seed: int, *parts: int | str) -> int:
    """Seed of one purpose, from a run's seed, by hashing.

    Arithmetic (`seed + steps`) can meet the seed of another purpose or another run; a hash of what the numbers are for
    cannot, but for chance (1 in 2³¹).

    Args:
        purpose: What the numbers are for: `evaluation`, `training`, `policy`, …
        seed: The run's.
        parts: What else tells draws of this purpose apart: a rank, a count of resumes, a policy's name.

    Returns:
        A whole number in [0, 2³¹), which Warp, NumPy and torch all take.
    """
    text = "\x1f".join([purpose, str(int(seed)), *map(str, parts)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") & 0x7FFF_FFFF
