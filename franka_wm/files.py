"""Files that appear whole or not at all."""

import os
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from franka_wm.errors import UserError


def unwritable(folder: str | Path, size: int = 0) -> str | None:
    """Why nothing can be written into `folder`, which need not be there, in a few words; None if something can.

    Leaves nothing behind.

    Args:
        size: how much is tried [bytes].
    """
    place = Path(folder).absolute()
    while not place.exists():
        place = place.parent
    if not place.is_dir():
        return f"{place} is not a folder"
    try:  # asking for permission is not enough: root has it everywhere
        with tempfile.TemporaryDirectory(dir=place) as probe:
            Path(probe, "probe").write_bytes(bytes(size))
    except OSError as error:
        return f"{place} is not writable ({error.strerror})"
    return None


def sync(path: Path) -> None:
    """Make sure that a file's content, or a folder's list of names, has reached the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def run_of(checkpoint: Path) -> Path:
    """The folder of the run that a checkpoint lies in; the checkpoint itself where it lies alone."""
    place = checkpoint if checkpoint.name == "checkpoints" else checkpoint.parent
    run = place.parent
    # Anybody may call a folder so: a run has its configuration beside it; `latest` is replaced at the next save.
    own = (run / "config.yaml").is_file() or run.name == "pretrained" or checkpoint.name == "latest"
    return run if own and place.name == "checkpoints" else checkpoint


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it becomes `path`, on failure it is removed.

    The parent folder is made. The temporary name has another ending, so a writer must be told its format.

    Raises:
        UserError: the file cannot be written.
    """
    target = Path(path)
    # A name of its own: another process may be writing the same file.
    temporary = target.with_name(f"{target.name}.{uuid.uuid4().hex[:8]}.writing")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(target)
    except OSError as error:
        raise UserError(f"cannot write {target}: {error}; choose a path that you may write to.") from error
    finally:
        # Gone already on success. A parent that is no folder is an OSError, and has been reported.
        if temporary.parent.is_dir():
            temporary.unlink(missing_ok=True)
