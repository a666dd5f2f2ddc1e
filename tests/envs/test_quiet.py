"""Warp is quiet unless somebody asks for what it says; other lines on file descriptor 2 are not lost."""

import subprocess
import sys

import pytest

MAKE = """
from franka_wm.envs import FrankaConfig, FrankaEnv
{before}
FrankaEnv(FrankaConfig(substeps=2), num_envs=1, device="cpu")
"""
ASKED = "import warp as wp; wp.config.log_level = wp.LOG_INFO"
OTHERS = """
import os, warp
init = warp.init
def speak():
    warp.init = init
    os.write(2, b"another line\\n")
    init()
warp.init = speak
"""


@pytest.mark.parametrize(
    ("before", "said"),
    [("", ""), (OTHERS, "another line\n"), (ASKED, "Module newton")],
    ids=["quiet", "others", "asked"],
)
def test_making_an_environment(before: str, said: str) -> None:
    command = [sys.executable, "-c", MAKE.format(before=before)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    if before == ASKED:
        assert said in done.stdout
    else:
        assert (done.stdout, done.stderr) == ("", said)
