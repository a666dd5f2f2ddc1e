"""Loggers: what is written is read back; services are played by fakes, Weights & Biases also offline for real."""

from __future__ import annotations

import importlib.machinery
import math
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import av
import pytest
import torch

from franka_wm.errors import UserError
from franka_wm.training.loggers import (
    NAMES,
    check_loggers,
    close_loggers,
    log_config,
    log_numbers,
    log_video,
    make_loggers,
)


def frames() -> torch.Tensor:
    """A bright square crosses dark pictures. (6, 32, 48, 3) uint8."""
    out = torch.full((6, 32, 48, 3), 20, dtype=torch.uint8)
    for t in range(6):
        out[t, 8:24, 6 * t : 6 * t + 12] = 230
    return out


def count_frames(path: str | Path) -> int:
    with av.open(str(path)) as container:
        return sum(1 for _ in container.decode(video=0))


class Fake(ModuleType):
    """A package that notes what is called: `calls` holds (name, arguments, keywords)."""

    def __init__(self, name: str):
        super().__init__(name)
        self.calls: list[tuple[str, tuple, dict]] = []
        self.__spec__ = importlib.machinery.ModuleSpec(name, None)

    def note(self, name: str, result: Any = None) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            self.calls.append((name, args, kwargs))
            return result(*args, **kwargs) if callable(result) else result

        return call

    def of(self, name: str) -> list[tuple[tuple, dict]]:
        return [(args, kwargs) for called, args, kwargs in self.calls if called == name]


def install(monkeypatch: pytest.MonkeyPatch, fake: Fake) -> Fake:
    """The fake in place of the package, also where TorchRL asked whether it is there."""
    import torchrl.record.loggers.mlflow as mlflow_logger
    import torchrl.record.loggers.trackio as trackio_logger
    import torchrl.record.loggers.wandb as wandb_logger

    monkeypatch.setitem(sys.modules, fake.__name__, fake)
    monkeypatch.setattr(mlflow_logger, "_has_mlflow", True)
    monkeypatch.setattr(trackio_logger, "_has_trackio", True)
    monkeypatch.setattr(wandb_logger, "_has_wandb", True)
    return fake


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> Fake:
    fake = Fake("wandb")
    config = SimpleNamespace(update=fake.note("config"))
    run = SimpleNamespace(
        log=fake.note("log"), config=config, finish=fake.note("finish"), define_metric=fake.note("define")
    )
    fake.init = fake.note("init", lambda **_: run)  # type: ignore[attr-defined]
    fake.Video = fake.note("Video", lambda path, **_: count_frames(path))  # type: ignore[attr-defined]
    return install(monkeypatch, fake)


@pytest.fixture
def mlflow(monkeypatch: pytest.MonkeyPatch) -> Fake:
    fake = Fake("mlflow")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    for name in (
        "set_tracking_uri",
        "get_experiment_by_name",
        "set_experiment",
        "start_run",
        "end_run",
        "set_tag",
    ):
        setattr(fake, name, fake.note(name))
    fake.create_experiment = fake.note("create_experiment", "7")  # type: ignore[attr-defined]
    fake.log_metrics = fake.note("log_metrics")  # type: ignore[attr-defined]
    fake.log_params = fake.note("log_params")  # type: ignore[attr-defined]
    fake.log_artifact = fake.note("log_artifact", lambda path, place: fake.note("frames")(count_frames(path)))  # type: ignore[attr-defined]
    return install(monkeypatch, fake)


@pytest.fixture
def trackio(monkeypatch: pytest.MonkeyPatch) -> Fake:
    fake = Fake("trackio")
    run = SimpleNamespace(log=fake.note("log"), config={}, finish=fake.note("finish"))
    fake.init = fake.note("init", lambda **_: run)  # type: ignore[attr-defined]
    fake.Video = fake.note("Video", lambda path, **_: count_frames(path))  # type: ignore[attr-defined]
    return install(monkeypatch, fake)


# -- files -----------------------------------------------------------------------------------------------


def test_files_hold_the_numbers_and_the_video(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    loggers = make_loggers(["csv", "tensorboard"], tmp_path)
    log_numbers(loggers, {"loss": 0.5, "eval/planner/success": 0.25}, step=10)
    log_numbers(loggers, {"loss": 0.25}, step=20)
    log_config(loggers, {"seed": 0})
    log_video(loggers, "eval/planner", frames(), fps=10, step=20)
    close_loggers(loggers)

    assert (tmp_path / "csv/scalars/loss.csv").read_text() == "10,0.5\n20,0.25\n"
    assert (tmp_path / "csv/scalars/eval/planner/success.csv").read_text() == "10,0.25\n"
    assert count_frames(tmp_path / "csv/videos/eval/planner_20.mp4") == 6
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [(e.step, e.value) for e in events.Scalars("loss")] == [(10, 0.5), (20, 0.25)]
    (picture,) = events.Images("eval/planner")
    assert (picture.step, picture.width, picture.height) == (20, 48, 32)
    assert picture.encoded_image_string.startswith(b"GIF89a")
    assert count_frames_of_gif(picture.encoded_image_string) == 6


def test_files_of_a_run_that_goes_on_forget_what_it_makes_anew(tmp_path: Path) -> None:
    """From update 20 of a run that logged until 30 and died: one curve, not two in one another."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    first = make_loggers(["csv", "tensorboard"], tmp_path)
    for step in (10, 20, 30):
        log_numbers(first, {"loss": float(step), "eval/planner/success": 0.25}, step=step)
    close_loggers(first)
    with (tmp_path / "csv/scalars/loss.csv").open("a") as file:
        file.write("\n\0\0\n4")  # cut off in writing: not update 4
    again = make_loggers(["csv", "tensorboard"], tmp_path, updates=20)
    log_numbers(again, {"loss": 0.5}, step=25)
    close_loggers(again)

    assert (tmp_path / "csv/scalars/loss.csv").read_text() == "10,10.0\n20,20.0\n25,0.5\n"
    assert (tmp_path / "csv/scalars/eval/planner/success.csv").read_text() == "10,0.25\n20,0.25\n"
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [(e.step, e.value) for e in events.Scalars("loss")] == [(10, 10.0), (20, 20.0), (25, 0.5)]
    assert [e.step for e in events.Scalars("eval/planner/success")] == [10, 20]


def count_frames_of_gif(data: bytes) -> int:
    import io

    from PIL import Image

    with Image.open(io.BytesIO(data)) as moving:
        return getattr(moving, "n_frames", 1)


def test_no_names_mean_no_loggers(tmp_path: Path) -> None:
    assert make_loggers([], tmp_path) == []
    assert list(tmp_path.iterdir()) == []


# -- services ----------------------------------------------------------------------------------------------


def test_wandb_gets_rows_config_and_video(tmp_path: Path, wandb: Fake) -> None:
    folder = tmp_path / "my-run"
    loggers = make_loggers(["wandb"], folder, wandb={"project": "arms", "offline": True, "tags": ("a",)})
    log_numbers(loggers, {"loss": 0.5, "eval/planner/success": 0.25}, step=10)
    log_config(loggers, {"env": {"task": "reach"}})
    log_video(loggers, "eval/planner", frames(), fps=10, step=10)
    close_loggers(loggers)
    ((_, init),) = wandb.of("init")
    assert (init["project"], init["name"], init["dir"]) == ("arms", "my-run", str(folder))
    assert init["tags"] == ["a"] and "entity" not in init
    logged = wandb.of("log")
    assert logged == [
        (({"loss": 0.5, "eval/planner/success": 0.25},), {"step": 10}),
        (({"eval/planner": 6},), {"step": 10}),  # the fake video is the number of frames in its file
    ]
    assert wandb.of("config") == [(({"env": {"task": "reach"}},), {"allow_val_change": True})]
    assert len(wandb.of("finish")) == 1


def test_mlflow_gets_a_database_in_the_folder(tmp_path: Path, mlflow: Fake) -> None:
    loggers = make_loggers(["mlflow"], tmp_path)
    many = {f"group{k}": {"value": k} for k in range(150)}
    log_config(loggers, many)
    log_numbers(loggers, {"loss": 0.5}, step=10)
    log_video(loggers, "eval/planner", frames(), fps=10, step=10)
    close_loggers(loggers)
    assert mlflow.of("set_tag") == [(("mlflow.runName", tmp_path.name), {})]
    ((uri,), _) = mlflow.of("set_tracking_uri")[0]
    assert uri == f"sqlite:///{tmp_path}/mlflow/mlflow.db"
    sent = [args[0] for args, _ in mlflow.of("log_params")]
    assert max(map(len, sent)) <= 100
    assert {k: v for part in sent for k, v in part.items()} == {f"group{k}.value": str(k) for k in range(150)}
    assert mlflow.of("log_metrics")[0] == (({"loss": 0.5},), {"step": 10})
    assert mlflow.of("frames") == [((6,), {})]
    assert len(mlflow.of("end_run")) == 1


def test_mlflow_takes_the_server_it_is_given(tmp_path: Path, mlflow: Fake, monkeypatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:5000")
    make_loggers(["mlflow"], tmp_path)
    make_loggers(["mlflow"], tmp_path, mlflow={"uri": "http://127.0.0.1:6000", "experiment": None})
    assert [args[0] for args, _ in mlflow.of("set_tracking_uri")] == [
        "http://127.0.0.1:5000",
        "http://127.0.0.1:6000",
    ]
    assert not (tmp_path / "mlflow").exists()


def test_trackio_gets_one_message_for_a_row(tmp_path: Path, trackio: Fake) -> None:
    loggers = make_loggers(["trackio"], tmp_path / "my-run", trackio={"project": "arms", "space_id": None})
    log_numbers(loggers, {"loss": 0.5, "reward": 1.0}, step=10)
    log_video(loggers, "film", frames(), fps=10, step=10)
    close_loggers(loggers)
    ((_, init),) = trackio.of("init")
    assert (init["project"], init["name"]) == ("arms", "my-run") and "space_id" not in init
    assert trackio.of("log") == [
        (({"loss": 0.5, "reward": 1.0},), {"step": 10}),
        (({"film": 6},), {"step": 10}),
    ]
    assert len(trackio.of("finish")) == 1
    make_loggers(["trackio"], tmp_path)
    assert trackio.of("init")[1][1]["project"] == "franka_wm"


@pytest.mark.slow
def test_wandb_offline_for_real(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_SILENT", "true")
    loggers = make_loggers(["wandb"], tmp_path / "run", wandb={"project": "arms", "offline": True})
    log_config(loggers, {"env": {"task": "reach"}})
    log_numbers(loggers, {"loss": 0.5, "nan": math.nan}, step=10)
    log_numbers(loggers, {"loss": 0.25}, step=20)
    log_video(loggers, "eval/planner", frames(), fps=10, step=20)
    experiment = loggers[0].experiment
    assert experiment.config["env"] == {"task": "reach"}
    close_loggers(loggers)
    kept = tmp_path / "run" / "wandb"
    (history,) = kept.glob("offline-run-*/*.wandb")
    until = time.monotonic() + 30.0  # a process of its own writes the file, and closing does not wait for it
    while not (b"reach" in (data := history.read_bytes()) and b"0.25" in data):
        assert time.monotonic() < until, data[:200]
        time.sleep(0.1)
    (film,) = kept.glob("offline-run-*/files/media/videos/**/*.mp4")
    assert count_frames(film) == 6


# -- what goes wrong ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "options", "says"),
    [
        (["csv", "neptune"], {}, "no logger 'neptune'; choose from csv, tensorboard, wandb, mlflow, trackio"),
        (["csv"], {"wandb": {"projet": "x"}}, "'wandb' has no option 'projet'; choose from entity"),
        (["csv"], {"csv": {"a": 1}}, "no options for a logger 'csv'"),
    ],
)
def test_what_does_not_exist_is_refused(tmp_path: Path, names, options, says: str) -> None:
    with pytest.raises(UserError, match=says):
        make_loggers(names, tmp_path, **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["wandb", "mlflow", "trackio"])
def test_a_missing_package_is_one_line_that_names_it(tmp_path: Path, monkeypatch, name: str) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n == name else find(n, *a))
    with pytest.raises(UserError, match=rf"pip install 'franka-wm\[{name}\]'$"):
        make_loggers(["csv", name], tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_service_that_fails_closes_what_was_open(tmp_path: Path, wandb: Fake, trackio: Fake) -> None:
    trackio.init = trackio.note("init", lambda **_: (_ for _ in ()).throw(RuntimeError("no space")))  # type: ignore[attr-defined]
    with pytest.raises(UserError, match="logger 'trackio' cannot start: no space"):
        make_loggers(["wandb", "trackio"], tmp_path)
    assert len(wandb.of("finish")) == 1


def test_a_service_that_is_away_later_is_said_and_training_goes_on(
    tmp_path: Path, mlflow: Fake, capsys: pytest.CaptureFixture[str]
) -> None:
    """MLflow's own error is no OSError."""
    loggers = make_loggers(["mlflow", "csv"], tmp_path)

    def away(*_: Any, **__: Any) -> None:
        raise RuntimeError("no server")

    for name in ("log_artifact", "end_run"):
        setattr(mlflow, name, away)
    loggers[0].log_metrics = away  # type: ignore[method-assign]
    log_numbers(loggers, {"loss": 1.0}, step=3)
    log_video(loggers, "film", frames(), fps=5, step=3)
    close_loggers(loggers)
    said = capsys.readouterr().out.splitlines()
    assert said == [
        "  warning: mlflow cannot log the numbers of update 3: no server",
        "  warning: mlflow cannot log the video film of update 3: no server",
        "  warning: mlflow cannot end its run: no server",
    ]
    assert list(tmp_path.rglob("film_3.mp4")) and list(tmp_path.rglob("loss.csv")), "the others have it"


def test_every_logger_has_a_preset(root: Path, composed) -> None:
    """`logger=NAME` composes, and its options are known."""
    from omegaconf import OmegaConf

    for path in sorted((root / "conf" / "logger").glob("*.yaml")):
        chosen: Any = OmegaConf.to_container(composed(f"logger={path.stem}").logger)
        names = chosen.pop("names")
        assert set(names) <= set(NAMES)
        for name, options in chosen.items():
            assert name in names
            check_loggers([], **{name: options})
