"""Nested values in two files: their structure as JSON, the tensors among them as safetensors. Nothing is pickled."""

import json
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from franka_wm.errors import UserError
from franka_wm.untrusted import UntrustedFolder, values_of


def write_tree(folder: Path, name: str, tree: object) -> None:
    """Nested values into `name.json`, the tensors among them into `name.safetensors`.

    Args:
        folder: exists.
        name: of both files.
        tree: dicts with str and int keys, lists and tuples, of numbers, strings, None, arrays and tensors.

    Raises:
        TypeError: anything else is among them; the message names the place.
    """
    tensors: dict[str, Tensor] = {}
    structure = _encode(tree, name, tensors)
    write_json(folder / f"{name}.json", structure)
    save_tensors(tensors, folder / f"{name}.safetensors")


def nested(data: TensorDictBase) -> dict[str, object]:
    """A TensorDict as nested dicts of tensors."""
    return {
        str(key): nested(value) if isinstance(value, TensorDictBase) else value for key, value in data.items()
    }


def read_tree(folder: Path, name: str) -> object:
    """What `write_tree` wrote; tensors on the CPU, arrays as lists.

    Raises:
        UserError: another program wrote these files.
    """
    with damaged(folder, f"{name}.json"):
        structure = json.loads(UntrustedFolder(folder).bytes(f"{name}.json") or b"")
        return _decode(structure, read_tensors(folder, name))


def read_tensors(folder: Path, name: str) -> dict[str, Tensor]:
    """The tensors of `name.safetensors`, on the CPU.

    Raises:
        UserError: it is no such file.
    """
    try:
        return {key: _aligned(x) for key, x in load_file(folder / f"{name}.safetensors").items()}
    except (SafetensorError, OSError, ValueError, RuntimeError, KeyError) as error:
        raise UserError(
            f"checkpoint {folder} is damaged: {name}.safetensors cannot be read ({error}); use another checkpoint."
        ) from error


def _aligned(x: Tensor) -> Tensor:
    """The tensor where torch's own memory would begin: products of others round otherwise, and a run would part."""
    return x if x.data_ptr() % 64 == 0 else x.clone()


def only_tensors(
    entries: Mapping[str, Any], batch_size: Sequence[int], device: torch.device | str | None
) -> TensorDict:
    """Nested values as a TensorDict.

    Raises:
        ValueError: It names an entry that is no tensor.
    """
    found = TensorDict(entries, batch_size=batch_size, device=device)
    other = [key for key, value in found.items(True) if not isinstance(value, Tensor | TensorDict)]
    if other:
        raise ValueError(f"{other[0]} is no tensor")
    return found


def damaged(folder: Path, name: str = "one of its files") -> AbstractContextManager[None]:
    """Around the use of a checkpoint's values, which somebody else may have written."""
    return values_of(f"checkpoint {folder} is damaged: {name}", "use another checkpoint.")


def first_difference(saved: Mapping[str, Tensor], here: Mapping[str, Tensor]) -> str | None:
    """In words, the first entry (in the model's order) that is not the same in shape and dtype."""
    for name, tensor in here.items():
        if name not in saved:
            return f"{name} is missing in the checkpoint"
        for what in ("shape", "dtype"):
            there, wanted = getattr(saved[name], what), getattr(tensor, what)
            if there != wanted:
                there, wanted = (tuple(v) if what == "shape" else v for v in (there, wanted))
                return f"{name} has {what} {there} in the checkpoint and {wanted} in the model"
    unknown = next((name for name in saved if name not in here), None)
    return None if unknown is None else f"{unknown} is in the checkpoint but not in the model"


def tree_files(name: str) -> tuple[str, str]:
    """The names of the two files."""
    return f"{name}.json", f"{name}.safetensors"


def _encode(value: object, where: str, tensors: dict[str, Tensor]) -> object:
    """JSON for `value`. What JSON has not (tensors, tuples, dicts with int keys) becomes a tagged list."""
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Tensor):
        while where in tensors:  # {"1": …, 1: …}, or {"a/b": …, "a": {"b": …}}
            where += "'"
        tensors[where] = value
        return ["tensor", where]
    if isinstance(value, Mapping):
        items = [[_key(k, where), _encode(v, f"{where}/{k}", tensors)] for k, v in value.items()]
        return ["dict", items]
    if isinstance(value, tuple | list):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return [kind, [_encode(v, f"{where}/{i}", tensors) for i, v in enumerate(value)]]
    if isinstance(value, np.ndarray | np.generic):
        return _encode(value.tolist(), where, tensors)
    raise TypeError(
        f"{where} is a {type(value).__name__}, which a checkpoint cannot hold: use numbers, strings, None, "
        "tensors, and dicts, lists and tuples of these"
    )


def _decode(value: object, tensors: Mapping[str, Tensor]) -> object:
    if not isinstance(value, list):
        return value
    kind, content = value
    if kind == "tensor":
        return tensors[content]
    if kind == "dict":
        return {k: _decode(v, tensors) for k, v in content}
    items = [_decode(v, tensors) for v in content]
    return tuple(items) if kind == "tuple" else items


def _key(key: object, where: str) -> str | int:
    if isinstance(key, str | int):
        return key
    raise TypeError(f"{where} has the key {key!r}; a checkpoint holds dicts with str and int keys only")


def save_tensors(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Like safetensors' `save_file`, which refuses tensors that share memory: such are written twice."""
    storages: set[int] = set()
    separate = {}
    for name, tensor in tensors.items():
        tensor = tensor.detach().cpu().contiguous()
        pointer = tensor.untyped_storage().data_ptr()
        if pointer in storages:
            tensor = tensor.clone()
        storages.add(pointer)
        separate[name] = tensor
    save_file(separate, path)


def write_json(path: Path, value: object) -> None:
    """One JSON value."""
    # No newline at the end: so every truncation, even by one byte, leaves invalid JSON.
    path.write_text(json.dumps(value, indent=1), encoding="utf-8")
