"""Draws the pictures of docs/reports.md from real runs: every kind of plot, and the run's page in a browser.

python docs/make_report_pictures.py RUN [RUN …]

The first run needs what ``franka-wm evaluate checkpoint=RUN`` writes; further ones (other seeds) give the curves their
band. Needs chromium for the second picture.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from PIL import Image

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.report.bars import bars_figure
from franka_wm.report.calibration import calibration_figure
from franka_wm.report.curves import seeds_figure
from franka_wm.report.figure import save_figure
from franka_wm.report.frames import mask_figure, strip_figure
from franka_wm.report.horizon import horizon_figure
from franka_wm.report.page import write_page
from franka_wm.report.run import read_run
from franka_wm.report.spectra import latent_figure, spectrum_figure
from franka_wm.report.style import DARK, LIGHT, POLICY_COLOURS, Theme, policy_name
from franka_wm.video import tile_frames, write_png

FOLDER = Path(__file__).parent / "images"
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
WIDTH, HEIGHT = 690, 465
"""Of one picture in the sheet [px]."""


def main(runs: list[str]) -> None:
    if not runs:
        sys.exit("usage: python docs/make_report_pictures.py RUN [RUN …]")
    found = [read_run(run) for run in runs]
    with tempfile.TemporaryDirectory() as place:
        sheet = []
        for theme in (LIGHT, DARK):
            paths = [
                save_figure(figure, Path(place) / f"{theme.name}{k}.png")
                for k, figure in enumerate(figures(found, theme))
            ]
            sheet += [fitted(path, theme) for path in paths]
        write_png(tile_frames(torch.stack(sheet).unsqueeze(0), columns=4)[0], FOLDER / "plots.png")
        print(FOLDER / "plots.png")
        page = write_page(found[0].folder, Path(place) / "report.html")
        photograph(page, Path(place))
    print(FOLDER / "report.png")


def figures(runs: list, theme: Theme) -> list:
    """One of each kind."""
    first = runs[0]
    rows = [run.rows for run in runs]
    more, policies = first.extras, first.policies
    latents = more["latents"]
    success = {policy_name(name): {"": v["success"]["0.05"]} for name, v in policies.items()}
    colours = {policy_name(name): colour for name, colour in POLICY_COLOURS.items()}
    frames = rollout()
    hidden = torch.zeros(8, 8, dtype=torch.bool)
    hidden[2:6, 3:6] = True
    return [
        seeds_figure({"policy": rows}, "eval/policy/final_distance", theme=theme),
        horizon_figure(
            more["open_loop"]["curves"],
            steps=more["open_loop"]["steps"],
            unit=more["open_loop"]["unit"],
            theme=theme,
        ),
        spectrum_figure({"singular values": more["spectrum"]["singular_values"]}, theme=theme),
        latent_figure(latents["points"], latents["quantity"], label=latents["label"], theme=theme),
        bars_figure(success, label="success at 5 cm [%]", scale=100, colours=colours, theme=theme),
        calibration_figure(more["calibration"], theme=theme),
        strip_figure({"random": frames[0], "still": frames[1]}, columns=5, theme=theme),
        mask_figure(frames[0][0], {"target": hidden, "context": ~hidden}, theme=theme),
    ]


def rollout(steps: int = 16) -> torch.Tensor:
    """(2, T, 64, 64, 3) uint8: an arm that moves at random, and one that does nothing."""
    env = FrankaEnv(FrankaConfig(pose_noise=0.5, gravity_compensation=True), num_envs=2, device="cpu", seed=5)
    env.set_seed(5)
    torch.manual_seed(0)
    direction = 2 * torch.rand(env.action_dim) - 1
    state, frames = env.reset(), []
    for _ in range(steps):
        frames.append(state["pixels"].clone())
        state["action"] = torch.stack([direction, torch.zeros_like(direction)])
        state = env.step(state)["next"]
    return torch.stack(frames, 1)


def fitted(path: Path, theme: Theme) -> torch.Tensor:
    """A picture in the middle of a panel of its theme's ground."""
    panel = Image.new("RGB", (WIDTH, HEIGHT), theme.colour("#FFFFFF"))
    with Image.open(path) as picture:
        picture = picture.convert("RGB")
        picture.thumbnail((WIDTH - 20, HEIGHT - 20))
        panel.paste(picture, ((WIDTH - picture.width) // 2, (HEIGHT - picture.height) // 2))
    return torch.frombuffer(bytearray(panel.tobytes()), dtype=torch.uint8).view(HEIGHT, WIDTH, 3)


def photograph(page: Path, place: Path) -> None:
    """The top of the page: on a desktop in the light, beside it on a phone in the dark."""
    shots = []
    for name, width, dark in (("desktop", 1180, False), ("phone", 390, True)):
        shot = place / f"{name}.png"
        command = [shutil.which("chromium") or "chromium", *FLAGS, f"--user-data-dir={place / name}"]
        command += ["--blink-settings=preferredColorScheme=0"] if dark else []
        command += [f"--window-size={width},1500", f"--screenshot={shot}", page.as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        shots.append(Image.open(shot).convert("RGB"))
    whole = Image.new("RGB", (sum(s.width for s in shots) + 30, 1500), "#8A8A8A")
    whole.paste(shots[0], (0, 0))
    whole.paste(shots[1], (shots[0].width + 30, 0))
    frame = torch.frombuffer(bytearray(whole.tobytes()), dtype=torch.uint8).view(1500, whole.width, 3)
    write_png(frame, FOLDER / "report.png")


if __name__ == "__main__":
    main(sys.argv[1:])
