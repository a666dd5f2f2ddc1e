"""URDF and MJCF files of a scene: masses, limits, axes, names, parents, whole elements, up to Newton's model."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

import cabinets
from rooms.forked import AcceptedError
from rooms.urdf import cases_of, damaged


class Mechanism:
    """Cases: as those of a robot's URDF, and which of the two files is damaged."""

    name = "mechanism"
    seconds = 30.0

    def __init__(self, folder: Path) -> None:
        import mujoco  # noqa: F401

        import franka_wm.envs.simulation.scene  # noqa: F401

        self.roots = {"urdf": ET.fromstring(cabinets.urdf()), "xml": ET.fromstring(cabinets.mjcf())}
        size = max(len(list(root.iter())) for root in self.roots.values())
        mutations = cases_of(size)
        self.cases = st.builds(
            lambda kind, case: case | {"kind": kind}, st.sampled_from(["urdf", "xml"]), mutations
        )

    def use(self, case: dict[str, Any], folder: Path) -> None:
        """As a scene takes it, and as a world of it is built."""
        import numpy as np

        from franka_wm.envs.robots import arm_builder
        from franka_wm.envs.scene import Scene
        from franka_wm.envs.simulation.scene import _add_articulated

        file = folder / f"cabinet.{case['kind']}"
        file.write_text(damaged(self.roots[case["kind"]], case["mutations"]), encoding="utf-8")
        one = {"name": "cabinet", "file": str(file), "handle": [-0.2, 0.0, 0.1], "at": [0.82, 0.0]}
        scene = Scene.of({"articulated": [one], "table": {"size": [1.5, 1.4, 0.05], "at": [0.55, 0.0, 0.0]}})
        builder = arm_builder()
        _add_articulated(builder, scene.articulated[0], 0.0, 0.0)
        for what in ("body_mass", "body_inertia", "body_q", "shape_transform", "shape_scale", "joint_X_p"):
            values = np.array([list(np.ravel(value)) for value in getattr(builder, what)], dtype=float)
            if not np.isfinite(values).all() or abs(values).max() > 1e4:
                raise AcceptedError(f"{what} of {abs(values).max()}", what)
        builder.finalize(device="cpu")
