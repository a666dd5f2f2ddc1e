"""A cabinet with one drawer, as URDF and as MJCF: boards of 12 mm, a bar on two posts, a site in the bar's middle."""

from __future__ import annotations

WALL, SIZE, TRAVEL = 0.012, (0.30, 0.34, 0.22), 0.2
Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def boards() -> dict[str, list[Box]]:
    """Boxes of the links, in the links' frames: the case's is its middle on the ground, the drawer's its front."""
    length, width, height = SIZE
    side, middle = 0.5 * (width - WALL), 0.5 * height
    deep = length - WALL
    return {
        "case": [
            ((0.5 * WALL, side, middle), (deep, WALL, height)),
            ((0.5 * WALL, -side, middle), (deep, WALL, height)),
            ((0.5 * WALL, 0.0, 0.5 * WALL), (deep, width - 2 * WALL, WALL)),
            ((0.5 * WALL, 0.0, height - 0.5 * WALL), (deep, width - 2 * WALL, WALL)),
        ],
        "drawer": [
            ((0.5 * WALL, 0.0, 0.0), (WALL, width, height - 0.006)),
            ((0.14, 0.0, -0.08), (0.25, width - 0.03, WALL)),
        ],
    }


def handle(lying: bool) -> list[Box]:
    """Bar and posts around the bar's middle; a lying bar is along y."""
    if lying:
        return [
            ((0, 0, 0), (0.016, 0.09, 0.016)),
            *(((0.044, y, 0), (0.072, 0.012, 0.012)) for y in (-0.039, 0.039)),
        ]
    return [
        ((0, 0, 0), (0.016, 0.016, 0.07)),
        *(((0.029, 0, z), (0.042, 0.012, 0.012)) for z in (-0.029, 0.029)),
    ]


def bar(lying: bool) -> str:
    """The bar's middle in the drawer's frame; hand and open fingers, turned by a quarter, need more room around it."""
    return "-0.08 0 0.07" if lying else "-0.05 0 0"


def urdf(*, lying: bool = False, more: str = "") -> str:
    """Links case, drawer and handle; a joint slide; ``more`` is added before the end."""

    def geometry(boxes: list[Box], material: str) -> str:
        both = [
            f'<{tag}><origin xyz="{_words(at)}"/><geometry><box size="{_words(size)}"/></geometry>{look}</{tag}>'
            for tag, look in (("visual", f'<material name="{material}"/>'), ("collision", ""))
            for at, size in boxes
        ]
        return "".join(both)

    parts = boards()
    return f"""<robot name="cabinet">
  <material name="wood"><color rgba="0.6 0.4 0.2 1"/></material>
  <material name="blue"><color rgba="0.1 0.2 0.9 1"/></material>
  <link name="case">{geometry(parts["case"], "wood")}</link>
  <link name="drawer">
    <inertial><origin xyz="0.1 0 0"/><mass value="1.2"/>
      <inertia ixx="0.012" iyy="0.010" izz="0.014" ixy="0" ixz="0" iyz="0"/></inertial>
    {geometry(parts["drawer"], "blue")}</link>
  <link name="handle">
    <inertial><mass value="0.1"/><inertia ixx="0.0001" iyy="0.0001" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial>
    {geometry(handle(lying), "blue")}</link>
  <joint name="slide" type="prismatic"><parent link="case"/><child link="drawer"/>
    <origin xyz="{-0.5 * SIZE[0]} 0 {0.5 * SIZE[2]}"/><axis xyz="-1 0 0"/>
    <limit lower="0" upper="{TRAVEL}" effort="10" velocity="1"/><dynamics damping="2" friction="1"/></joint>
  <joint name="screws" type="fixed"><parent link="drawer"/><child link="handle"/><origin xyz="{bar(lying)}"/></joint>
  {more}</robot>"""


def mjcf(*, lying: bool = False, more: str = "", body: str = "") -> str:
    """The same: bodies case, drawer and handle; ``more`` is added before the end, ``body`` to the drawer."""

    def geometry(boxes: list[Box], material: str) -> str:
        return "".join(
            f'<geom pos="{_words(at)}" size="{_words([0.5 * s for s in size])}" material="{material}"/>'
            for at, size in boxes
        )

    parts = boards()
    return f"""<mujoco model="cabinet">
  <compiler angle="radian" autolimits="true"/>
  <default><geom type="box"/></default>
  <asset><material name="wood" rgba="0.6 0.4 0.2 1"/><material name="blue" rgba="0.1 0.2 0.9 1"/></asset>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="case" pos="0 0 0.3">{geometry(parts["case"], "wood")}
      <body name="drawer" pos="{-0.5 * SIZE[0]} 0 {0.5 * SIZE[2]}">
        <joint name="slide" type="slide" axis="-1 0 0" range="0 {TRAVEL}" damping="2" frictionloss="1"/>
        <inertial pos="0.1 0 0" mass="1.2" diaginertia="0.012 0.010 0.014"/>
        {geometry(parts["drawer"], "blue")}{body}
        <body name="handle" pos="{bar(lying)}">
          <inertial pos="0 0 0" mass="0.1" diaginertia="0.0001 0.0001 0.0001"/>
          {geometry(handle(lying), "blue")}<site name="middle"/></body></body></body>
  </worldbody>{more}</mujoco>"""


def _words(numbers) -> str:
    return " ".join(f"{x:.6g}" for x in numbers)
