"""The figure of a run, drawn by a separate process: matplotlib is loaded during the run, on another core.

python -m coldloop_rig.figures.worker < (folder and formats as JSON): an error is one line on standard error
"""

import gc
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from coldloop import errors, text
from coldloop_rig import PYTHON

COMMAND: Final = (*PYTHON, "-m", "coldloop_rig.figures.worker")


class FigureProcess:
    """Draws the figure of a run in some formats; a context at whose end its process has ended."""

    def __init__(self, formats: Sequence[str]) -> None:
        self._formats = list(formats)
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """End the process, which has nothing to draw when there is no run."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()

    def start(self) -> None:
        """Start the process, which then waits for a run; without this `draw` does."""
        pipe = subprocess.PIPE
        # In its own process session: Ctrl-C is handled by the command, which has the recorded part drawn.
        self._process = subprocess.Popen(  # noqa: S603 our own module
            COMMAND, stdin=pipe, stdout=pipe, stderr=pipe, start_new_session=True
        )

    def draw(self, folder: Path) -> None:
        """Draw the run of a folder, `run.png` for the format png.

        Raises:
            UsageError: There is no run in the folder, or a file of it cannot be replaced.
            ResultsError: A file cannot be written, or the process has failed.
        """
        if self._process is None:
            self.start()
        process, self._process = self._process, None
        if process is None:
            raise RuntimeError("start makes a process")
        _, said = process.communicate(json.dumps([str(folder), self._formats]).encode())
        if process.returncode:
            lines = said.decode(errors="replace").strip().splitlines() or [f"exit code {process.returncode}"]
            if process.returncode == errors.UsageError.exit_code:
                raise errors.UsageError(lines[-1])
            raise errors.ResultsError(
                f"{folder}: the figure was not drawn: {lines[-1]}; try `coldloop plot {folder}`, the rest is complete"
            )


def main() -> None:
    """Draw the run that standard input names; none when it is closed."""
    from coldloop_rig.figures.plot import draw_nothing, plot_run  # noqa: PLC0415 slow imports come before the wait

    draw_nothing()
    request = sys.stdin.buffer.read()
    if not request:
        return
    folder, formats = text.parsed_json(request)
    try:
        plot_run(Path(folder), formats)
    except (OSError, errors.ColdloopError) as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(getattr(error, "exit_code", 1))
    gc.freeze()  # do not search all modules for cycles at the exit


if __name__ == "__main__":
    main()
