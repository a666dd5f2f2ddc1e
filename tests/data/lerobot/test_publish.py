"""Publishing, by LeRobot's and the Hub's own clients, to a Hub on loopback."""

from __future__ import annotations

import io
import json
import os
import shutil
from email.message import Message
from pathlib import Path

import pytest
from huggingface_hub import DatasetCard
from PIL import Image

from fake_hub import TOKEN
from franka_wm.data.lerobot import card as cards
from franka_wm.data.lerobot.card import IMAGE
from franka_wm.data.lerobot.paths import shortened, without_paths
from franka_wm.data.lerobot.publish import stage_dataset
from franka_wm.data.lerobot.schema import PROVENANCE
from franka_wm.errors import UserError
from franka_wm.untrusted import MOST_JSON


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, make_schema, make_episode, write):
    schema = make_schema()
    return write(tmp_path_factory.mktemp("data") / "set", schema, [make_episode(schema, i) for i in range(2)])


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def one_line(result, *says: str) -> None:
    error = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert result.returncode == 1, result.stderr
    assert len(error) == 1, result.stderr
    assert "Traceback" not in result.stderr
    assert TOKEN not in result.stderr + result.stdout
    assert all(text in error[0] for text in says), error


@pytest.mark.slow
def test_a_dataset_goes_with_our_card_and_tag(hub, publish, dataset) -> None:
    done = publish(f"root={dataset}", "repo_id=user/arm", "license=cc-by-4.0")
    assert done.returncode == 0, done.stderr
    assert TOKEN not in done.stderr + done.stdout
    repo = hub.repos["datasets/user/arm"]
    assert repo["private"] is True
    local = contents(dataset)
    assert "README.md" not in local  # the card was made elsewhere
    del local[PROVENANCE]  # goes without this machine's paths
    assert {name: repo["files"][name] for name in local} == local
    card = repo["files"]["README.md"].decode()
    assert all(text in card for text in ("license: cc-by-4.0", "@software", "terminal", "LeRobot"))
    # Its actions may not be those of the default environment.
    assert "franka-wm train dataset=lerobot trainer=offline env=none dataset.repo_id=user/arm" in card
    assert "observation.images.front" in card and "episode.gif" in card
    assert "More Information Needed" not in card  # what push_to_hub's own card says
    assert repo["tags"] == {"v3.0": f"{repo['commits']:040x}"}  # the newest commit, the one with the card

    again = publish(f"root={dataset}", "repo_id=user/arm")
    one_line(again, "exists already", "update=true")
    repo["files"]["data/chunk-000/file-007.parquet"] = b"of an earlier version"
    before = repo["commits"]
    shown = publish(f"root={dataset}", "repo_id=user/arm", "update=true", "private=false")
    one_line(shown, "is private", "private=true")  # the Hub would keep it so
    assert repo["commits"] == before
    done = publish(f"root={dataset}", "repo_id=user/arm", "update=true")
    assert done.returncode == 0, done.stderr
    assert "data/chunk-000/file-007.parquet" not in repo["files"]
    assert repo["files"]["README.md"].decode() != card  # another license
    assert repo["commits"] > before
    assert repo["tags"] == {"v3.0": f"{repo['commits']:040x}"}


def test_what_was_public_stays_public_and_what_was_empty_is_filled(hub, publish, dataset) -> None:
    """Private is what is said, and the Hub does not change it of a repository that is there."""
    repo = {"files": {".gitattributes": b"", "mine": b"1"}, "private": False, "tags": {}, "commits": 1}
    hub.repos["datasets/user/arm"] = repo
    one_line(publish(f"root={dataset}", "repo_id=user/arm", "update=true"), "is public", "private=false")
    assert repo["commits"] == 1 and repo["files"]["mine"] == b"1"
    one_line(publish(f"root={dataset}", "repo_id=user/arm"), "exists already")
    repo["private"] = True
    del repo["files"]["mine"]  # as an upload leaves it that failed
    done = publish(f"root={dataset}", "repo_id=user/arm")
    assert done.returncode == 0 and "README.md" in repo["files"], done.stderr


def test_a_dry_run_sends_nothing_and_writes_the_card(hub, publish, dataset, tmp_path) -> None:
    done = publish(f"root={dataset}", "repo_id=user/arm", "--dry-run", token=None)
    assert done.returncode == 0, done.stderr
    assert hub.requests == []
    for text in ("user/arm (private)", "data/chunk-000/file-000.parquet", "README.md", "nothing was sent"):
        assert text in done.stdout
    place = tmp_path / "outputs" / "publish" / "user--arm"
    assert set(contents(place)) == {"README.md", IMAGE}
    with Image.open(place / IMAGE) as moving:
        assert moving.n_frames > 1
    card = (place / "README.md").read_text()
    loaded = DatasetCard(card)
    assert (loaded.data.license, loaded.data.task_categories) == ("apache-2.0", ["robotics"])
    assert "https://huggingface.co/spaces/lerobot/visualize_dataset?path=user/arm" in card
    assert "| `observation.environment_state` | float32 | (3,) | m |" in card
    assert "| `joint_target` | float32 | (7,) | rad |" in card
    assert publish(f"root={dataset}", "repo_id=user/arm").returncode == 0
    assert hub.repos["datasets/user/arm"]["files"]["README.md"].decode() == card


def test_a_card_links_the_project_where_its_address_is_known(monkeypatch) -> None:
    known = Message()
    assert cards._project() == "franka_wm"
    known["Project-URL"] = "Source, https://example.org/franka_wm"
    monkeypatch.setattr(cards, "metadata", lambda name: known)
    assert cards._project() == "[franka_wm](https://example.org/franka_wm)"


@pytest.fixture
def copy(dataset, tmp_path):
    """A dataset of the test's own."""
    return Path(shutil.copytree(dataset, tmp_path / "copy"))


def test_links_out_of_a_dataset_are_not_followed(hub, publish, copy, tmp_path) -> None:
    secret = tmp_path / "secret" / "key.txt"
    secret.parent.mkdir()
    secret.write_text("private")
    (copy / ".hidden").write_text("hidden")
    link = copy / "meta" / "notes.txt"
    for target in (secret, copy / ".hidden", secret.parent, tmp_path / "nothing"):
        link.symlink_to(target)
        with pytest.raises(UserError, match=r"meta/notes\.txt is a link") as caught:
            stage_dataset(copy, tmp_path / "place", repo_id="user/arm", license="mit")
        assert "\n" not in str(caught.value) and not (tmp_path / "place").exists()
        link.unlink()
    (copy / "more").symlink_to(secret.parent)
    one_line(publish(f"root={copy}", "repo_id=user/arm"), "more is a link")
    assert "datasets/user/arm" not in hub.repos
    (copy / "more").unlink()
    link.symlink_to("info.json")  # a file of the dataset
    place = tmp_path / "place"
    place.mkdir()
    stage_dataset(copy, place, repo_id="user/arm", license="mit")
    assert (place / "meta" / "notes.txt").read_text() == (copy / "meta" / "info.json").read_text()


@pytest.mark.parametrize("format", ["exact", "video_near_lossless"])
def test_the_first_episode_may_be_in_any_file(
    format, make_schema, make_episode, write, load, tmp_path
) -> None:
    """LeRobot's own tools leave the numbers of files as they were when they delete the episodes of the first."""
    from lerobot.datasets.dataset_tools import delete_episodes

    schema = make_schema(format)
    episodes = [make_episode(schema, i) for i in range(2)]
    root = write(tmp_path / "set", schema, episodes, shard_frames=7)
    delete_episodes(load(root), [0], output_dir=tmp_path / "less", repo_id="test/less")
    assert not (tmp_path / "less" / "data" / "chunk-000" / "file-000.parquet").exists()
    images = []
    for name, one in (("less", tmp_path / "less"), ("one", write(tmp_path / "one", schema, episodes[1:]))):
        cards.make_image(one, tmp_path / f"{name}.gif")
        images.append((tmp_path / f"{name}.gif").read_bytes())
    assert images[0] == images[1]


def test_embedded_images_may_be_jpeg(make_schema, make_episode, write, tmp_path) -> None:
    """As another program may have written them: what trains is published, too."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    from PIL import Image

    schema = make_schema("exact")
    root = write(tmp_path / "set", schema, [make_episode(schema, 0)])
    file = root / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(file)
    for name in schema.images:
        cells = []
        for cell in table[name].to_pylist():
            jpeg = io.BytesIO()
            Image.open(io.BytesIO(cell["bytes"])).save(jpeg, "JPEG")
            cells.append(cell | {"bytes": jpeg.getvalue()})
        at = table.column_names.index(name)
        table = table.set_column(at, table.field(name), pa.array(cells, table.field(name).type))
    pq.write_table(table, file)
    cards.make_image(root, tmp_path / "first.gif")
    assert (tmp_path / "first.gif").read_bytes().startswith(b"GIF")


def test_pipes_in_a_dataset_are_refused(copy, tmp_path) -> None:
    pipe = copy / "data" / "chunk-000" / "file-001.parquet"
    os.mkfifo(pipe)
    held = os.open(pipe, os.O_RDWR)  # opening it would wait for ever otherwise
    with pytest.raises(UserError, match=r"data/chunk-000/file-001\.parquet is no file; remove it"):
        stage_dataset(copy, tmp_path / "place", repo_id="user/arm", license="mit")
    os.close(held)


def test_a_folder_stays_as_it_is_and_what_is_shown_is_what_goes(hub, publish, copy) -> None:
    (copy / "README.md").write_text("mine")
    for name in (".env", "meta/.secret", "data/.env", "data/.cache/x", "images/front/frame.png"):
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_text("hidden")
    before = contents(copy)
    root = f"root={copy}"
    dry = publish(root, "repo_id=user/arm", "--dry-run")
    one_line(publish(root, "repo_id=user/arm", token=None), "no token")
    assert contents(copy) == before
    assert "stays as it is" in dry.stdout
    done = publish(root, "repo_id=user/arm")
    assert done.returncode == 0, done.stderr
    assert contents(copy) == before
    sent = hub.repos["datasets/user/arm"]["files"]
    shown = {line.split()[0] for line in dry.stdout.splitlines() if line.startswith("  ")}
    assert shown == set(sent) - {".gitattributes"}
    assert "# arm" in sent["README.md"].decode()
    assert b"hidden" not in sent.values()


def test_provenance_and_card_name_no_folder_of_this_machine(copy, tmp_path) -> None:
    provenance = json.loads((copy / PROVENANCE).read_text())
    session = provenance["sessions"][0]
    session["command"] = "franka-wm collect out=/home/someone/sets/reach policy='/home/someone/a run' seed=1"
    session["policy"] = "planner of /home/someone/outputs/run"
    session["config"] = {"env": {"urdf_path": "/home/someone/arm.urdf"}, "places": ["~/x/y", 3]}
    (copy / PROVENANCE).write_text(json.dumps(provenance))
    (tmp_path / "place").mkdir()
    place = stage_dataset(copy, tmp_path / "place", repo_id="user/arm", license="mit")
    staged = json.loads((place / PROVENANCE).read_text())["sessions"][0]
    assert staged["command"] == "franka-wm collect out=reach policy='a run' seed=1"
    assert staged["policy"] == "planner of run"
    assert staged["config"] == {"env": {"urdf_path": "arm.urdf"}, "places": ["y", 3]}
    card = (place / "README.md").read_text()
    assert "out=reach policy='a run'" in card
    assert "NVIDIA\nNewton" in card or "NVIDIA Newton" in card
    assert "someone" not in card + (place / PROVENANCE).read_text()


def test_the_card_of_anothers_dataset_claims_nothing(copy, tmp_path) -> None:
    shutil.rmtree(copy / "meta" / "franka_wm")
    (tmp_path / "place").mkdir()
    place = stage_dataset(copy, tmp_path / "place", repo_id="user/arm", license="mit")
    card = (place / "README.md").read_text()
    assert "Not recorded." in card
    ours = "Newton", "provenance.json", "simulated", "simulation", "terminal", "gathered with"
    assert not any(text in card for text in ours)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{}", "lacks codebase_version, total_episodes"),
        ("[]", "holds no object"),
        ('{"total', "cannot be read"),
        (" " * (MOST_JSON + 1), "larger than 32 MiB"),
        ({"data_path": "{chunk_index:0999999999d}"}, "makes no path"),
    ],
    ids=["nothing", "list", "cut", "large", "path"],
)
def test_a_broken_dataset_is_one_line(text, says, copy, capsys) -> None:
    from franka_wm.commands.main import main

    info = copy / "meta" / "info.json"
    info.write_text(text if isinstance(text, str) else json.dumps(json.loads(info.read_text()) | text))
    assert main(["publish", f"root={copy}", "repo_id=user/arm", "--dry-run"]) == 1
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("what", ["root", "checkpoint"])
def test_a_license_that_the_hub_does_not_know_is_refused(
    what: str, copy, tmp_path, capsys, monkeypatch
) -> None:
    """Also by a dry run, before the card is written."""
    from franka_wm.commands.main import main

    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    given = [f"{what}={copy}", "repo_id=user/arm", "--dry-run"]
    for license, said in (
        ("foo", "license=foo: no identifier of the Hub; use"),
        ("MIT", "did you mean mit?"),
    ):
        assert main(["publish", *given, f"license={license}"]) == 1
        error = capsys.readouterr().err
        assert said in error and "or other" in error and error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_number_that_is_not_finite_is_not_published(copy, capsys) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    from franka_wm.commands.main import main

    (path,) = (copy / "data").glob("*/*.parquet")
    table = pq.read_table(path)
    values = table["action"].to_pylist()
    episode = table["episode_index"].to_pylist()[-1]
    values[-1][1] = float("nan")
    at = table.schema.get_field_index("action")
    pq.write_table(
        table.set_column(at, table.schema.field(at), pa.array(values, table.schema.field(at).type)), path
    )
    assert main(["publish", f"root={copy}", "repo_id=user/arm", "--dry-run"]) == 1
    error = capsys.readouterr().err
    assert f"{path}: action holds a number that is not finite, in episode {episode};" in error
    assert episode > 0 and error.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "becomes"),
    [
        ("out=/a/b/c seed=1", "out=c seed=1"),
        ("x ~/b/c", "x c"),
        ("a:/b/c file:///d/e", "a:c e"),
        (
            "https://hub/a/b hf:user/name outputs/run 3 cm/s",
            "https://hub/a/b hf:user/name outputs/run 3 cm/s",
        ),
        (r"out=C:\Users\me\set", "out=set"),
        ("collect 'out=/mnt/a client/data' x", "collect 'out=data' x"),
        ("'replay.demos=[/a client/d1,sets/d2,/c/d3]'", "'replay.demos=[d1,sets/d2,d3]'"),
        ("'hydra.searchpath=[file:///a b/c]'", "'hydra.searchpath=[c]'"),
    ],
)
def test_absolute_paths_become_their_last_component(text, becomes) -> None:
    assert shortened(text) == becomes


def test_absolute_paths_of_a_configuration_are_cleared() -> None:
    config = {"a": {"b": "/x/y", "c": "~/z", "d": "x/y"}, "e": ["/x/y", None, 1.5], "f": "hf:user/name"}
    cleared = {"a": {"b": None, "c": None, "d": "x/y"}, "e": ["y", None, 1.5], "f": "hf:user/name"}
    assert without_paths(config, clear=True) == cleared


def test_what_is_missing_is_one_line(hub, publish, dataset, tmp_path) -> None:
    root = f"root={dataset}"
    one_line(publish(root, "repo_id=user/arm", token=None), "no token", "hf auth login")
    one_line(publish(root, "repo_id=user/arm", token="hf_wrong"), "refuses the token (status 401)")
    one_line(publish(root, "repo_id=user/arm", url="http://127.0.0.1:9"), "cannot be reached")
    one_line(publish(root, "repo_id=user/arm", offline=True), "HF_HUB_OFFLINE is set")
    assert hub.repos == {}


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["repo_id=user/arm"], "root=DATASET or checkpoint=RUN"),
        (["root=x"], "give repo_id="),
        (["root=x", "repo_id=arm"], "must be user/name"),
        (["root=x", "repo_id=../arm"], "must be user/name"),
        (["root=x", "repo_id=user/arm"], "not a LeRobot dataset"),
        (["root=x", "repo_id=user/arm", "private=perhaps"], "must be true or false"),
        (["checkpoint=x", "repo_id=user/arm"], "no checkpoint"),
    ],
)
def test_bad_arguments_are_one_line(arguments, says, capsys, tmp_path, monkeypatch) -> None:
    from franka_wm.commands.main import main

    monkeypatch.chdir(tmp_path)
    assert main(["publish", *arguments]) == 1
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
