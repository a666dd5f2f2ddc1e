"""Makes the pictures of the concept pages: what an environment shows, what a dataset holds, what masks hide, how
latents collapse, what planners plan, how an agent was judged; of a trained run how its model imagines.

python docs/make_concept_pictures.py        docs/images/{environment,dataset,masks,collapse,plans,evaluation}.png
python docs/make_concept_pictures.py RUN    docs/images/contract.png
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import torch
from tensordict import TensorDict

from franka_wm import models
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.camera import project
from franka_wm.evaluation.projection import principal_components
from franka_wm.live.commanded import KinematicModel, commanded_path
from franka_wm.models.masks import make_masks
from franka_wm.planning import registry
from franka_wm.policies.scripted import IKPolicy, SmoothRandomPolicy
from franka_wm.report.bars import bars_figure
from franka_wm.report.figure import finish_axes, new_figure, save_figure
from franka_wm.report.frames import mask_figure, strip_figure
from franka_wm.report.style import BLUE, GREY, VERMILION, policy_colour, series_style

OUT = Path(__file__).parent / "images"
JUDGED = Path(__file__).parent / "results/reach-cpu/seed-100.json"
"""The first seed of the first row of results.md."""
TITLES = {
    "planner": "planner",
    "policy": "policy alone",
    "noop": "doing nothing",
    "random": "random motion",
    "ik": "inverse kinematics",
}
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


def environment() -> None:
    """Everything one arm shows while inverse kinematics drives it to its goal."""
    config = FrankaConfig(
        observations=("pixels", "depth", "segmentation", "goal_pixels", "state", "joint_target"),
        cameras=("front", "side", "wrist"),
        goal_sampling="reachable",
        gravity_compensation=True,
        limit_velocity=True,
        action_scale=0.085,
        show_goal=True,
        substeps=4,
        image_size=96,
    )
    env = FrankaEnv(config, num_envs=1, device="cpu", seed=4)
    policy = IKPolicy(env.kinematics, config)
    state, rows = env.reset(), {}
    for _ in range(11):
        kinds = torch.unique(state["segmentation"], return_inverse=True)[1].float()
        shown = {
            "pixels": state["pixels"],
            "side": state["pixels_side"],
            "wrist": state["pixels_wrist"],
            "depth": grey((1.0 - state["depth"] / 2.0).clamp(0.0, 1.0) * (state["depth"] > 0.0)),
            "segmentation": grey(kinds / kinds.max().clamp_min(1.0)),
            "goal_pixels": state["goal_pixels"],
        }
        for name, picture in shown.items():
            rows.setdefault(name, []).append(picture[0])
        state = env.step(policy(state))["next"]
    save_figure(
        strip_figure({k: torch.stack(v) for k, v in rows.items()}, columns=6), OUT / "environment.png"
    )


def grey(values: torch.Tensor) -> torch.Tensor:
    """(N, H, W) or (N, H, W, 1) in [0, 1] -> (N, H, W, 3) uint8."""
    values = values.reshape(*values.shape[:3], 1)
    return (255 * values).to(torch.uint8).expand(*values.shape[:3], 3)


def dataset() -> None:
    """One recorded episode, as LeRobot's own reader gives it back."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from franka_wm.commands.collect import collect

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "reach"
        collect(
            [f"out={root}", "episodes=1", "policy=ik", "env=reach_pixels", "env.episode_length=24", "seed=5"]
        )
        rows = LeRobotDataset("local/reach", root=root)
        camera = next(key for key in rows.meta.camera_keys if not key.endswith("goal"))
        episode = [rows[k] for k in range(len(rows))]
    frames = torch.stack([(255 * row[camera]).round().to(torch.uint8).permute(1, 2, 0) for row in episode])
    figure, panels = new_figure(rows=3, width=7.0, height=1.5)
    taken = [round(k * (len(frames) - 1) / 7) for k in range(8)]
    panels[0].imshow(torch.cat([frames[k] for k in taken], 1).numpy(), interpolation="nearest")
    panels[0].set_axis_off()
    panels[0].set_title(camera, fontsize=9)
    time = [float(row["timestamp"]) for row in episode]
    for axes, key, count in ((panels[1], "action", 7), (panels[2], "next.reward", 1)):
        values = torch.stack([row[key].reshape(-1)[:count] for row in episode])
        for index, line in enumerate(values.unbind(1)):
            axes.plot(time, line.numpy(), linewidth=1.2, color=series_style(index)[0])
        finish_axes(axes, y=key, x="time [s]" if count == 1 else "")
    save_figure(figure, OUT / "dataset.png")


def contract(run: str) -> None:
    """What `encode` says of an episode, and what `next` imagines from some of its steps."""
    from franka_wm.evaluation.rollouts import encode_episodes, gather_episodes
    from franka_wm.training.load import load_agent

    agent = load_agent(run, num_envs=1, device="cpu")
    episode, _ = gather_episodes(
        agent.env, agent.policies["planner"], keys=list(agent.model.observation_sizes)
    )
    embed = agent.model.embed
    with torch.no_grad():
        real = encode_episodes(agent.model, episode)[0]
        branches = {}
        for start in range(0, len(real) - 6, 4):
            z = [real[start]]
            for action in episode["action"][0, start : start + 6]:
                z.append(agent.model.next(z[-1], action))
            branches[start] = torch.stack(z)
    every = torch.cat([embed(real), *(embed(z) for z in branches.values())]).numpy()
    points = torch.as_tensor(principal_components(every).points)[:, :2]
    figure, (axes,) = new_figure(width=6.0, height=3.6)
    path, rest = points[: len(real)], points[len(real) :]
    axes.plot(path[:, 0], path[:, 1], "-o", color=GREY, markersize=4, label="encode(observation)")
    for index, branch in enumerate(rest.split(7)):
        label = "next(next(…)), six steps from here" if index == 0 else None
        axes.plot(branch[:, 0], branch[:, 1], "-", color=BLUE, linewidth=1.2, marker=".", label=label)
        axes.plot(*branch[0], "o", color=VERMILION, markersize=6, fillstyle="none")
    axes.legend(fontsize=8, frameon=False)
    finish_axes(axes, x="first principal component of the latents", y="second")
    save_figure(figure, OUT / "contract.png")


def evaluation() -> None:
    """How far from the goal every policy ended, with intervals."""
    policies = json.loads(JUDGED.read_text())["policies"]
    bars = {TITLES[name]: {"": values["final_distance"]} for name, values in policies.items()}
    colours = {TITLES[name]: policy_colour(name) for name in policies}
    figure = bars_figure(bars, label="final distance to the goal [cm]", scale=100, colours=colours)
    save_figure(figure, OUT / "evaluation.png")


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


def main(runs: list[str]) -> None:
    if runs:
        contract(runs[0])
        return
    evaluation()
    environment()
    dataset()
    env = FrankaEnv(CONFIG, num_envs=16, device="cpu", seed=1)
    env.reset()
    masks(env)
    plans(env)
    collapse(env)


if __name__ == "__main__":
    main(sys.argv[1:])
