"""The other side of benchmarks/against_xwm.py: runs in a Python that has `xwm` (JAX), prints rates as JSON.

Public interface only, everything jitted, compilation outside the measurement.
"""

from __future__ import annotations

import json
import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import xwm


def rate(work, seconds: float) -> float:
    for _ in range(2):
        jax.block_until_ready(work())
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        jax.block_until_ready(work())
        count += 1
    return count / (time.perf_counter() - started)


def updates(model, batch, seconds: float) -> float:
    trainer = xwm.training.Trainer(model, xwm.training.adamw(3e-4))
    box = {"state": trainer.init(), "i": 0}

    def work():
        box["i"] += 1
        box["state"], metrics = trainer.step(box["state"], batch, jr.PRNGKey(box["i"]))
        return metrics

    return rate(work, seconds)


def main() -> None:
    seconds = float(sys.argv[1])
    rng = np.random.default_rng(0)

    def draw(*shape):
        return jnp.asarray(rng.standard_normal(shape), jnp.float32)

    xwm.set_seed(0)
    rows = {}
    agent = xwm.families.tdmpc2.tdmpc2(action_dim=7, observation="state", state_dim=27)
    batch = {
        "observation": draw(64, 4, 27),
        "action": jnp.tanh(draw(64, 3, 7)),
        "reward": -jnp.abs(draw(64, 3)),
    }
    rows["TD-MPC2 updates, 512/512, batch 64"] = updates(agent, batch, seconds)

    planner, cost = xwm.families.tdmpc2.model.planner(agent)
    dynamics = agent.eval_mode().dynamics_fn()
    encode = agent.eval_mode().encode

    @eqx.filter_jit
    def plan(observation, key):
        return planner.plan(key, dynamics, encode(observation), cost).actions

    rows["MPPI plans, 512 x 6 x 3"] = rate(lambda: plan(draw(27), jr.PRNGKey(1)), seconds)

    muzero = xwm.families.muzero.muzero(n_actions=15, observation="state", state_dim=27)
    search = xwm.planning.MCTS(15, n_simulations=50)
    recurrent, predict = muzero.search_fns()
    represent = muzero.eval_mode().represent

    @eqx.filter_jit
    def move(observation, key):
        return search.search(key, represent(observation), recurrent, predict, add_noise=False).action

    rows["MCTS moves, 50 simulations"] = rate(lambda: move(draw(27), jr.PRNGKey(1)), seconds)

    many = eqx.filter_jit(jax.vmap(move))
    keys, observations = jr.split(jr.PRNGKey(1), 64), draw(64, 27)
    rows["MCTS moves, 50 simulations, 64 at once"] = 64 * rate(lambda: many(observations, keys), seconds)

    world = xwm.families.jepa.action_world_model(
        action_dim=7, size="tiny", img_size=64, patch_size=8, freeze_encoder=True
    )
    clips = {"video": jax.nn.sigmoid(draw(16, 4, 3, 64, 64)), "action": jnp.tanh(draw(16, 3, 7))}
    rows["action world model updates, 64 x 64, batch 16 of 4 frames"] = updates(world, clips, seconds)

    if len(sys.argv) > 2:  # a URDF: the environment is measured, too
        config = xwm.envs.FrankaConfig(image_size=64)
        env = xwm.envs.FrankaEnv(config, urdf_path=sys.argv[2])
        env.reset(seed=0)

        def steps():
            return np.asarray(env.step(np.tanh(rng.standard_normal(7)).astype(np.float32)))

        rows["environment steps, one arm, 64 x 64 pixels"] = rate(steps, seconds)
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
