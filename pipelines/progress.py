"""Progress bars on standard error. Nothing else is printed from here."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn


class Bars:
    """One bar for each thing that is done; call it as a progress function (what, unit, done, total)."""

    def __init__(self, quiet: bool = False) -> None:
        self._progress = Progress(
            TextColumn("{task.description:<22}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("[dim]{task.fields[unit]}"),
            console=Console(stderr=True),
            disable=quiet,
        )
        self._bars: dict[str, tuple[TaskID, int, int]] = {}

    def __enter__(self) -> Bars:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def __call__(self, what: str, unit: str, done: int, total: int) -> None:
        """Show that `done` of `total` are done; a smaller count than before starts a further batch on the same bar."""
        if what == "recording":
            self._progress.console.print(f"recording: {unit}", style="yellow", markup=False)
            return
        if what not in self._bars:
            self._bars[what] = (self._progress.add_task(what, total=total, unit=unit), 0, total)
        bar, base, batch = self._bars[what]
        if done == 1 and self._progress.tasks[bar].completed > base:
            base, batch = base + batch, total
            self._bars[what] = (bar, base, batch)
        self._progress.update(bar, completed=base + done, total=base + batch, unit=unit)
