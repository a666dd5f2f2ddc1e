"""Learn a world model of a simulated Franka arm, plan with it, evaluate it.

python train.py                          at the scale of this machine
python train.py env=reach_fixed seed=3   Hydra overrides
python train.py --help                   everything that can be changed
"""

from __future__ import annotations

import sys

import hydra
from omegaconf import DictConfig

from franka_wm.commands.ending import ended_by_sigterm
from franka_wm.commands.entry import one_line_errors, run_command
from franka_wm.commands.resumed import with_options_of_its_run


@hydra.main(version_base="1.3", config_path="pkg://franka_wm.conf", config_name="config")
@one_line_errors
@ended_by_sigterm
def main(cfg: DictConfig) -> float | None:
    """One run: build, pretrain if asked to, fit, evaluate, report, export.

    Returns:
        How well it did, for Hydra's sweepers: :func:`franka_wm.evaluation.results.score`; None where nothing was
        evaluated.
    """
    from franka_wm import processes
    from franka_wm.console import say
    from franka_wm.evaluation.health import diagnose_training
    from franka_wm.evaluation.protocol import during_training, evaluate_run
    from franka_wm.evaluation.results import score
    from franka_wm.report.end_of_run import report_run
    from franka_wm.report.page import write_page
    from franka_wm.training import build
    from franka_wm.training.learner import Learner
    from franka_wm.training.resume import restore
    from franka_wm.training.run import start
    from franka_wm.training.stages import pretrain
    from franka_wm.training.trainer import Trainer

    run = start(cfg)
    env, eval_env = run.build_environments()
    replay, spaces = run.build_experience(env)
    pretrain(run, env, replay, spaces, diagnose=diagnose_training)
    model = build.make_model(run.settings, spaces, run.device)
    policies = build.make_agent_policies(run.settings, model, env, spaces, purpose="training")
    eval_policies = build.make_agent_policies(run.settings, model, eval_env, spaces)
    trainer = Trainer(
        env=env,
        learner=Learner(model, **run.settings.learner_options),
        replay=replay,
        policies=policies,
        actor=run.settings.actor,
        settings=run.settings,
        folder=run.folder,
        loggers=run.loggers,
        evaluate=during_training(run.settings.evaluation, eval_env, eval_policies),
        spaces=spaces,
        validation=run.validation,
        diagnose=diagnose_training,
    )
    if run.checkpoint is not None:
        restore(trainer, run.checkpoint)
    run.keep()
    trainer.fit()
    if trainer.interrupted:
        run.stop()
    found = None
    if eval_env is not None:  # all processes of a job play
        found = evaluate_run(run.settings, run.folder, eval_env, eval_policies, counters=trainer.counters)
    if processes.is_first() and found is not None:  # it speaks for all
        report_run(
            run.settings,
            run.folder,
            eval_env,
            eval_policies,
            found,
            rows=trainer.rows,
            log=trainer.record,
            log_video=run.log_video,
        )
    if processes.is_first():
        run.close()
        say(f"page:    {write_page(run.folder)}")
    run.finish(trainer.experience)  # exports what each has gathered
    say(f"results: {run.folder}")
    return None if found is None else score(found.policies)


def command(arguments: list[str] | None = None) -> None:
    """This file as a program, and ``franka-wm train``: the package has a link to this file."""
    run_command(main, with_options_of_its_run(sys.argv[1:] if arguments is None else arguments))


if __name__ == "__main__":
    command()
