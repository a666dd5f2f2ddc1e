"""Which code made a result."""

import json
from pathlib import Path

import franka_wm.envs.kinematics  # noqa: F401  # what the tests below look for among the imported
from franka_wm import source
from franka_wm.versions import processor, versions, write_finished, write_versions

CODE = (
    b'"""A text."""\n\nX = 1  # one\n"""What X is."""\n\n\ndef f(a, b):\n    """Adds."""\n    return a + b\n'
)


def test_comments_docstrings_and_layout_do_not_count() -> None:
    bare = b"X = 1\ndef f(a,\n      b):\n  return a + b\n"
    assert source.code_hash("a.py", CODE) == source.code_hash("a.py", bare)
    assert source.code_hash("a.yaml", CODE) != source.code_hash("a.yaml", bare)


def test_code_counts() -> None:
    for before, after in (
        (b"X = 1", b"X = 2"),
        (b"a + b", b"a - b"),
        (b"    return", b"    pass\nif X:\n    pass"),
    ):
        assert source.code_hash("a.py", CODE.replace(before, after)) != source.code_hash("a.py", CODE)


def test_texts_that_are_values_count() -> None:
    assert source.code_hash("a.py", b'X = "a"\n') != source.code_hash("a.py", b'X = "b"\n')


def test_what_is_imported_is_told_and_what_shows_results_is_not() -> None:
    found = source.source()
    assert "franka_wm/envs/kinematics.py" in found and "franka_wm/envs/robots/fr3.urdf" in found
    assert not any(name.startswith("franka_wm/report/") for name in found)
    assert source.differing(found) == []
    now = source.read(found)
    now["franka_wm/envs/kinematics.py"] += b"\nX = 1\n"
    del now["franka_wm/envs/robots/fr3.urdf"]
    assert source.differing(found, now) == ["franka_wm/envs/kinematics.py", "franka_wm/envs/robots/fr3.urdf"]


def test_a_run_tells_its_machine_and_at_its_end_its_code(tmp_path: Path) -> None:
    begun = json.loads(write_versions(tmp_path, "cpu").read_text())
    assert begun["processor"] == processor() and begun["threads"] >= 1 and begun["cores"] >= 1
    found = json.loads(write_finished(tmp_path).read_text())
    assert found["seconds"] >= 0 and found["source"] == source.source()


def test_the_commit_of_a_copy_is_given_by_the_environment(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(source, "ROOT", tmp_path)
    monkeypatch.delenv("FRANKA_WM_COMMIT", raising=False)
    assert "commit" not in versions()
    monkeypatch.setenv("FRANKA_WM_COMMIT", "abc")
    assert versions()["commit"] == "abc"
