"""Time spent in methods."""

import functools
import time
from collections.abc import Callable
from typing import Any

__all__ = ["Watch"]


class Watch:
    """Time spent in methods, less that in watched methods that they call.

    Args:
        clock: Gives a time, s.

    Attributes:
        spent: Time of each part, s.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.spent: dict[str, float] = {}
        self._clock = clock
        self._inner: list[float] = []
        self._originals: list[tuple[Any, str, Any]] = []

    def method(self, owner: Any, name: str, part: str) -> None:
        """Watches a method from now on; systems bind theirs when they are made."""
        original = getattr(owner, name)
        self._originals.append((owner, name, original))
        self.spent.setdefault(part, 0.0)

        @functools.wraps(original)
        def watched(*arguments: Any, **options: Any) -> Any:
            self._inner.append(0.0)
            begin = self._clock()
            try:
                return original(*arguments, **options)
            finally:
                whole = self._clock() - begin
                self.spent[part] += whole - self._inner.pop()
                if self._inner:
                    self._inner[-1] += whole

        setattr(owner, name, watched)

    def stop(self) -> None:
        """Gives all owners their methods back."""
        while self._originals:
            setattr(*self._originals.pop())
