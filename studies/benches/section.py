"""The section of a slice in cells, as foreign laws see it."""

from collections.abc import Sequence

import numpy as np

from sliceit_drake.stand_in.effect import Effect, Tissue
from sliceit_drake.tables import interpolated

__all__ = ["COLUMNS", "ROWS", "Section"]

ROWS, COLUMNS, SPARSE = 320, 24, 4
"""Cells, and the rows of them for each in which effects are asked about the tissue."""


class Section:
    """A round or square section on the board, in `ROWS` of `COLUMNS` cells.

    Args:
        width, height: Of the food along the edge and vertically, metres.
        is_round: An ellipse, else a rectangle.
        effects: What is hidden; they have begun, and reshape it and change its tissue.

    Attributes:
        z: Heights of the rows' middles over the board [ROWS], metres.
        row: Height of a row, metres.
        bottom, top: Of the food, metres.
        left, right: Its ends along the edge in each row [ROWS], metres.
        toughness, stiffness: Factors on the material's in each cell [ROWS, COLUMNS].
    """

    def __init__(
        self, width: float, height: float, is_round: bool, effects: Sequence[Effect] = ()
    ) -> None:
        up = (np.arange(ROWS) + 0.5) / ROWS
        half = 0.5 * width * (2.0 * np.sqrt(up * (1.0 - up)) if is_round else np.ones(ROWS))
        ends = np.zeros((2 * ROWS + 2, 3))
        ends[:ROWS, 0], ends[ROWS : 2 * ROWS, 0] = -half, half
        ends[:, 2] = height * np.concatenate([up, up, [0.0, 1.0]])
        for effect in effects:
            ends = effect.reshape(ends)
        self.bottom, self.top = float(ends[-2, 2]), float(ends[-1, 2])
        self.row = (self.top - self.bottom) / ROWS
        self.z = self.bottom + self.row * (np.arange(ROWS) + 0.5)
        left, right = ends[:ROWS], ends[ROWS:-2]
        self.left = np.interp(self.z, left[:, 2], left[:, 0])
        self.right = np.interp(self.z, right[:, 2], right[:, 0])
        self.width = self.right - self.left
        across = (np.arange(COLUMNS) + 0.5) / COLUMNS
        self.x = self.left[:, None] + self.width[:, None] * across
        shape = self.x.shape
        self.toughness, self.stiffness = np.ones(shape), np.ones(shape)
        if effects:
            tissue = self._tissue()
            for effect in effects:
                self.toughness *= self._in_cells(effect.toughness(tissue))
                self.stiffness *= self._in_cells(effect.stiffness(tissue))
        self._edges = self.bottom + self.row * np.arange(ROWS + 1)
        below = np.concatenate([[0.0], np.cumsum(self.width)]) * self.row
        self._above = below[-1] - below
        self.area = float(below[-1])

    def above(self, height: float) -> float:
        """Area of the section above a height, m^2."""
        return float(np.interp(height, self._edges, self._above))

    def at(self, values: np.ndarray, height: float) -> float:
        """One of the rows' values [ROWS] at a height; that of the nearest row beyond them."""
        return float(np.interp(height, self.z, values))

    def _in_cells(self, factor: np.ndarray | float) -> np.ndarray:
        """A factor at the places of `_tissue` in all cells [ROWS, COLUMNS]."""
        if np.isscalar(factor):
            return np.full(self.x.shape, factor)
        rows = np.reshape(factor, (-1, COLUMNS))
        return interpolated(self.z, self.z[SPARSE // 2 :: SPARSE], rows.astype(float))

    def _tissue(self) -> Tissue:
        """Places in each column of every `SPARSE`th row."""
        rows = slice(SPARSE // 2, None, SPARSE)
        z, left, right = self.z[rows], self.left[rows], self.right[rows]
        x, height = self.x[rows].ravel(), np.repeat(z, COLUMNS)
        inside = (left <= x[:, None]) & (x[:, None] <= right)
        highest = len(z) - 1 - np.argmax(inside[:, ::-1], axis=1)
        lid = np.linspace(0.0, 1.0, 2 * COLUMNS)
        ends = [np.column_stack([side, z]) for side in (left, right)]
        for k, level in ((0, self.bottom), (-1, self.top)):
            ends.append(
                np.column_stack([self.left[k] + lid * self.width[k], np.full(len(lid), level)])
            )
        outline = np.concatenate(ends)
        square = (x[:, None] - outline[:, 0]) ** 2 + (height[:, None] - outline[:, 1]) ** 2
        return Tissue(
            x=x - float(np.mean(0.5 * (self.left + self.right))),
            height=height,
            depth=np.maximum(z[highest] + 0.5 * SPARSE * self.row - height, 0.0),
            distance=np.sqrt(square.min(axis=1)),
        )
