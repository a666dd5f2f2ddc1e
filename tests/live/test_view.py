"""``franka-wm view``: its arguments, its errors, and that it serves this machine only."""

from __future__ import annotations

import builtins
import os
import re
import signal
import socket
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from forks import Fork, train_in_fork
from franka_wm.commands import main as cli
from franka_wm.commands.view import options_of
from franka_wm.commands.view import view as view_verb
from franka_wm.envs import FrankaConfig
from franka_wm.errors import UserError
from franka_wm.live import gate
from franka_wm.live.recorder import DatasetRecorder
from franka_wm.live.session import Session
from franka_wm.live.stage import ARM, Options, build, serve

CHEAP = ["env.substeps=2", "device=cpu"]


def parse(arguments: list[str]) -> Options:
    given = view_verb.make_context("view", arguments).params
    assert given.pop("plugins") is None
    return options_of(**given)


def test_arguments() -> None:
    options = parse(["port=0", "policy=noop", "seconds=2.5", "env.goal=[0.3,0,0.5]", "env.episode_length=20"])
    assert (options.port, options.policy, options.seconds) == (0, "noop", 2.5)
    assert options.env == {"goal": [0.3, 0, 0.5], "episode_length": 20}
    assert parse([]) == Options()


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("page=3", "page: no such option; there are checkpoint, env, policy"),
        ("--fast", "fast: no such option"),
        ("env=dm_control", "the page shows the arm only"),
        ("sed=3", "sed: no such option; did you mean seed?"),
        ("port", "'port': write options as name=value; all of them: franka-wm view --help"),
        ("port=http", "port=http: must be a whole number"),
        ("port=70000", "must be a whole number of at least 0, at most 65535"),
        ("seconds=0", "must be a finite number above 0"),
        ("seconds=nan", "must be a finite number above 0"),
        ("rerun=x.txt", "rerun=x.txt: must end in .rrd"),
        ("checkpoint=nowhere", "checkpoint=nowhere: no such folder"),
        (
            "policy=planer",
            "policy=planer: must be one of planner, policy, noop, random, ik, expert; did you mean",
        ),
        ("policy=oracle", "this policy is called ik now"),
    ],
)
def test_bad_arguments_are_one_line(argument: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["view", argument]) == 1
    captured = capsys.readouterr()
    assert said in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == "", "before anything that takes time"


@pytest.mark.parametrize(("kind", "what"), [("gym", "another environment (gym)"), ("none", "recorded data")])
def test_a_checkpoint_of_another_environment_is_refused_before_anything_is_built(
    kind: str, what: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    found = SimpleNamespace(config=OmegaConf.create({"env": {"kind": kind}}))
    monkeypatch.setattr("franka_wm.live.stage.find_checkpoint", lambda folder: found)
    monkeypatch.setattr("franka_wm.live.stage.load_agent", lambda *a, **k: pytest.fail("built"))
    (tmp_path / "checkpoints").mkdir()
    assert cli.main(["view", f"checkpoint={tmp_path}"]) == 1
    captured = capsys.readouterr()
    assert what in captured.err and "the live page shows the arm only" in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_a_full_recording_is_said_once_and_a_failed_write_keeps_it(
    make_session, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = make_session(policy="noop")
    session.start_recording(size=32, most=2)
    frames = [session.step() for _ in range(4)]
    assert [(f.recording, f.recording_full) for f in frames] == [(1, False)] + [(2, True)] * 3
    assert capsys.readouterr().out.count("the recording is full after 2 steps") == 1
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot write"):
        session.stop_recording(tmp_path / "file" / "live.mp4")
    assert session.recording, "what was not written is kept"
    assert session.stop_recording(tmp_path / "live.mp4").stat().st_size > 0
    assert not session.recording


def test_what_is_kept_after_a_failed_write_grows_no_more(make_session, tmp_path: Path) -> None:
    session = make_session(policy="noop")
    session.start_recording(size=32)
    session.step()
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot write"):
        session.stop_recording(tmp_path / "file" / "live.mp4")
    assert session.step().recording == 1
    session.start_recording(size=32)  # gives it up
    assert session.step().recording == 1 and session.step().recording == 2


def test_bad_worlds_policies_and_checkpoints_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, said in (
        (["env.arms=2"], "unknown environment option 'arms'"),
        (["policy=policy"], "policy='policy': choose from planner, ik, random, noop; that one needs"),
        (["policy=expert"], "policy='expert': choose from planner, ik, random, noop; that one needs"),
        ([f"checkpoint={tmp_path}"], str(tmp_path)),
    ):
        assert cli.main(["view", *CHEAP, "seconds=1", *arguments]) == 1
        captured = capsys.readouterr()
        assert said in captured.err
        assert captured.err.count("\n") == 1


def test_help_names_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["view", "--help"]) == 0
    out = capsys.readouterr().out
    for name in vars(Options()):
        assert f"{name}=" in out or f"{name}." in out


@pytest.mark.parametrize(
    ("module", "arguments", "extra"),
    [("viser", [], "franka-wm[view]"), ("rerun", ["rerun=x.rrd"], "franka-wm[rerun]")],
)
def test_without_the_extra_it_says_which(
    module: str,
    arguments: list[str],
    extra: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    real = builtins.__import__

    def absent(name: str, *args, **kwargs):
        if name.split(".")[0] == module:
            raise ModuleNotFoundError(f"No module named {module!r}", name=module)
        if name == "franka_wm.live.stage":
            pytest.fail("the simulator is imported first, which takes seconds")
        return real(name, *args, **kwargs)

    for loaded in [m for m in sys.modules if m.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setattr(builtins, "__import__", absent)
    assert cli.main(["view", *arguments]) == 1
    captured = capsys.readouterr()
    assert f"pip install '{extra}'" in captured.err
    assert captured.out == "", "before anything that takes time"


def test_without_a_checkpoint_the_arm_is_that_of_the_preset(root: Path) -> None:
    base = OmegaConf.load(root / "conf" / "env" / "franka.yaml")
    preset = OmegaConf.to_container(
        OmegaConf.merge(base, OmegaConf.load(root / "conf" / "env" / "reach.yaml"))
    )
    for other in ("defaults", "kind", "urdf_path", "episode_length"):
        del preset[other]
    assert FrankaConfig.from_mapping(ARM | {"episode_length": 50}) == FrankaConfig.from_mapping(
        preset | {"episode_length": 50}
    )


def test_it_serves_this_machine_only_and_ends_in_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from franka_wm.live import page

    served = []
    real = page.Page

    class Watched(real):
        def close(self, timeout: float | None = None) -> bool:
            here = reachable("127.0.0.1", self.port)
            served.append((self.server.get_host(), self.port, here, outside(self.port)))
            steps.append(self.session.frame().steps)
            return super().close(timeout)

    steps: list[int] = []
    monkeypatch.setattr(page, "Page", Watched)
    assert cli.main(["view", *CHEAP, "port=0", "policy=ik", "seconds=2"]) == 0
    [(host, port, here, elsewhere)] = served
    assert host == "127.0.0.1"
    assert here
    assert not elsewhere, "the page must not be reachable by this machine's other addresses"
    assert steps[0] > 3, "it plays from the start"
    out = capsys.readouterr().out
    assert re.search(rf"^http://127\.0\.0\.1:{port}   Ctrl-C ends it$", out, re.MULTILINE)
    assert "Server stopped" not in out


def test_only_the_farewell_of_the_server_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    def say() -> None:
        print("saved")
        print("\x1b[1m(viser)\x1b[0m Server stopped\n", end="")
        print("(viser) Server stopped answering")
        print("cannot be", file=sys.stderr)

    gate.stop(SimpleNamespace(stop=say))
    assert capsys.readouterr() == ("saved\n(viser) Server stopped answering\n", "cannot be\n")


def reachable(host: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex((host, port)) == 0


def outside(port: int) -> bool:
    """Whether any other address of this machine answers; 127.0.0.2 is one everywhere on Linux."""
    addresses = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    return any(reachable(str(a), port) for a in (addresses | {"127.0.0.2"}) - {"127.0.0.1"})


def test_a_port_in_use_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        assert cli.main(["view", *CHEAP, f"port={taken}", "policy=noop", "seconds=0.1"]) == 0
    assert f"(port {taken} cannot be had)" in capsys.readouterr().out


@pytest.mark.slow
def test_a_checkpoint_brings_its_own_planner_and_policy(tmp_path: Path) -> None:
    from franka_wm.live.session import Session

    done = train_in_fork("scale=smoke", "device=cpu", f"hydra.run.dir={tmp_path}/run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    stage = build(parse([f"checkpoint={tmp_path / 'run'}", "device=cpu"]))
    assert stage.title.startswith("tdmpc2, ")
    assert stage.steps == 50
    assert stage.env.config.episode_length > 1000, "nobody asked for the episode to end"
    session = Session(stage.env, stage.policies)
    assert session.policy == "planner"
    frame = session.step()
    assert frame.path is not None
    assert frame.path.shape == (session.planner.horizon + 1, 3)
    session.set_planner(horizon=2, iterations=1)
    assert session.step().path.shape == (3, 3)
    session.set_policy("policy")
    assert session.step().path is None
    session.set_policy("ik")
    goal = (0.4, 0.2, 0.5)
    session.set_goal(goal)
    for _ in range(50):
        frame = session.step()
    assert max(abs(a - b) for a, b in zip(frame.tool, goal, strict=True)) < 0.01


def test_an_exception_while_it_plays_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = build(parse([*CHEAP, "policy=noop", "port=0"]))

    def broken(_tensordict):
        raise UserError("the policy is out")

    stage.policies["noop"] = broken
    with pytest.raises(UserError, match="the policy is out"):
        serve(stage, parse(["policy=noop", "port=0"]))


def test_what_is_recorded_when_the_time_is_up_is_written(tmp_path, capsys, monkeypatch) -> None:
    stage = build(parse([*CHEAP, "policy=noop", "port=0"]))
    play = Session.play

    def recording(session: Session) -> None:
        session.start_recording("dataset")
        play(session)

    monkeypatch.setattr(Session, "play", recording)
    monkeypatch.setattr(DatasetRecorder, "write", lambda self, path: Path(path))
    serve(stage, parse(["policy=noop", "port=0", "seconds=1", f"out={tmp_path}"]))
    assert re.search(rf"recorded until now: {tmp_path}/live-", capsys.readouterr().out)


def recording() -> None:
    """A stage that plays and records."""
    play = Session.play
    Session.play = lambda session: session.start_recording("dataset") or play(session)  # type: ignore[method-assign]
    serve(build(Options(device="cpu", env={"substeps": 2})), Options(policy="noop", port=0))


def test_what_ctrl_c_loses_is_said(tmp_path) -> None:
    fork = Fork(recording, cwd=tmp_path, log=tmp_path / "log")
    until = time.monotonic() + 120
    while "Ctrl-C ends it" not in fork.said()[0] and time.monotonic() < until:
        time.sleep(0.05)
    os.kill(fork.pid, signal.SIGINT)
    assert "a recording was not saved" in fork.wait(30).stdout


def deciding_for_a_minute() -> None:
    """A stage whose policy prints that it decides, and takes its time."""
    stage = build(Options(device="cpu", env={"substeps": 2}))
    real = stage.policies["noop"]

    def slow(tensordict):
        print("deciding", flush=True)
        time.sleep(60)
        return real(tensordict)

    stage.policies["noop"] = slow
    serve(stage, Options(policy="noop", port=0))


def playing() -> None:
    """A stage that plays; what Python would do afterwards takes a minute."""
    serve(build(Options(device="cpu", env={"substeps": 2})), Options(policy="noop", port=0))
    time.sleep(60)


@pytest.mark.parametrize(
    ("stage", "says"), [(deciding_for_a_minute, "deciding"), (playing, "Ctrl-C ends it")]
)
def test_ctrl_c_ends_it_within_two_seconds_whatever_it_is_doing(stage, says: str, tmp_path: Path) -> None:
    fork = Fork(stage, cwd=tmp_path, log=tmp_path / "log")
    ends = time.monotonic() + 60
    while says not in fork.said()[0] and time.monotonic() < ends:
        time.sleep(0.02)
    time.sleep(2.0)  # it plays by then
    os.kill(fork.pid, signal.SIGINT)
    started = time.monotonic()
    done = fork.wait(10)
    assert time.monotonic() - started < 2.0
    assert done.returncode == 130 and says in done.stdout and "Traceback" not in done.stderr, done.stderr


def test_rerun_writes_an_episode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rerun", reason="needs the extra rerun")
    path = tmp_path / "arm.rrd"
    assert cli.main(["view", *CHEAP, f"rerun={path}", "policy=ik", "env.episode_length=4"]) == 0
    assert path.stat().st_size > 1000
    out = capsys.readouterr().out
    assert "recording 4 steps" in out
    assert f"rerun {path}" in out


def test_a_task_with_a_gripper_is_shown_by_its_expert() -> None:
    """By name, without a checkpoint; the page and the recording have the same stage."""
    options = options_of([], None, env="stack", seed=0, device="cpu")
    stage = build(options)
    assert list(stage.policies) == ["expert", "random", "noop"] and stage.env.config.num_objects == 2
    observation = stage.env.reset()
    for _ in range(120):
        observation = stage.env.step(stage.policies["expert"](observation))["next"]
    assert observation["success"].all()
    with pytest.raises(UserError, match="the checkpoint has its own environment"):
        options_of([], None, env="stack", checkpoint="somewhere")


def test_an_arm_and_an_environment_of_ones_own_are_shown(tmp_path, monkeypatch) -> None:
    """As train takes them: a preset in a folder that is named, and the URDF that it names, or the command line."""
    (tmp_path / "env").mkdir()
    preset = "defaults: [reach, _self_]\nrobot: urdf\nurdf_path: mine.urdf\n"
    (tmp_path / "env" / "mine.yaml").write_text(preset)
    paths = f"hydra.searchpath=[file://{tmp_path}]"
    for words, urdf in (([paths], "mine.urdf"), ([paths, "env.urdf_path=other.urdf"], "other.urdf")):
        options = options_of(words, None, env="mine", seed=0, device="cpu")
        assert options.env["robot"] == "urdf" and options.env["urdf_path"] == urdf
        with pytest.raises(UserError, match=f"urdf_path={urdf}: no such file"):
            build(options)
    assert "urdf_path" not in options_of([], None, env="reach").env


@pytest.mark.parametrize("length", ["0", "-3", "1e1", "ten"])
def test_a_recording_of_no_such_length_is_refused_before_anything_is_built(
    length: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun", reason="needs the extra rerun")
    monkeypatch.setattr("franka_wm.live.stage.build", lambda options: pytest.fail("built"))
    arguments = [f"rerun={tmp_path}/arm.rrd", f"env.episode_length={length}"]
    assert cli.main(["view", *CHEAP, *arguments]) == 1
    captured = capsys.readouterr()
    assert "env.episode_length=" in captured.err and "must be a whole number of control steps" in captured.err
    assert captured.err.count("\n") == 1 and not list(tmp_path.iterdir())


def test_a_task_whose_expert_cannot_act_is_shown_without_it() -> None:
    """Its hand can still be moved at random; who asks for the expert is told what it needs."""
    changes = {"env": "lift", "device": "cpu"}
    stage = build(options_of(["env.action_mode=ee_delta"], None, **changes))  # type: ignore[arg-type]
    assert list(stage.policies) == ["random", "noop"] and stage.env.action_dim == 4
    with pytest.raises(UserError, match="policy=expert: drives joints"):
        build(options_of(["env.action_mode=ee_delta"], None, policy="expert", **changes))  # type: ignore[arg-type]


def test_who_cannot_see_where_it_stands_cannot_stay_there() -> None:
    """Of poses none is nothing: the no-op reads the servo's targets."""
    words = ["env.action_mode=joint_position", "env.observations=[state]"]
    posed = options_of(words, None, device="cpu")
    assert set(build(posed).policies) == {"random"}
    stage = build(options_of([*words[:1], "env.observations=[state,joint_target]"], None, device="cpu"))
    assert "noop" in stage.policies
