"""Robot descriptions: masses, limits, axes, names, parents, whole elements."""

from __future__ import annotations

import copy
import math
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from rooms.forked import AcceptedError, NotApplicable

ATTRIBUTES = [
    "nan", "inf", "-inf", "0", "-1", "1e30", "1e-30", "1e400", "", "abc", "0 0", "0 0 0", "nan 0 0", "1 2 3 4",
    "0 0 1", "base", "fr3_link0", "fr3_link3", "fr3_link7", "fr3_hand", "nowhere", "floating", "planar", "fixed",
    "continuous", "prismatic", "revolute", "spherical", "x" * 3000, "../../../etc/passwd", "package://none/a.stl",
    "http://a.b/c.dae", "file:///dev/zero", "fr3_joint1", "fr3_joint7",
]  # fmt: skip


class Urdf:
    """Cases: `{"mutations": [[what, element's number, attribute's number or other element, text], …]}`."""

    name = "urdf"
    seconds = 30.0

    def __init__(self, folder: Path) -> None:
        import franka_wm.envs.robots as robots
        from franka_wm.envs import FrankaConfig

        source = Path(robots.__file__).with_name("fr3.urdf")
        self.root = ET.parse(source).getroot()
        self.config = FrankaConfig(observations=("state",))
        self.load = robots.load_robot
        self.load(self.config)
        self.cases = cases_of(len(list(self.root.iter())))

    def use(self, case: dict[str, Any], folder: Path) -> None:
        """As the environment loads it, and as a world of it is built."""
        import newton
        import numpy as np

        from franka_wm.envs.robots import add_robot, arm_builder

        file = folder / "robot.urdf"
        file.write_text(damaged(self.root, case["mutations"]), encoding="utf-8")
        builder = arm_builder()
        robot = add_robot(builder, self.config, file)
        _finite(robot.lower, "limits")
        _finite(robot.upper, "limits")
        _finite(robot.velocity_limit, "speed limits")
        _finite(robot.axes, "axes")
        _finite(np.array(builder.body_mass), "masses")
        _finite(np.array(builder.body_inertia, dtype=float), "inertias")
        if min(builder.body_mass) <= 0:
            raise AcceptedError("a link without a mass", "mass")
        model = builder.finalize(device="cpu")
        newton.eval_fk(model, model.joint_q, model.joint_qd, model.state())


def cases_of(size: int) -> Any:
    """Cases of a file of so many elements."""
    number = st.integers(0, size - 1)
    return st.fixed_dictionaries(
        {
            "mutations": st.lists(
                st.one_of(
                    *[
                        st.tuples(
                            st.just("attribute"), number, st.integers(0, 5), st.sampled_from(ATTRIBUTES)
                        ),
                    ]
                    * 4,
                    st.tuples(st.just("drop"), number, st.just(0), st.just("")),
                    st.tuples(st.just("double"), number, st.just(0), st.just("")),
                    st.tuples(st.just("move"), number, number, st.just("")),
                    st.tuples(
                        st.just("tag"),
                        number,
                        st.just(0),
                        st.sampled_from(["link", "joint", "mesh", "x", "inertial"]),
                    ),
                    st.tuples(st.just("empty"), number, st.just(0), st.just("")),
                    st.tuples(st.just("cut"), st.integers(0, 30000), st.just(0), st.just("")),
                ).map(list),
                min_size=1,
                max_size=3,
            )
        }
    )


def damaged(source: ET.Element, mutations: list[Any]) -> str:
    """A file with so many mutations."""
    root, cut = copy.deepcopy(source), None
    for what, first, second, text in mutations:
        elements = list(root.iter())
        parents = {child: parent for parent in elements for child in parent}
        if what == "cut":
            cut = first
            continue
        element = elements[first % len(elements)]
        if what == "attribute":
            names = sorted(element.attrib)
            if not names:
                raise NotApplicable("no attribute")
            element.set(names[second % len(names)], text)
        elif what == "tag":
            element.tag = text
        elif what == "empty":
            element.attrib.clear()
        elif element not in parents:
            raise NotApplicable("the root")
        elif what == "drop":
            parents[element].remove(element)
        elif what == "double":
            parents[element].append(copy.deepcopy(element))
        else:
            target = elements[second % len(elements)]
            if target in element.iter():
                raise NotApplicable("into itself")
            parents[element].remove(element)
            target.append(element)
    return ET.tostring(root, encoding="unicode")[:cut]


def _finite(array: Any, what: str) -> None:
    if any(math.isnan(float(x)) for x in array.flatten()):
        raise AcceptedError(f"{what} that are NaN", what)
