"""Files that appear whole or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from franka_wm.errors import UserError


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it becomes `path`, on failure it is removed.

    The parent folder is made. The temporary name has another ending, so a writer must be told its format.

    Raises:
        UserError: the file cannot be written.
    """
    target = Path(path)
    temporary = target.with_name(target.name + ".writing")
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
