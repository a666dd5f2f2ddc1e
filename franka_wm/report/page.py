"""A run's page: ``report.html``, one file that says what was run and what came of it.

What it shows is what lies in the run's folder: :mod:`franka_wm.report.run` says which files and which entries of
``evaluation.json`` are read. A section is there only if there is something for it.
"""

from pathlib import Path

from franka_wm.report.document import document, write_document
from franka_wm.report.outcome import headline
from franka_wm.report.run import RunFiles, malformed, read_run
from franka_wm.report.sections import sections, warnings
from franka_wm.version import __version__

FILE = "report.html"


def page(run: RunFiles) -> str:
    """The page of a run as HTML."""
    with malformed(run.folder):
        known = [run.environment, run.model] if run.config else []
        known += [] if run.seed is None else [f"seed {run.seed}"]
        known += [f"planned with {run.otherwise}, not as the run did"] if run.otherwise else []
        return document(
            run.name,
            subtitle=" · ".join(known) or "an evaluation",
            above=headline(run, warnings(run)),
            sections=sections(run),
            below=f"Written by franka_wm {__version__}.",
        )


def write_page(folder: str | Path, out: str | Path | None = None) -> Path:
    """Read a run's folder and write its page.

    Args:
        folder: of a run.
        out: ends in .html; ``report.html`` in the folder if None.

    Returns:
        Where the page is.

    Raises:
        UserError: no run there, a file that cannot be read, or the page cannot be written.
    """
    run = read_run(folder)
    return write_document(page(run), Path(folder) / FILE if out is None else out)
