"""Progress bars of commands that run in stages."""

from types import TracebackType
from typing import Any

__all__ = ["StageBars"]


class StageBars:
    """One bar for each stage, made when the stage begins.

    Args:
        prefix: Text before the stages' names.
    """

    def __init__(self, prefix: str = "") -> None:
        self._prefix = prefix
        self._bars: dict[str, Any] = {}

    def show(self, stage: str, done: int, total: int, remark: str = "") -> None:
        """Moves a stage's bar to `done` of `total`, with a remark behind it."""
        from tqdm import tqdm

        if stage not in self._bars:
            self._bars[stage] = tqdm(total=total, desc=f"{self._prefix}{stage}")
        bar = self._bars[stage]
        bar.set_postfix_str(remark, refresh=False)
        bar.update(done - bar.n)

    def show_error(self, stage: str, done: int, total: int, error: float) -> None:
        """The same, with the best error so far, N."""
        self.show(stage, done, total, f"best RMS {error:.3f} N")

    def __enter__(self) -> "StageBars":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for bar in self._bars.values():
            bar.close()
