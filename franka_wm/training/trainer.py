"""The loop: gather, update, evaluate, save."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.record.loggers import Logger

from franka_wm import processes
from franka_wm.console import Progress, say
from franka_wm.data.captured import CapturedSampling
from franka_wm.data.lerobot.windows import RecordedWindows
from franka_wm.data.moments import moments
from franka_wm.data.replay import OVERFLOW, WindowReplay
from franka_wm.envs import Environment
from franka_wm.envs.transformed import arm_of
from franka_wm.errors import UserError
from franka_wm.interrupt import interruptible
from franka_wm.models import WorldModel
from franka_wm.policies.exploration import ActingPolicy
from franka_wm.seeding import derive_seed, seeded
from franka_wm.training.broken import beyond_bounds, clipped, finite, odd_rewards, why
from franka_wm.training.build import explore
from franka_wm.training.episode_statistics import described, of_all
from franka_wm.training.history import columns_of
from franka_wm.training.learner import Learner
from franka_wm.training.loggers import log_numbers
from franka_wm.training.moment import draws, worlds_now
from franka_wm.training.settings import RunSettings
from franka_wm.training.shards import save_together
from franka_wm.training.spaces import Spaces
from franka_wm.training.storage_budget import fill, filled_bytes, reason_to_leave_out

GATHERED_WITH = "gathered_with"
"""Under this name a checkpoint keeps what was other in environments that its run went on from."""

DERIVED = "derived"
"""What of ``model`` in a checkpoint's configuration the model had found itself, since nothing was asked for."""

EVALUATION_SHARE, EVALUATION_SECONDS = 0.1, 5.0
"""Share of training's time, and seconds, after which evaluations are left out unless ``evaluation.every`` is given."""


class UpdateProgress(Progress):
    """Rates without evaluations, which count for the time left alone."""

    def leave_out(self, seconds: float) -> None:
        """What just took so long was neither an update nor a step."""
        self._last += seconds


class Trainer:
    """Gathers experience and learns from it, in turns.

    Under several processes each has worlds, experience and a part of every batch of its own; they turn and
    evaluate together, and the first one speaks for all.

    Args:
        env: The training worlds; ``None`` on recorded data.
        learner: Updates the model.
        replay: Receives (worlds, time) batches, gives windows; or recorded windows.
        policies: By name, for the training worlds alone; ``random`` gathers the first steps, ``actor`` the rest.
        actor: Which of them acts.
        settings: Settings of the run; saved with every checkpoint.
        folder: Folder of the run.
        loggers: TorchRL loggers.
        evaluate: Called now and then with nothing, returns numbers to log. What it and ``diagnose`` draw at random
            comes from generators of their own: they do not change what is learned.
        spaces: What the model was built for.
        validation: Recorded windows that training never sees; their losses are logged.
        diagnose: From model and batch to numbers to log and, if something is going wrong, a warning.
    """

    def __init__(
        self,
        *,
        env: Environment | None,
        learner: Learner,
        replay: WindowReplay | RecordedWindows,
        policies: Mapping[str, TensorDictModuleBase],
        actor: str,
        settings: RunSettings,
        spaces: Spaces,
        folder: Path,
        loggers: list[Logger],
        evaluate: Callable[[], dict[str, float]],
        validation: RecordedWindows | None = None,
        diagnose: Callable[[WorldModel, TensorDictBase], tuple[dict[str, float], str | None]] | None = None,
    ):
        self.env, self.learner, self.settings, self.folder = env, learner, settings, folder
        if processes.count() > 1:  # the same weights, but not the same draws
            stage = ("first",) if "whole_run" in settings.values else ()
            torch.manual_seed(derive_seed("process", settings.seed, processes.rank(), *stage))
        self.replay: Any = replay  # WindowReplay where there are worlds, else RecordedWindows
        self.model = learner.model
        self.actor = actor
        self.loggers = loggers
        self.evaluate = evaluate
        self.env_steps = 0
        self.seconds = 0.0
        self.rows: list[dict[str, float]] = []
        self.gathered_with: list[str] = []  # see GATHERED_WITH
        self.interrupted = False
        self.validation = validation
        self.diagnose = diagnose
        self._batch: TensorDictBase | None = None
        self._said = self._said_too_long = self._said_bounds = False
        self._evaluated = 0.0  # s
        self._asks_at_once = learner.device.type == "cpu"  # elsewhere asking would wait for the device
        self._draw, self._static = replay.sample, lambda batch: False
        if learner.capture and env is not None:
            self._draw = sampling = CapturedSampling(self.replay)
            self._static = sampling.is_static
        self.spaces = spaces
        self._vectors = list(self.model.observation_sizes)
        self._standardized = self.model.standardized_images if settings.trainer.standardize else ()
        self._keys = self.model.observation_keys
        if settings.export.kind != "none":  # a dataset is for other models, too
            self._keys = [*self.spaces.observation_sizes, *self.spaces.image_sizes]
        if (hindsight := getattr(replay, "hindsight", None)) is not None:
            self._keys = list(dict.fromkeys([*self._keys, *hindsight.reads]))
        self.demonstrations = getattr(replay, "demonstrations", None)
        arm = arm_of(env)
        self._starts = None if arm is None else arm.simulation.starts
        self._extra = list(self.model.replay_keys)
        # What the acting policy writes for the loss, a random one does not: then the actor fills the replay, too.
        self.acting = None
        if policies:
            exploring = {actor: explore(settings.collector, policies, actor)}
            self.acting = ActingPolicy({**policies, **exploring}, actor if self._extra else "random")
        self._collector: Collector | None = None
        self._experience: Iterator[TensorDictBase] | None = None

    # -- the loop -----------------------------------------------------------------------------------------

    def fit(self) -> None:
        """Trains until ``trainer.updates``, or until Ctrl-C; writes checkpoints into ``folder``."""
        trainer = self.settings.trainer
        total = trainer.updates
        started = time.perf_counter() - self.seconds
        updates = self.learner.updates
        progress = UpdateProgress(total, done=updates, env_steps=self.env_steps, every=trainer.log_every)
        saved = time.perf_counter()
        every = self.settings.evaluation_period
        ahead = sorted(steps for steps in self.settings.evaluation.at_steps if steps > self.env_steps)
        stopping = False
        anew = self.env is not None and not len(self.replay) and (updates < total or not updates)
        with interruptible() as stop:
            if self.env is None:
                if not updates:
                    images = self.replay.image_moments(self._standardized)
                    self.standardize({**self.replay.statistics(), **images})
            else:
                assert self.acting is not None
                if anew:
                    self.seed()
                self.acting.use(self.actor)
            while self.learner.updates < total and not stopping:
                before = self.learner.updates
                done = before % trainer.updates_per_batch  # by a run that ended amid a batch's updates
                alone = self.settings.updates_alone
                if self.env is not None and (anew or (not done and before >= alone)):
                    self.gather()
                    anew = False
                for _ in range(min(trainer.updates_per_batch - done, total - before)):
                    if self.demonstrations is not None:
                        self.demonstrations.use(self.settings.demo_windows(self.learner.updates))
                    self._batch = self._draw()
                    self.learner.update(self._batch, static=self._static(self._batch))
                    if self.learner.updates == updates + 1:
                        progress.begin(updates + 1, self.env_steps)
                    if self._asks_at_once:
                        self.require_finite()
                    if processes.count() == 1 and stop():  # several end a batch's updates together
                        break
                self.seconds = time.perf_counter() - started
                now = time.perf_counter()
                last = self.learner.updates >= total
                reached = bool(ahead) and self.env_steps >= ahead[0]
                ahead = [steps for steps in ahead if steps > self.env_steps]
                passed = self.learner.updates // every > before // every
                stopping, due, evaluates, saves = processes.agree(
                    [stop()],
                    [
                        progress.due() or last,
                        (reached or (passed and not self._too_long())) and not last,
                        now - saved >= trainer.checkpoint_every and not last,
                    ],
                )
                if due:
                    self.log(progress)
                if reached and stopping and not last:
                    say(f"  evaluation.at_steps: left out at {self.env_steps} steps, the run stops")
                if evaluates and not stopping:
                    now = time.perf_counter()
                    self.require_finite()
                    with self.aside("evaluation"):
                        numbers = self.evaluate()
                    if numbers:
                        self.record(numbers, say_it=True)
                    spent = time.perf_counter() - now
                    self._evaluated += spent
                    started += spent  # seconds count training, not evaluation
                    progress.leave_out(spent)
                    [stopping] = processes.agree([stop()], [])
                if saves:
                    self.save(last=False)
                    saved = time.perf_counter()
            if ahead and not stopping:
                say(f"  evaluation.at_steps={ahead}: not evaluated, the run ends at {self.env_steps} steps")
            self.save()
            [self.interrupted] = processes.agree([stopping or stop()], [])
        if self._collector is not None:
            self._collector.shutdown()

    def seed(self) -> None:
        """Fills the replay with smooth random motion and lets the model see its scale."""
        collector = self.settings.collector
        batches = -(-collector.seed_steps // collector.steps_per_batch)
        for _ in range(batches):
            self.gather()
        data = [self.replay[:]]  # (worlds, time): TorchRL gives back what it was extended with
        if self.demonstrations is not None and processes.is_first():  # all have the same ones
            data.append(self.demonstrations.transitions)
        seen = {key: torch.cat([one.get(key).flatten(0, 1) for one in data]) for key in self._vectors}
        seen |= {key: data[0].get(key).flatten(0, 1) for key in self._standardized}
        own = {key: (*moments(x), len(x)) for key, x in seen.items()}
        self.standardize(finite({key: processes.pooled(*mine) for key, mine in own.items()}, self.settings))

    def standardize(self, statistics: Mapping[str, Sequence[torch.Tensor]]) -> None:
        """Lets the model see mean and deviation of its vector observations, and of images if it standardises them."""
        if not self.settings.trainer.standardize or self.learner.updates:
            return  # trained weights know their scale
        if self._vectors:
            mean, std = (torch.cat([statistics[key][i] for key in self._vectors]) for i in (0, 1))
            device = self.learner.device
            self.model.set_observation_statistics(mean.to(device), std.to(device).clamp_min(1e-3))
        if self._standardized:
            self.model.set_image_statistics({key: statistics[key] for key in self._standardized})

    @property
    def kept(self) -> list[NestedKey]:
        """Keys of a step that go into the replay."""
        exported = ["success", "truncated"] if self.settings.export.kind != "none" else []
        marks = [OVERFLOW] if self.settings.env.marks_overflow else []
        after = [("next", key) for key in (*self._keys, "reward", "terminated", *exported)]
        return [*self._keys, "action", "is_init", *self._extra, *after, *marks]

    def gather(self) -> None:
        """One batch of the collector into the replay."""
        if self._starts is not None:
            self._starts.from_part(self.settings.demo_starts_from(self.learner.updates))
        if self._experience is None:
            self.collect()
        assert self._experience is not None
        batch = next(self._experience)
        self.env_steps += batch.numel() * processes.count()
        batch = batch.select(*self.kept)
        if len(self.replay) == 0:
            fill(self.replay, batch, self.settings, updates=self.learner.updates)
        else:
            self.replay.extend(batch)

    def collect(self) -> Collector:
        """Starts the collector: it resets all worlds."""
        assert self.env is not None
        collector = self.settings.collector
        self._collector = Collector(
            self.env,
            self.acting,
            frames_per_batch=collector.steps_per_batch * self.env.num_envs,
            total_frames=-1,
            track_traj_ids=False,
            no_cuda_sync=True,
            trust_policy=True,
        )
        self._experience = iter(self._collector)
        return self._collector

    # -- what is kept and said ------------------------------------------------------------------------------

    def _too_long(self) -> bool:
        """Whether evaluations have taken more of the time than they may; where ``every`` is given, they may."""
        allowed = max(EVALUATION_SECONDS, EVALUATION_SHARE * self.seconds)
        if self.settings.evaluation.every is not None or self._evaluated <= allowed:
            return False
        if not self._said_too_long:
            say("  evaluations take long: some are left out; evaluation.every=N plays them every N updates")
            self._said_too_long = True
        return True

    def aside(self, purpose: str) -> AbstractContextManager[None]:
        """Around what only looks on: it draws from seeds of its own, and training goes on as if it had not been.

        How often and when that happens depends on the machine and on what is wanted to be known.
        """
        return seeded(derive_seed(purpose, self.settings.seed, self.learner.updates))

    def log(self, progress: Progress) -> None:
        """Reads what the device has summed up, tells the terminal and the loggers."""
        row, text = {}, ""
        self.require_finite()
        if self.env is not None:
            self.replay.sampler.check()
            episodes = of_all(processes.objects(self.env.statistics()))
            row, text = {f"train/{name}": value for name, value in episodes.items()}, described(episodes)
        metrics = self.learner.metrics()
        if not text and "loss" in metrics:
            text = f"loss {metrics['loss']:.4g}"
        warning = None
        with self.aside("log"):
            row |= metrics | self.validate()
            if self.diagnose is not None and self._batch is not None:
                numbers, warning = self.diagnose(self.model, self._batch)
                row |= numbers
        if self.learner.device.type == "cuda":  # torch's, without the simulator's
            row["device_memory_mb"] = torch.cuda.memory_reserved(self.learner.device) / 1e6
        row |= progress.line(self.learner.updates, self.env_steps, text)
        bounds = None if self._said_bounds else self.spaces.reward_bounds
        found = processes.objects(beyond_bounds(self.model, self._batch, bounds))  # of any process's rewards
        beyond = next(filter(None, found), "")
        self._said_bounds |= bool(beyond)
        for line in filter(None, (warning, clipped(metrics), beyond)):
            say(f"  warning: {line}")
        self.record(row)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Mean losses over some recorded windows that training never sees; one host sync."""
        if self.validation is None:
            return {}
        training = self.model.training
        self.model.eval()
        losses = [self.model.loss(self.validation.sample()) for _ in range(4)]
        self.model.train(training)
        means = {name: torch.stack([one.get(name) for one in losses]).mean() for name in losses[0].keys()}  # noqa: SIM118
        return {f"validation/{name}": float(processes.mean(value)) for name, value in means.items()}

    def record(self, numbers: Mapping[str, float], *, say_it: bool = False) -> None:
        """Adds a row to the history and the loggers."""
        row = dict(numbers)
        row |= {"env_steps": self.env_steps, "updates": self.learner.updates, "time_s": self.seconds}
        self.rows.append(row)
        log_numbers(self.loggers, numbers, step=self.learner.updates)
        if say_it:
            say("  " + "   ".join(f"{name} {value:.3f}" for name, value in numbers.items()))

    def save(self, *, last: bool = True) -> Path:
        """Writes ``checkpoints/latest``; with the experience if it is wanted and there is room, or says so.

        Raises:
            UserError: Training broke; what was saved before stays.
        """
        self.require_finite(weights=True)
        processes.require_same(self.model.state_dict())
        replay = None
        wanted = self.settings.trainer.checkpoint_replay
        # A first stage that is done leaves its weights; the second gathers what it needs itself.
        needed = (
            "whole_run" not in self.settings.values or self.learner.updates < self.settings.trainer.updates
        )
        if self.env is not None and wanted is not False and len(self.replay) and needed:
            size = filled_bytes(self.replay) * processes.count()
            # Disks of several hosts may have other room: the first process decides.
            why = processes.objects(reason_to_leave_out(size, self.folder, last=last, wanted=wanted))[0]
            replay = self.experience() if why is None else None
            if why is not None and (last or not self._said):
                say(f"  {why}")
                self._said = True
        latest = self.folder / "checkpoints" / "latest"
        save_together(
            latest,
            model=self.model,
            optimizer=self.learner.optimizer,
            config=self._config(),
            counters=self.counters,
            replay=replay,
            extra={
                "rows": columns_of(self.rows),
                "spaces": self.spaces.as_dict(),
                GATHERED_WITH: self.gathered_with,
            },
            moment=self.moment(),
        )
        return latest

    @property
    def counters(self) -> dict[str, float]:
        """How far the run is: ``env_steps``, ``updates``, ``seconds`` of training."""
        return {"env_steps": self.env_steps, "updates": self.learner.updates, "seconds": self.seconds}

    def _config(self) -> Mapping[str, Any]:
        """The configuration, so that the checkpoint alone rebuilds the model, without what it was started from."""
        own, values = self.model.rebuild_overrides(), self.settings.values
        derived = {*values.get(DERIVED, ()), *(name for name in own if values["model"].get(name) is None)}
        found = {DERIVED: sorted(derived)} if derived else {}
        return {**values, "model": {**values["model"], **own}, **found}

    def require_finite(self, *, weights: bool = False) -> None:
        """Ends a run that cannot recover; waits for the device.

        Args:
            weights: Look at them, too, not at rewards, losses and gradients alone.

        Raises:
            UserError: Something is not finite.
        """
        rewards = odd_rewards(self.model, self._batch)
        broken = [] if rewards else self.learner.broken()
        if weights and not (rewards or broken):
            kept = [x for x in self.model.state_dict().values() if isinstance(x, torch.Tensor)]
            finite = torch.stack([x.isfinite().all() for x in kept if x.is_floating_point()]).all()
            broken = [] if bool(finite) else ["weights"]
        if not (rewards or broken):
            return
        if self.env is not None and not rewards:  # of a batch before, perhaps
            kept = self.replay.storage  # what was not written yet holds anything
            rewards = odd_rewards(self.model, kept._storage[: kept._len_along_dim0])
        latest, before = self.folder / "checkpoints" / "latest", self.settings.resume
        saved = "no checkpoint was written" + (f"; what it went on from is whole: {before}" if before else "")
        if latest.exists():
            saved = f"the last checkpoint before is whole: {latest}"
        raise UserError(f"training broke: {why(rewards, broken, self.learner, self.settings)}; {saved}")

    def moment(self) -> dict[str, object]:
        """Where worlds, policies and recorded windows stand."""
        if self.env is None:
            parts = {"windows": self.replay, "validation": self.validation}
            return {name: part.get_state() for name, part in parts.items() if part is not None}
        assert self.acting is not None
        return {"worlds": worlds_now(self.env, self._collector), "policies": draws(self.acting.policies)}

    def experience(self) -> TensorDictBase | None:
        """The filled part of the replay, (worlds, time), in the order in which it was gathered."""
        if self.env is None or not len(self.replay):
            return None
        data = self.replay.storage.to_host().transpose(0, 1)
        cursor = self.replay.writer._cursor
        full = self.replay.storage._len_along_dim0 == self.replay.storage._storage.shape[0]
        if full and cursor:
            return torch.cat([data[:, cursor:], data[:, :cursor]], 1)  # pyright: ignore[reportReturnType]
        return data
