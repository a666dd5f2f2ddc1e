"""Learn a world model of a simulated Franka arm, plan with it, evaluate it.

python train.py                          at the scale of this machine
python train.py env=reach_fixed seed=3   Hydra overrides
python train.py --help                   everything that can be changed
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from franka_wm.training.entry import one_line_errors, run_command


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
@one_line_errors
def main(cfg: DictConfig) -> None:
    """One run: build, train, evaluate, report."""
    from franka_wm.evaluation.report import evaluate_and_report
    from franka_wm.training import build
    from franka_wm.training.entry import finish, start
    from franka_wm.training.learner import Learner
    from franka_wm.training.stages import pretrain
    from franka_wm.training.trainer import Trainer

    run = start(cfg)
    env, judge = run.build_environments()
    replay, spaces = run.build_experience(env)
    pretrain(run, env, replay, spaces)
    model = build.make_model(run.cfg, spaces, run.device)
    acting = build.make_agent_policies(run.cfg, model, env, spaces, purpose="training")
    judged = build.make_agent_policies(run.cfg, model, judge, spaces)
    trainer = Trainer(
        env=env,
        learner=Learner(model, **run.learner_options()),
        replay=replay,
        policies=acting,
        actor=build.actor(run.cfg),
        cfg=run.cfg,
        folder=run.folder,
        loggers=run.loggers,
        evaluate=run.evaluation_during_training(judge, judged),
        spaces=spaces,
        validation=run.validation,
        diagnose=run.diagnose,
    )
    if run.checkpoint is not None:
        trainer.restore(run.checkpoint)
    trainer.fit()
    if not trainer.interrupted and judged:
        evaluate_and_report(
            run.cfg,
            run.folder,
            judge,
            judged,
            rows=trainer.rows,
            counters={
                "updates": trainer.learner.updates,
                "env_steps": trainer.env_steps,
                "seconds": trainer.seconds,
            },
            log=trainer.record,
            log_video=run.log_video,
        )
    finish(run, trainer)


if __name__ == "__main__":
    run_command(main)
