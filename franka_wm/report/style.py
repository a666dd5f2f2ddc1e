"""Colours of every figure in a light and a dark theme, and how policies and distances are called in them.

The palette is Okabe & Ito's, "Color universal design" (2008): its colours stay apart for colour-blind
readers. On a dark ground every colour has a lighter partner that stays apart, too. The same policy has the
same colour everywhere.

Code names a colour by its light value (`BLUE`, `INK`, …); a theme translates it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from franka_wm.policies.names import RENAMED

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#8A8A8A"

# Of the figure itself: ground, text, lines behind the data.
PAPER = "#FFFFFF"
INK = "#1F2328"
FAINT = "#C9D1D9"

# Yellow, the palette's eighth, is left out: too pale for lines on white.
PALETTE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)

DASHES = ("-", "--", ":")
"""Line styles, for more series than colours."""

NAMES = {
    BLACK: "black",
    ORANGE: "orange",
    SKY: "sky",
    GREEN: "green",
    BLUE: "blue",
    VERMILION: "vermilion",
    PURPLE: "purple",
    GREY: "grey",
    PAPER: "paper",
    INK: "ink",
    FAINT: "faint",
}


@dataclass(frozen=True)
class Theme:
    """What every named colour becomes on one ground.

    Attributes:
        name: ``light`` or ``dark``.
        colours: by light value.
    """

    name: str
    colours: Mapping[str, str]

    def colour(self, light: str) -> str:
        """The theme's partner of a named colour; any other colour is itself."""
        return self.colours.get(light, light)

    @property
    def palette(self) -> tuple[str, ...]:
        """`PALETTE` in this theme."""
        return tuple(map(self.colour, PALETTE))


LIGHT = Theme("light", {colour: colour for colour in NAMES})
DARK = Theme(
    "dark",
    {
        BLACK: "#F2F2F2",
        ORANGE: "#F5C542",
        SKY: "#A6DCFF",
        GREEN: "#1FB889",
        BLUE: "#4596E6",
        VERMILION: "#F0743C",
        PURPLE: "#E3A0C8",
        GREY: "#8A8A8A",
        PAPER: "#161B22",
        INK: "#E6EDF3",
        FAINT: "#3D444D",
    },
)


POLICY_COLOURS = {
    "planner": BLUE,
    "policy": VERMILION,
    "train": GREY,
    "random": ORANGE,
    "noop": BLACK,
    "ik": GREEN,
    "expert": PURPLE,
}

POLICY_LEGEND = {
    "planner": "plans with the model",
    "policy": "the learned policy alone",
    "random": "smooth random motion",
    "noop": "does nothing",
    "ik": "inverse kinematics with the true geometry",
    "expert": "a scripted plan with the true positions of all objects",
}
"""What the names of policies mean, for readers of tables."""


def policy_colour(policy: str) -> str:
    """The policy's colour; unknown ones get one from the palette that depends on the name alone."""
    policy = RENAMED.get(policy, policy)
    return POLICY_COLOURS.get(policy, PALETTE[sum(policy.encode()) % len(PALETTE)])


def policy_name(policy: str) -> str:
    """What a reader sees for a policy's key; the present name where an old file has an earlier one."""
    return "while collecting" if policy == "train" else RENAMED.get(policy, policy)


def acting(policies: Mapping[str, object]) -> str:
    """The policy that a run is about: the planner, the policy where there is none, else whatever comes first."""
    return next((name for name in ("planner", "policy") if name in policies), next(iter(policies)))


def policy_legend(policies: Iterable[str]) -> str:
    """One line that explains the names of those policies that have a usual one; empty where none has."""
    known = [f"{name}: {POLICY_LEGEND[name]}" for name in map(policy_name, policies) if name in POLICY_LEGEND]
    return f"{'; '.join(known)}." if known else ""


def series_style(index: int) -> tuple[str, str]:
    """Colour and dashes of the series with this number; 21 of them differ."""
    return PALETTE[index % len(PALETTE)], DASHES[index // len(PALETTE) % len(DASHES)]


def centimetres(distance: float | str) -> str:
    """A distance [m] as text in centimetres: "0.025" -> "2.5 cm"."""
    return f"{100 * float(distance):g} cm"
