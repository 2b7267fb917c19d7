"""Progress bars of commands, one for each stage."""

from contextlib import ExitStack
from typing import Any

__all__ = ["SIMULATED_TIME", "StageBars"]

SIMULATED_TIME = "{desc}: {percentage:3.0f}%|{bar}| {n:.2f}/{total:.2f} s {postfix}"
"""Form of a bar that counts seconds of a simulation."""


class StageBars(ExitStack):
    """One bar for each stage, made when the stage begins and closed when all of it is done.

    Args:
        prefix: Text before the stages' names.
        style: Further arguments of tqdm, as unit and bar_format.
    """

    def __init__(self, prefix: str = "", **style: Any) -> None:
        super().__init__()
        self._prefix, self._style = prefix, style
        self._bars: dict[str, Any] = {}

    def show(self, stage: str, done: float, total: float | None, remark: str = "") -> None:
        """Moves a stage's bar to `done` of `total`, None if unknown, with a remark behind it."""
        from tqdm import tqdm

        bar = self._bars.get(stage)
        # A closed bar does nothing more; a stage may come again.
        if bar is None or (bar.disable and done < bar.n):
            bar = tqdm(total=total, desc=f"{self._prefix}{stage}", **self._style)
            self._bars[stage] = self.enter_context(bar)
        bar.total = total
        bar.set_postfix_str(remark, refresh=False)
        bar.update(done - bar.n)
        if total is not None and done >= total:
            bar.close()

    def show_error(self, stage: str, done: int, total: int, error: float) -> None:
        """The same, with the best error so far, N."""
        self.show(stage, done, total, f"best RMS {error:.3f} N")
