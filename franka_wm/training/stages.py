"""Two stages: an encoder from images alone, then a model whose dynamics are learned on top of it, frozen.

V-JEPA 2-AC's recipe (arXiv:2506.09985): with the encoder fixed, the targets of the dynamics are fixed, too, and nothing
can be gained by making them easier.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import TYPE_CHECKING

from franka_wm import processes
from franka_wm.console import say
from franka_wm.data.lerobot.windows import RecordedWindows
from franka_wm.data.replay import WindowReplay
from franka_wm.envs import Environment
from franka_wm.seeding import derive_seed
from franka_wm.training import build
from franka_wm.training.checkpoint import FIRST_STAGE
from franka_wm.training.learner import Learner
from franka_wm.training.resume import restore
from franka_wm.training.run import Run
from franka_wm.training.spaces import Spaces
from franka_wm.training.trainer import Trainer

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from franka_wm.models.base import WorldModel


def pretrain(
    run: Run,
    env: Environment | None,
    experience: WindowReplay | RecordedWindows,
    spaces: Spaces,
    *,
    diagnose: Callable[[WorldModel, TensorDictBase], tuple[dict[str, float], str | None]] | None = None,
) -> None:
    """The first stage, if the settings ask for one; ``model.encoder_from`` then names its checkpoint.

    Experience comes from smooth random motion, or from the recorded data. A run that resumes goes on with the stage in
    which it ended; in the second it has its encoder already.

    Args:
        run: Gets the second stage's settings, which start from what was learned here, and from no checkpoint.
        env: The training worlds; ``None`` on recorded data.
        experience: Recorded windows; not used where there are worlds.
        spaces: Sizes of observations and actions.
        diagnose: As of the trainer: a frozen encoder that has collapsed cannot recover later.
    """
    settings = run.settings
    begun = run.checkpoint if run.checkpoint is not None and "whole_run" in run.checkpoint.config else None
    if settings.pretrain.kind == "none" or (run.checkpoint is not None and begun is None):
        return
    first = settings.first_stage()
    model = build.make_model(first, spaces, run.device)
    say(f"first stage: {first.model.name}, {first.trainer.updates} updates on images alone")
    policies = {}
    if env is not None:
        policies = build.make_scripted_policies(
            env,
            seed=derive_seed("policies", settings.seed, FIRST_STAGE, *processes.parts()),
            smoothness=settings.collector.smoothness,
        )
    trainer = Trainer(
        env=env,
        learner=Learner(model, **first.learner_options),
        replay=experience if env is None else build.make_replay_buffer(first, env.device),
        policies=policies,
        actor="random",
        settings=first,
        folder=run.folder / FIRST_STAGE,
        loggers=[],
        evaluate=dict,
        spaces=spaces,
        validation=run.validation,
        diagnose=diagnose,
    )
    if begun is not None:
        restore(trainer, begun)
        run.checkpoint = None
    run.keep()
    trainer.fit()
    if trainer.interrupted:
        run.stop()
    del trainer
    gc.collect()  # these hold one another, and the second stage needs the memory of the first one's replay
    encoder = str(run.folder.absolute() / FIRST_STAGE / "checkpoints" / "latest")
    run.settings = settings.changed(model={"encoder_from": encoder})
    say("second stage: dynamics on the frozen encoder")
