"""Which columns of a LeRobot dataset become which entries of a training batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from franka_wm.data.lerobot import schema
from franka_wm.data.lerobot.provenance import read_provenance
from franka_wm.data.lerobot.source import Source
from franka_wm.errors import UserError
from franka_wm.options import is_whole
from franka_wm.untrusted import values_of

AFTER = {
    "reward": schema.REWARD,
    "done": schema.DONE,
    "terminated": schema.TERMINATED,
    "truncated": schema.TRUNCATED,
    "success": schema.SUCCESS,
}
"""What follows an action: entry under ``next`` → the feature that LeRobot's convention gives it."""

RESERVED = ("is_init", "next")
NUMBERS = ("float16", "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "bool")
_OBSERVATION = "observation."
_IMAGE = "observation.image"


@dataclass(frozen=True)
class FeatureMap:
    """Entries of a batch and where they come from.

    Attributes:
        images: Observation key → (feature, (H, W, 3) as it will be given out).
        vectors: Observation key → (features that are put one behind the other, size in all).
        action: (features, size); a discrete one has size 0.
        after: Entry of ``next`` → feature.
        ours: Whether the dataset was written by this package: actions are already in [−1, 1], and terminal
            observations may lie beside the rows.
        notes: One line for everything that was decided here and is not obvious.
    """

    images: dict[str, tuple[str, tuple[int, int, int]]]
    vectors: dict[str, tuple[tuple[str, ...], int]]
    action: tuple[tuple[str, ...], int]
    after: dict[str, str]
    ours: bool
    notes: tuple[str, ...] = field(default=(), compare=False)

    @property
    def discrete(self) -> bool:
        """Whether actions are whole numbers."""
        return self.action[1] == 0

    @property
    def image_features(self) -> list[str]:
        """All features that are images, each once."""
        return list(dict.fromkeys(feature for feature, _ in self.images.values()))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, without the notes."""
        out = asdict(self)
        out.pop("notes")
        return out


def map_features(
    source: Source,
    *,
    features: Mapping[str, str | Sequence[str]] | None = None,
    keys: Sequence[str] | None = None,
    rewards_for: str | None = None,
    image_size: int | Sequence[int] | None = None,
) -> FeatureMap:
    """Decides what is read from a dataset and what it is called.

    Without ``features``, by convention:

    ==================================  ==============================================================
    feature                             entry
    ==================================  ==============================================================
    ``observation.images.goal``         ``goal_pixels`` (ours: ``….goal_<camera>`` as ``goal_pixels_<camera>``)
    first other image                 ``pixels`` (ours: as the arm named it)
    further ones                        ``pixels_<camera>``
    ``observation.state``               ``state``
    ``observation.environment_state``   ``goal`` in a dataset of ours, else ``environment_state``
    ``observation.<name>``              ``<name>``, dots replaced by underscores
    ``joint_target``, ``objects``       the same, in a dataset of ours
    ``action``                          ``action``
    ``next.reward``, ``next.done``, …   the same under ``next``, without the prefix
    ==================================  ==============================================================

    Depth images, texts and features of several dimensions are left out.

    Args:
        source: The dataset.
        features: Entry → feature, or a list of vectors that are put one behind the other. It replaces the
            observations above; ``action`` and the entries under ``next`` may be left to convention.
        keys: Observations that are needed; others are not read. ``None``: all.
        rewards_for: Who learns from rewards; ``None``: nobody.
        image_size: Side of the square, or (height, width), that images are resized to [px].

    Raises:
        UserError: For a feature or key that is not there, or one that cannot be used.
    """
    there = {name: spec for name, spec in source.features.items() if name not in schema.AUTOMATIC}
    ours = schema.EPISODE_KEY in there and schema.SEED in there
    size = _image_size(image_size)
    given = None if not features else {key: _names(key, value) for key, value in features.items()}
    notes: list[str] = []
    if given is None:
        observed, left_out = _by_convention(there, ours, _recorded_as(source) if ours else {})
        if left_out:
            notes.append(f"not read: {', '.join(left_out)}; name what you need under dataset.features")
    else:
        observed = {key: names for key, names in given.items() if key != "action" and key not in AFTER}
    if keys is not None:
        lacking = [key for key in keys if key not in observed]
        if lacking:
            raise UserError(
                f"{source.root} gives no {lacking[0]!r}; observations there: {_list(observed)}. "
                f"Say which feature it is: dataset.features={{{lacking[0]}: …}} ({_list(there)})"
            )
        observed = {key: observed[key] for key in observed if key in keys}
    if not observed:
        raise UserError(
            f"{source.root} has no observation that can be used; name them under dataset.features ({_list(there)})"
        )
    images: dict[str, tuple[str, tuple[int, int, int]]] = {}
    vectors: dict[str, tuple[tuple[str, ...], int]] = {}
    for key, names in observed.items():
        for name in names:
            _known(source, key, name, there)
        if any(is_image(there[name]) for name in names):
            if len(names) != 1:
                raise UserError(
                    f"dataset.features.{key}: one image, or a list of vectors; got {_list(names)}"
                )
            height, width = image_shape(source, names[0])
            images[key] = (names[0], (*(size or (height, width)), 3))
        else:
            vectors[key] = (names, sum(_vector_size(source, key, name) for name in names))
    names = (schema.ACTION,) if given is None or "action" not in given else given["action"]
    for name in names:
        _known(source, "action", name, there)
    spec = there[names[0]]
    discrete = len(names) == 1 and "int" in spec["dtype"] and tuple(spec["shape"]) == (1,)
    action_size = 0 if discrete else sum(_vector_size(source, "action", name) for name in names)
    after: dict[str, str] = {}
    for key, usual in AFTER.items():
        named = (given or {}).get(key)
        if named is not None:
            if len(named) != 1:
                raise UserError(f"dataset.features.{key}: must be one feature, got {_list(named)}")
            _known(source, key, named[0], there)
        if named is not None or usual in there:
            after[key] = named[0] if named is not None else usual
            if _vector_size(source, key, after[key]) != 1:
                raise UserError(
                    f"dataset.features.{key}={after[key]}: must be a single number per row, "
                    f"its shape is {tuple(there[after[key]]['shape'])}"
                )
    if "reward" not in after and rewards_for is not None:
        raise UserError(
            f"{source.root} has no reward, which {rewards_for} learns from: say which feature it is, "
            f"dataset.features={{reward: …, …}} ({_list(there)}), or use a model that needs none, such as model=lewm"
        )
    if "reward" not in after:
        notes.append("no reward in the dataset: families that learn from rewards cannot be trained on it")
    if "terminated" not in after and ("reward" in after or "done" in after):
        notes.append(_terminated_note(after))
    return FeatureMap(images, vectors, (names, action_size), after, ours, tuple(notes))


def is_image(spec: Mapping[str, Any]) -> bool:
    """Whether a feature is an image (depth included)."""
    return spec.get("dtype") in ("image", "video")


def is_depth(spec: Mapping[str, Any]) -> bool:
    """Whether an image is a depth map, by LeRobot's marks."""
    infos = [spec.get("info") or {}, spec.get("video_info") or {}]
    return any(info.get("is_depth_map") or info.get("video.is_depth_map") for info in infos)


def image_shape(source: Source, name: str) -> tuple[int, int]:
    """Height and width of an image feature, whether it is written (H, W, C) or (C, H, W).

    Raises:
        UserError: If it is a depth map or has no three channels.
    """
    spec = source.features[name]
    shape = tuple(spec["shape"])
    if is_depth(spec) or len(shape) != 3 or 3 not in (shape[0], shape[-1]):
        raise UserError(f"{source.root}: {name} {shape} is not a colour image; leave it out")
    names = spec.get("names")
    first = names[0] if isinstance(names, list) and len(names) == 3 else None
    if shape[0] == 3 and (shape[-1] != 3 or first in ("channel", "channels")):
        return shape[1], shape[2]
    return shape[0], shape[1]


def _by_convention(
    there: Mapping[str, Mapping[str, Any]], ours: bool, recorded_as: Mapping[str, str]
) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    observed: dict[str, tuple[str, ...]] = {}
    left_out: list[str] = []
    for name, spec in there.items():
        if name.startswith(_IMAGE) and is_image(spec):
            camera = name.rsplit(".", 1)[-1]
            key = f"pixels_{camera}" if "pixels" in observed else "pixels"
            if name == schema.IMAGE_PREFIX + "goal" or (ours and camera.startswith("goal_")):
                key = "goal_pixels" + camera.removeprefix("goal")
            key = recorded_as.get(name, key)  # also where the first camera was not recorded
            usable = not is_depth(spec) and len(spec["shape"]) == 3
        elif name.startswith(_OBSERVATION):
            key = name.removeprefix(_OBSERVATION).replace(".", "_")
            key = "goal" if ours and name == schema.GOAL else key
            usable = spec.get("dtype") in NUMBERS and len(spec["shape"]) == 1
        elif ours and name in (schema.TARGET, schema.OBJECTS):
            key, usable = name, True
        else:
            continue
        if not usable or key in observed or key in ("action", *AFTER, *RESERVED):
            left_out.append(name)
        else:
            observed[key] = (name,)
    return observed, left_out


def _recorded_as(source: Source) -> dict[str, str]:
    """Images of a dataset of ours → what the arm called them, as far as it says so."""
    with values_of(str(source.root), "copy or download the dataset again"):
        names = ((read_provenance(source.root) or {}).get("schema") or {}).get("sources") or {}
        pictures = ("pixels", "goal_pixels")
        return {
            feature: key for feature, key in names.items() if key.startswith(pictures) and key.isidentifier()
        }


def _terminated_note(after: Mapping[str, str]) -> str:
    if "done" in after and "truncated" in after:
        return "terminated: where done and not truncated"
    if "done" in after and "success" in after:
        return "terminated: where an episode is done with success; other ends count as cut off by time"
    return "terminated: never, every end counts as cut off by time; if that is wrong, name a feature for it"


def _names(key: str, value: Any) -> tuple[str, ...]:
    names: tuple[str, ...] = ()
    if isinstance(value, str):
        names = (value,)
    elif isinstance(value, Sequence):
        names = tuple(value)
    if not names or not all(isinstance(name, str) for name in names):
        raise UserError(f"dataset.features.{key}={value!r}: must be a feature's name, or a list of names")
    if key in RESERVED or "." in key:
        raise UserError(f"dataset.features.{key}: an entry cannot have this name")
    return names


def _known(source: Source, key: str, name: str, there: Mapping[str, Any]) -> None:
    if name not in there:
        raise UserError(
            f"dataset.features.{key}={name}: {source.root} has no such feature; there are {_list(there)}"
        )


def _vector_size(source: Source, key: str, name: str) -> int:
    spec = source.features[name]
    if is_image(spec) or spec.get("dtype") not in NUMBERS or len(spec["shape"]) != 1:
        raise UserError(
            f"dataset.features.{key}={name}: must be a vector of numbers; it is {spec.get('dtype')} "
            f"{tuple(spec['shape'])} in {source.root}"
        )
    return int(spec["shape"][0])


def _image_size(image_size: int | Sequence[int] | None) -> tuple[int, int] | None:
    if image_size is None:
        return None
    sides = (image_size, image_size) if isinstance(image_size, int) else tuple(image_size)
    if len(sides) != 2 or not all(is_whole(side) and side > 0 for side in sides):
        raise UserError(f"dataset.image_size={image_size!r}: must be a number of pixels, or [height, width]")
    return sides[0], sides[1]


def _list(names: Any) -> str:
    return ", ".join(names)
