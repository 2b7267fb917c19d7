"""The variables that clients write: their values, and which client may write them."""

from collections.abc import Hashable, Mapping, Sequence

from sliceit_drake.emulator.variables import INPUTS, NOT_FOUND, zero

__all__ = ["IN_USE", "InputRegisters"]

IN_USE = "IN_USE"
"""Word in place of the type of an input that another client holds."""


class InputRegisters:
    """Inputs of the controller. Each belongs to the client that first asked for it.

    They keep their values after a package, after their writer has gone, and across programs.

    Attributes:
        values: Value by name.
        written_at: Controller time of the last package with a name, s; only names once written.
    """

    def __init__(self) -> None:
        self.values = {name: zero(kind) for name, kind in INPUTS.items()}
        self.written_at: dict[str, float] = {}
        self._owners: dict[str, Hashable] = {}

    def claim(self, owner: Hashable, names: Sequence[str]) -> list[str]:
        """Asks for inputs; they are given only if all can be.

        Args:
            owner: Who asks.
            names: Variables.

        Returns:
            Their types; `NOT_FOUND` or `IN_USE` for those that cannot be had.
        """
        types = []
        for name in names:
            held = self._owners.get(name, owner) != owner
            types.append(IN_USE if held else INPUTS.get(name, NOT_FOUND))
        if not {IN_USE, NOT_FOUND} & set(types):
            self._owners.update(dict.fromkeys(names, owner))
        return types

    def claim_free(self, owner: Hashable, names: Sequence[str]) -> list[str]:
        """Takes those of `names` that nobody holds, and returns them."""
        free = [name for name in names if name not in self._owners]
        self._owners.update(dict.fromkeys(free, owner))
        return free

    def release(self, owner: Hashable) -> None:
        """Frees all inputs of an owner."""
        self._owners = {name: o for name, o in self._owners.items() if o != owner}

    def write(self, values: Mapping[str, int | float | bool | tuple], time: float) -> None:
        """Sets inputs at a controller time, s."""
        self.values.update(values)
        self.written_at.update(dict.fromkeys(values, time))

    def integer(self, index: int) -> int:
        """input_int_register_<index>."""
        return int(self.values[f"input_int_register_{index}"])  # type: ignore[arg-type]

    def doubles(self, index: int, count: int) -> list[float]:
        """`count` input_double_registers from `index` on."""
        names = (f"input_double_register_{i}" for i in range(index, index + count))
        return [float(self.values[name]) for name in names]  # type: ignore[arg-type]
