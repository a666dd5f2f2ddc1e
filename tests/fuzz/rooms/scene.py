"""Scenes of one's own: tables, objects, obstacles, drawers and doors, up to Newton's model."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from rooms.forked import AcceptedError
from rooms.odd import changed, leaves, mutation

SCENE: dict[str, Any] = {
    "table": {"size": [1.1, 1.4, 0.05], "at": [0.35, 0.0, 0.0], "friction": 0.4},
    "objects": [
        {"name": "cube", "shape": "box", "size": [0.04, 0.04, 0.04], "mass": 0.05, "at": [0.42, -0.3], "turn": 0.5},
        {"name": "can", "shape": "cylinder", "size": [0.03, 0.1], "at": [0.4, 0.4], "spread": [0.02, 0.02]},
        {"name": "ball", "shape": "sphere", "size": [0.03], "at": [0.25, 0.5], "color": [0.1, 0.2, 0.3]},
        {"name": "pill", "shape": "capsule", "size": [0.02, 0.05], "at": [0.25, -0.5], "friction": 1.0},
    ],
    "obstacles": [
        {"name": "wall", "shape": "box", "size": [0.02, 0.1, 0.1], "at": [0.6, 0.45, 0.05], "angle": 0.3},
        {"name": "block", "shape": "socket", "size": [0.1, 0.045, 0.05], "at": [0.55, -0.45, 0.025]},
    ],
    "articulated": [
        {
            "name": "chest", "kind": "drawer", "size": [0.3, 0.34, 0.22], "handle": [0.05, 0.016, 0.07], "travel": 0.2,
            "mass": 1.0, "joint_friction": 1.0, "joint_damping": 2.0, "at": [0.72, 0.0], "angle": 0.0,
            "spread": [0.01, 0.01], "turn": 0.05, "case_color": [0.36, 0.4, 0.46],
        },
    ],
    "space": 0.01,
}  # fmt: skip
MANY = 3000
WEDGE = """v 0 0 0\nv 60 0 0\nv 0 0 30\nv 0 40 0\nv 60 40 0\nv 0 40 30
f 1 2 3\nf 4 6 5\nf 1 4 5 2\nf 1 3 6 4\nf 2 5 6 3\n"""


class Scenes:
    """Cases: `{"mutations": [[path, value], …]}`; the value `<many>` is the list's first entry many times."""

    name = "scene"
    seconds = 30.0

    def __init__(self, folder: Path) -> None:
        import franka_wm.envs.simulation.scene  # noqa: F401
        from franka_wm.envs import FrankaConfig, robots
        from franka_wm.envs.scene import Scene

        file = folder / "wedge.obj"
        file.write_text(WEDGE)
        wedge = {
            "name": "wedge",
            "shape": "mesh",
            "file": str(file),
            "scale": [0.001, 0.001, 0.001],
            "at": [0.2, -0.2],
        }
        self.scene = SCENE | {"objects": [*SCENE["objects"], wedge]}
        self.config = FrankaConfig(
            task="reach", gripper=True, observations=("state",), scene=Scene.of(self.scene)
        )
        robots.load_robot(self.config)
        lists = [[name] for name in ("objects", "obstacles", "articulated")]
        many = st.tuples(st.sampled_from(lists), st.just("<many>")).map(list)
        one = mutation(list(leaves(self.scene)))
        self.cases = st.fixed_dictionaries(
            {"mutations": st.lists(st.one_of(*[one] * 9, many), min_size=1, max_size=3)}
        )

    def use(self, case: dict[str, Any], folder: Path) -> None:
        """As the environment takes it, and as a world of it is built."""
        import numpy as np

        from franka_wm.envs.robots import add_robot, arm_builder
        from franka_wm.envs.simulation.scene import add_scene

        scene: Any = self.scene
        for path, value in case["mutations"]:
            scene = changed(scene, path, _many(path[0]) if value == "<many>" else value)
        config = dataclasses.replace(self.config, scene=scene)
        assert config.resolved_scene is not None
        builder = arm_builder()
        robot = add_robot(builder, config)
        add_scene(builder, config.resolved_scene, robot.tool_body, 0.0)
        for what in ("body_mass", "body_inertia", "body_q", "shape_transform", "shape_scale", "joint_X_p"):
            values = np.array([list(np.ravel(one)) for one in getattr(builder, what)], dtype=float)
            if not np.isfinite(values).all() or abs(values).max() > 1e4:
                raise AcceptedError(f"{what} of {abs(values).max()}", what)
        builder.finalize(device="cpu")


def _many(group: Any) -> list[Any]:
    first = SCENE[group][0]
    return [first | {"name": f"{first['name']}{k}"} for k in range(MANY)]
