"""Warp without its greeting, its line for each module that it loads, and the one about a missing CUDA driver.

Importing this sets Warp's level. To read it all, set ``wp.config.log_level = wp.LOG_INFO`` after the import of
``FrankaEnv`` and before an environment is made.
"""

from __future__ import annotations

import os
import sys
import tempfile
from functools import cache

import torch
import warp as wp

NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"

if wp.config.log_level == wp.LOG_INFO:  # its default
    wp.config.log_level = wp.LOG_WARNING


@cache
def start_warp() -> None:
    """Initialize Warp; on a machine without CUDA it does not say so, since a run names its device.

    Warp's library writes that line to file descriptor 2 itself, whatever the level. Everything else that appears there
    meanwhile is passed on.
    """
    if wp.config.log_level <= wp.LOG_INFO or torch.cuda.is_available() or sys.stderr is None:
        wp.init()
        return
    sys.stderr.flush()
    terminal = os.dup(2)
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)
            caught.seek(0)
            for line in caught:
                if NO_DRIVER not in line:
                    os.write(2, line)
