"""Devices by name."""

from __future__ import annotations

import os
import shutil
import sysconfig
from pathlib import Path

import torch

from franka_wm.errors import UserError
from franka_wm.products import prefer_onednn


def resolve_device(device: torch.device | str | None) -> torch.device:
    """``None`` or ``"auto"``: the first GPU, or the CPU where there is none; otherwise the device, checked.

    Raises:
        UserError: If CUDA is asked for where there is none, or the device is of another kind.
    """
    if device is None or device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    asked = device
    try:
        device = torch.device(device)
    except (RuntimeError, TypeError, ValueError) as error:
        raise UserError(f"device={asked!r}: must be auto, cpu, cuda or cuda:K") from error
    if device.type == "cuda":
        index = 0 if device.index is None else device.index
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if not 0 <= index < count:  # torch keeps the lowest eight bits of a larger one
            raise UserError(
                f"device={asked}: this machine has {count} usable CUDA devices; use device=cpu or auto"
            )
        return torch.device("cuda", index)
    if device.type != "cpu" or device.index:
        raise UserError(f"device={device}: Newton runs on cpu, which has no number, and cuda")
    return torch.device("cpu")


def prefer_speed(device: torch.device, *, onednn: bool | None = None) -> None:
    """Let CUDA round float32 products to TF32, and time convolutions of each new size to choose the fastest way.

    For training, whose sizes stay the same.

    Args:
        onednn: Whether oneDNN multiplies on a CPU, see :func:`~franka_wm.products.prefer_onednn`; ``None``: as before.

    Raises:
        UserError: If oneDNN is asked for on CUDA, or this PyTorch has none.
    """
    if onednn and device.type != "cpu":
        raise UserError("trainer.onednn=true: needs device=cpu; give trainer.onednn=false")
    if onednn is not None:
        prefer_onednn(onednn)
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")
        torch.backends.cudnn.benchmark = True


def missing_to_compile(device: torch.device) -> str | None:
    """What ``torch.compile`` needs for a device and this machine has not, in words; ``None``: nothing is missing.

    On CUDA Triton builds its launchers with a C compiler, on a CPU the code itself is C++; both read Python's headers.
    """
    own, usual = ("CC", ["gcc", "clang"]) if device.type == "cuda" else ("CXX", ["g++"])
    compilers = [os.environ[own]] if os.environ.get(own) else usual
    if not any(map(shutil.which, compilers)):
        return f"a compiler ({' or '.join(compilers)})"
    if not Path(sysconfig.get_path("include", "posix_prefix"), "Python.h").is_file():
        return "Python's headers (Python.h; the package python3-dev)"
    return None
