"""What the training episodes since the last log did: of all processes together, and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

COUNTS = ("episodes", "nonfinite", "overflow")
"""Statistics that are no means."""


def of_all(found: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Statistics of all processes' episodes: counts are summed, the others are means over (a task's) episodes."""
    if len(found) == 1:
        return dict(found[0])
    out = {}
    for name in dict.fromkeys(name for one in found for name in one):
        of, _, task = name.partition("/")
        episodes = f"episodes/{task}" if task else "episodes"
        having = [(one[name], one[episodes]) for one in found if name in one]
        if of in COUNTS:
            out[name] = sum(value for value, _ in having)
        else:
            out[name] = sum(value * n for value, n in having) / max(1.0, sum(n for _, n in having))
    return out


def described(episodes: Mapping[str, float]) -> str:
    """For the terminal; empty where no episode has ended and nothing went wrong."""
    parts = []
    if episodes["episodes"]:
        parts.append(f"return {episodes['return']:.2f}")
        if "success" in episodes:
            parts.append(f"success {100 * episodes['success']:.0f} %")
    if episodes.get("nonfinite"):
        parts.append(f"{episodes['nonfinite']:.0f} worlds broke and were reset")
    if episodes.get("overflow"):
        parts.append(f"{episodes['overflow']:.0f} times too little room for contacts (env.max_contacts)")
    return "   ".join(parts)
