"""Colours of every figure, and how policies and distances are called in them.

The palette is Okabe & Ito's, "Color universal design" (2008): its colours stay apart for colour-blind
readers. The same policy has the same colour everywhere.
"""

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#8A8A8A"

# Yellow, the palette's eighth, is left out: too pale for lines on white.
PALETTE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)

POLICY_COLOURS = {
    "planner": BLUE,
    "policy": VERMILION,
    "train": GREY,
    "random": ORANGE,
    "noop": BLACK,
    "oracle": GREEN,
}

POLICY_NAMES = {
    "planner": "planner",
    "policy": "policy alone",
    "train": "while collecting",
    "random": "random smooth",
    "noop": "doing nothing",
    "oracle": "inverse kinematics",
}


def policy_colour(policy: str) -> str:
    """The policy's colour; unknown ones get one from the palette that depends on the name alone."""
    return POLICY_COLOURS.get(policy, PALETTE[sum(policy.encode()) % len(PALETTE)])


def policy_name(policy: str) -> str:
    """What a reader sees for a policy's key."""
    return POLICY_NAMES.get(policy, policy)


def centimetres(distance: float | str) -> str:
    """A distance [m] as text in centimetres: "0.025" -> "2.5 cm"."""
    return f"{100 * float(distance):g} cm"
