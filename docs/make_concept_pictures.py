"""Makes the pictures of the concept pages: what masks hide, how latents collapse, what planners plan.

python docs/make_concept_pictures.py          writes docs/images/{masks,collapse,plans}.png, about two minutes
"""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict

from franka_wm import models
from franka_wm.data.policies import SmoothRandomPolicy
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.camera import project
from franka_wm.live.commanded import KinematicModel, commanded_path
from franka_wm.models.masks import make_masks
from franka_wm.planning import registry
from franka_wm.report.figure import new_figure, save_figure
from franka_wm.report.frames import mask_figure

OUT = Path(__file__).parent / "images"
SIDE, PATCH = 32, 4
CONFIG = FrankaConfig(
    observations=("pixels", "state", "joint_target"),
    goal_sampling="reachable",
    gravity_compensation=True,
    substeps=4,
    image_size=SIDE,
    action_scale=0.085,
    limit_velocity=True,
)


def masks(env: FrankaEnv) -> None:
    """One picture of the arm, and what three samplers hide of it."""
    torch.manual_seed(3)
    frame = env.render(64, samples=2)[0]
    grid = (1, 8, 8)
    hidden = {}
    for name in ("multiblock", "tube", "random"):
        drawn = make_masks(name, grid)(1, "cpu")
        cover = torch.ones(64, dtype=torch.bool)
        cover[drawn.context[0]] = False
        hidden[name] = cover
    save_figure(mask_figure(frame, hidden), OUT / "masks.png")


def collapse(env: FrankaEnv) -> None:
    """How far I-JEPA's features of different pictures of the arm lie apart, while it trains, by guard."""
    policy = SmoothRandomPolicy(7, generator=torch.Generator().manual_seed(0))
    played = env.rollout(40, policy, break_when_any_done=False)
    frames = played["pixels"].flatten(0, 1)
    shown = TensorDict({"pixels": frames[::8]}, batch_size=[len(frames[::8])])
    figure, (axes,) = new_figure()
    for guard in ("none", "ema", "sigreg", "vicreg"):
        torch.manual_seed(0)
        model = models.make(
            "jepa",
            observation_sizes={},
            image_sizes={"pixels": (SIDE, SIDE, 3)},
            action_dim=7,
            collapse=guard,
            encoder_width=48,
            encoder_depth=2,
            encoder_heads=3,
            patch_size=PATCH,
            predictor_width=48,
            predictor_depth=2,
            predictor_heads=3,
            guard_directions=128,
            ema_steps=300,
        )
        optimizer = torch.optim.AdamW(model.parameter_groups(2e-3))
        spread = []
        for update in range(300):
            if update % 25 == 0:
                spread.append(spread_of(model, shown))
            index = torch.randint(len(frames), (32, 1))
            batch = TensorDict(
                {"pixels": frames[index], "next": {"pixels": frames[index]}}, batch_size=[32, 1]
            )
            optimizer.zero_grad()
            model.loss(batch)["loss"].backward()
            optimizer.step()
            model.after_update()
        spread.append(spread_of(model, shown))
        axes.plot(range(0, 301, 25), spread, marker="o", markersize=3, label=guard)
        print(f"{guard:8s} spread {spread[0]:.4f} → {spread[-1]:.4f}", flush=True)
    axes.set_yscale("log")
    axes.legend(frameon=False, loc="center right")
    axes.set_xlabel("updates")
    axes.set_ylabel("spread of the features")
    axes.set_title("I-JEPA on the arm, by guard against collapse")
    save_figure(figure, OUT / "collapse.png")


@torch.no_grad()
def spread_of(model: torch.nn.Module, shown: TensorDict) -> float:
    """Mean over features of their standard deviation over pictures."""
    model.eval()
    latents = model.encode(shown)
    model.train()
    return float(latents.std(0).mean())


def plans(env: FrankaEnv) -> None:
    """What four planners command from one pose, over the arm's exact geometry."""
    size = 384
    tensordict = env.reset(seed=5)
    model = KinematicModel(env)
    observation = tensordict.select("joint_target", "goal")
    background = env.render(size, samples=2)[0].numpy()
    tool = env.tool_position()[:1]
    figure, panels = new_figure(columns=4, width=2.2, height=2.4)
    settings = {
        "mppi": {"horizon": 8},
        "cem": {"horizon": 8},
        "icem": {"horizon": 8},
        "gradient": {"horizon": 8},
    }
    goal = project(env.goal[:1], env.config, size)[0]
    for axes, (name, given) in zip(panels, settings.items(), strict=True):
        torch.manual_seed(0)
        planner = registry.make(name, action_dim=7, **given)
        with torch.no_grad():
            plan = planner.plan(model.encode(observation), model.next, model.score)["plan"]
        plan = plan[:, 0] if plan.dim() == 4 else plan  # iCEM carries its elites along
        path = torch.cat((tool, commanded_path(env, plan)[0]))
        seen = project(path, env.config, size)
        axes.imshow(background)
        axes.plot(seen[:, 0], seen[:, 1], "-o", color="#0072B2", markersize=3, linewidth=1.5)
        axes.plot(*goal, "o", color="#D55E00", markersize=8, fillstyle="none", markeredgewidth=2)
        axes.set_axis_off()
        left = float((path[-1] - env.goal[0]).norm())
        axes.set_title(f"{name}: {100 * left:.1f} cm left", fontsize=9)
    save_figure(figure, OUT / "plans.png")


def main() -> None:
    env = FrankaEnv(CONFIG, num_envs=16, device="cpu", seed=1)
    env.reset()
    masks(env)
    plans(env)
    collapse(env)


if __name__ == "__main__":
    main()
