"""An oscillation in proportion to the force, fitted within each prediction.

Drives, stick-slip and structures in the food put waves on measured forces that no smooth model
has. One record at one speed does not tell what they are locked to; this takes them as locked to
time. For a given frequency the best amplitudes follow from a linear problem, so that the
oscillation is no parameter of the search (variable projection: Golub and Pereyra 1973), and the
gradient by the other parameters is that at fixed oscillation.
"""

import dataclasses as dc

import numpy as np

__all__ = ["Oscillation", "fit_oscillation"]

LARGEST = 0.3
"""Greatest amplitude, relative to the force."""
GRID = 60
"""Frequencies that are tried first, over the whole range."""
REFINEMENTS = 3
"""Rounds, each about the best frequency of the one before."""


@dc.dataclass(frozen=True)
class Oscillation:
    """The force times 1 + cosine cos(2 pi f t) + sine sin(2 pi f t).

    Attributes:
        frequency: f, Hz.
        cosine, sine: Amplitudes relative to the force.
    """

    frequency: float = 0.0
    cosine: float = 0.0
    sine: float = 0.0

    def factor(self, time: np.ndarray) -> np.ndarray:
        """Factor on the force at times [m], s."""
        c, s = _waves(self.frequency, time)
        return 1.0 + self.cosine * c + self.sine * s

    def derivatives(self, time: np.ndarray) -> np.ndarray:
        """Derivatives of `factor` by frequency, cosine and sine [m, 3]."""
        c, s = _waves(self.frequency, time)
        by_frequency = 2.0 * np.pi * time * (self.sine * c - self.cosine * s)
        return np.column_stack([by_frequency, c, s])


def fit_oscillation(
    time: np.ndarray,
    predicted: np.ndarray,
    measured: np.ndarray,
    weights: np.ndarray,
    frequencies: tuple[float, float],
) -> Oscillation:
    """The oscillation that brings a prediction nearest to the measurement, at most `LARGEST`.

    Args:
        time: Of the samples [m], s.
        predicted, measured: Forces [m, channels], N.
        weights: Of the samples [m, channels], 0 for those held out.
        frequencies: Range, Hz.
    """
    f = np.linspace(*frequencies, GRID)
    best = Oscillation()
    for _ in range(REFINEMENTS):
        candidates = [_at(x, time, predicted, measured, weights) for x in f]
        k = int(np.argmin([error for error, _ in candidates]))
        best = candidates[k][1]
        width = f[1] - f[0]
        f = np.clip(np.linspace(f[k] - width, f[k] + width, 9), *frequencies)
    return best


def _waves(frequency: float, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    phase = 2.0 * np.pi * frequency * time
    return np.cos(phase), np.sin(phase)


def _at(
    frequency: float,
    time: np.ndarray,
    predicted: np.ndarray,
    measured: np.ndarray,
    weights: np.ndarray,
) -> tuple[float, Oscillation]:
    c, s = (predicted * wave for wave in _waves(frequency, time[:, None]))
    rest = measured - predicted
    cc, ss, cs = (weights * c * c).sum(), (weights * s * s).sum(), (weights * c * s).sum()
    cr, sr = (weights * c * rest).sum(), (weights * s * rest).sum()
    determinant = cc * ss - cs * cs
    if determinant <= 1e-9 * cc * ss:
        return float((weights * rest**2).sum()), Oscillation()
    a, b = (ss * cr - cs * sr) / determinant, (cc * sr - cs * cr) / determinant
    size = float(np.hypot(a, b))
    shrink = min(1.0, LARGEST / size) if size > 0.0 else 1.0
    a, b = shrink * a, shrink * b
    error = float((weights * (rest - a * c - b * s) ** 2).sum())
    return error, Oscillation(float(frequency), float(a), float(b))
