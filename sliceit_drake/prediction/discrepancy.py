"""What a simulation gets wrong by itself: a random function of depth, phase, speed and draw.

Measured less predicted force of channel c in condition k is, beside parameters and noise,

    delta_kc = sum_j phi_j (u_jc + s_k v_jc + d_k w_jc + g_jkc)

with shapes phi_j of depth within a phase of the motion (into the food, at rest, out of it, again),
s_k the decimal logarithm of the condition's speed over the mean, d_k the share of the draw in its
way. The coefficients are independent and normal: u is shared by all conditions, v goes with the
speed, w with the draw, g is each condition's own. This is a Gaussian process of low rank (Kennedy
and O'Hagan 2001; sines as in Solin and Saerkkae 2020). The standard deviation of each is

    size = of the channel * of the part * of the phase

and these few numbers are found by restricted maximum likelihood (Patterson and Thompson 1971) with
priors that say what is known before any data: see `Discrepancy`. All is computed from moments, by
Woodbury's identity: with Gram matrices G = [X Z]' N^-1 [X Z] of columns X and shapes Z, random
coefficients of variance D leave G - G[:, Z] (G[Z, Z] + D^-1)^-1 G[Z, :].
"""

import dataclasses as dc
import functools
from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri, dtrtrs
from scipy.optimize import Bounds, minimize

__all__ = [
    "FINER",
    "LESS",
    "PARTS",
    "PHASES",
    "PRIOR",
    "SHAPES",
    "USUAL_SHARE",
    "Covariates",
    "Discrepancy",
    "Sizes",
    "Weighted",
    "motion_phases",
    "motion_shapes",
]

PHASES = ("in", "rest", "out", "again", "board", "any")
"""Of the motion: deeper than ever before, at rest, up, down through the open cut, in the board, and
anywhere, in the air as well: a cable, a hose or a joint pulls with where the arm is, and unlike a
sensor that drifts no more where the arm is back."""
PARTS = ("shared", "speed", "draw", "condition")
FIRST, SECOND = np.triu_indices(3)
"""Pairs of the parts that conditions share."""
SHAPES = {"in": 10, "out": 5, "again": 5}
"""Number of shapes of a phase."""
FINER = 16
"""Of those on the way in, where slices may be uneven: a food is as uneven below as at its top,
where the shapes are finest."""
ENTRY = 3e-3
"""Depth over which shapes are finest, metres."""
BOARD = 2e-4
"""Way into the board of which its shapes are powers, metres."""
SMOOTH = 2.0
"""Number of the shape from which on their standard deviations fall, as 1 / (1 + (j / SMOOTH)^2)."""
RESTING = 3e-4
"""Speed below which the knife rests, m/s."""
FIRST_REST, LAST_REST = 0.03, 3.0
"""Times within which a force at rest changes, s."""
USUAL_SHARE = 0.02
"""Median before any data of a channel's size, relative to the root mean square force."""
PRIOR = {"channel": 1.5, "part": 1.0, "phase": 1.0, "board": 0.65}
"""Standard deviations of the logarithms of the sizes before any data. In the board it is less: what
is wrong there is an arm or a board that gives, rather than the law of the food."""
JITTER = 1e-8
"""Added to the diagonal of what is inverted, relative to it."""
LESS = 0.5
"""Median before any data of the other sizes, relative to the shared part on the way in."""


@dc.dataclass(frozen=True)
class Covariates:
    """Of a condition, or a record.

    Attributes:
        speed: Decimal logarithm of the knife's speed on the way in, m/s; nan without food.
        draw: Share of the draw in that way, 0 to 1.
    """

    speed: float
    draw: float

    @staticmethod
    def of(time: np.ndarray, depth: np.ndarray, path: np.ndarray) -> "Covariates":
        """Of a record: times [m], depths [m] and the way of the knife [m], s and metres."""
        going, _ = motion_phases(time, depth, path)
        first = going == PHASES.index("in")
        if first.sum() < 5:
            return Covariates(np.nan, 0.0)
        speed = np.gradient(path, time)[first]
        down = np.gradient(depth, time)[first]
        share = np.sqrt(np.clip(1.0 - (down / np.maximum(speed, 1e-9)) ** 2, 0.0, 1.0))
        draw = float(np.median(share))
        return Covariates(float(np.log10(np.median(speed))), draw if draw > 0.1 else 0.0)


def motion_phases(
    time: np.ndarray, depth: np.ndarray, path: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Number of the phase at each row, -1 outside of the food [m], and time at rest so far [m]."""
    step = np.diff(time, prepend=time[0] - (time[1] - time[0]))
    speed, rate = np.gradient(path, time), np.gradient(depth, time)
    deepest = np.maximum.accumulate(depth)
    resting = speed < RESTING
    out = np.full(len(time), PHASES.index("in"))
    out[depth < deepest - 1e-4] = PHASES.index("again")
    out[(rate < -0.2 * speed) & ~resting] = PHASES.index("out")
    out[resting] = PHASES.index("rest")
    out[depth <= 0.0] = -1
    rested = np.cumsum(np.where(resting, step, 0.0))
    begun = np.maximum.accumulate(np.where(resting, 0.0, rested))
    return out, np.where(resting, rested - begun, 0.0)


def motion_shapes(
    time: np.ndarray,
    depth: np.ndarray,
    path: np.ndarray,
    touching: np.ndarray,
    reach: float,
    height: float = np.inf,
    count: int = SHAPES["in"],
) -> tuple[np.ndarray, np.ndarray]:
    """Shapes of a record.

    Along depth sines (j + 1/2) pi u that vanish at the top of the food, where they are finest:
    u = ln(1 + depth / ENTRY) over its value at `reach`. Those of the way in go on at rest, where
    sines of the logarithm of the time at rest are added, with the depth and without. In the board
    the first two powers of the way into it.

    Args:
        time, depth, path: Of the rows [m], s and metres.
        touching: Whether the knife touches [m].
        reach: Greatest depth of all records, metres.
        height: Of the food, metres: the board is at this depth.
        count: Number of shapes on the way in.

    Returns:
        Values [m, n], and the number of the phase of each shape [n].
    """
    going, rested = motion_phases(time, depth, path)
    going = np.where(touching, going, -1)
    at = np.log1p(np.clip(depth, 0.0, reach) / ENTRY) / np.log1p(max(reach, 1e-9) / ENTRY)
    if height <= 0.0:
        going = np.full(len(time), -1)
    into = np.where(touching, np.maximum(depth - height, 0.0), 0.0) / BOARD
    down = (depth - depth[0]) / max(reach, 1e-9)
    across = np.sqrt(np.maximum(np.diff(path) ** 2 - np.diff(depth) ** 2, 0.0))
    along = np.append(0.0, np.cumsum(across)) / max(reach, 1e-9)
    out, of = [], []
    for number, name in enumerate(PHASES):
        if name == "rest":
            span = np.log1p(LAST_REST / FIRST_REST)
            late = np.clip(np.log1p(rested / FIRST_REST) / span, 0.0, 1.2)
            times = [np.sin((j + 0.5) * np.pi * late) / (1.0 + j * j) for j in range(2)]
            shapes = [t * level for level in (np.ones(len(at)), 2.0 * at - 1.0) for t in times]
            where = going == number
        elif name == "board":
            shapes, where = [into, into**2], into > 0.0
        elif name == "any":
            shapes, where = [down, along], np.full(len(time), True)
        else:
            shapes = [
                np.sin((j + 0.5) * np.pi * at) / (1.0 + (j / SMOOTH) ** 2)
                for j in range(count if name == "in" else SHAPES[name])
            ]
            where = going == number
            if name == "in":
                where |= going == PHASES.index("rest")
        out += [np.where(where, s, 0.0) for s in shapes]
        of += [number] * len(shapes)
    return np.column_stack(out), np.array(of)


@dc.dataclass(frozen=True)
class Sizes:
    """Standard deviations of the discrepancy's coefficients.

    Attributes:
        channel: Logarithms of the shared part's on the way in [c], N and Nm.
        part: Logarithms of the others' relative to it, in the order of `PARTS` but the first [3].
        phase: The same of the phases but the first [4].
    """

    channel: np.ndarray
    part: np.ndarray
    phase: np.ndarray

    @property
    def flat(self) -> np.ndarray:
        """All in a row."""
        return np.concatenate([self.channel, self.part, self.phase])

    @staticmethod
    def of(flat: np.ndarray) -> "Sizes":
        """From a row."""
        phases = len(PHASES) - 1
        return Sizes(flat[: -3 - phases], flat[-3 - phases : -phases], flat[-phases:])

    def deviations(self, channel: np.ndarray, phase: np.ndarray) -> np.ndarray:
        """Of shapes of these channels and phases [n] in each part [4, n]."""
        logs = self.channel[channel] + np.append(0.0, self.phase)[phase]
        return np.asarray(np.exp(np.append(0.0, self.part)[:, None] + logs))


class Weighted:
    """Moments in which a discrepancy of certain sizes is integrated out.

    Attributes:
        order: Numbers of the shapes' columns and of the others that are looked at, all by default.
        total: Gram matrix of the latter without the discrepancy, all conditions together [n, n].
        log_det: Logarithm of the determinant of what was integrated out.
    """

    def __init__(
        self,
        problem: "Discrepancy",
        grams: Sequence[np.ndarray],
        sizes: Sizes,
        others: Sequence[int] | None = None,
    ) -> None:
        self.problem = problem
        self.order = [*problem.shapes, *(problem.others if others is None else others)]
        G = np.array([gram[np.ix_(self.order, self.order)] for gram in grams])
        z, N = len(problem.shapes), len(self.order)
        self.deviations = sizes.deviations(problem.channel, problem.phase)
        D = self.deviations[3]
        self.scales = [of[:, None] * self.deviations[:3] for of in problem.factors]
        GZ = D[:, None] * G[:, :z]
        self.roots = np.linalg.cholesky(np.eye(z) + GZ[:, :, :z] * D)
        self.log_det = 2.0 * float(np.log(np.diagonal(self.roots, 0, 1, 2)).sum())
        self.solved = [dtrtrs(L, B, lower=1)[0] for L, B in zip(self.roots, GZ, strict=True)]
        for A, S in zip(G, self.solved, strict=True):
            A -= S.T @ S
        self.of_condition = G
        # What all conditions share goes by their factors, and by the deviations alike in all.
        F, wide, s = np.array(problem.factors), self.deviations[:3], 3 * z
        shared = np.zeros((s + N - z, s + N - z))
        among = shared[:s, :s].reshape(3, z, 3, z)
        pairs = (F[:, FIRST] * F[:, SECOND]).T @ G[:, :z, :z].reshape(len(G), -1)
        for a, b, pair in zip(FIRST, SECOND, pairs.reshape(-1, z, z), strict=True):
            among[a, :, b] = wide[a][:, None] * pair * wide[b]
            among[b, :, a] = among[a, :, b].T
        single = (F.T @ G[:, :z, z:].reshape(len(G), -1)).reshape(3, z, -1)
        shared[:s, s:] = (wide[:, :, None] * single).reshape(s, -1)
        shared[s:, s:] = G[:, z:, z:].sum(0)
        self.shared, self.size = shared, s
        inner = shared[:s, :s].copy()
        inner[np.diag_indices(s)] = (1.0 + np.diag(inner)) * (1.0 + JITTER)
        self.factor = cho_factor(inner, lower=True, overwrite_a=True, check_finite=False)
        self.log_det += 2.0 * float(np.log(np.diag(self.factor[0])).sum())
        right = shared[:s, s:]
        self.total = shared[s:, s:] - right.T @ cho_solve(self.factor, right, check_finite=False)

    def products(self, columns: np.ndarray) -> list[np.ndarray]:
        """Products of each coefficient of the discrepancy, over its standard deviation, with
        combinations of the columns [n, k]: of the shared ones, of speed and draw [3 z, k], and of
        each condition [z, k], in a list."""
        z, s = len(self.problem.shapes), self.size
        right = self.shared[:s, s:] @ columns
        fitted = cho_solve(self.factor, right, check_finite=False)
        out = [right - self.shared[:s, :s] @ fitted]
        for A, scale in zip(self.of_condition, self.scales, strict=True):
            back = scale[:, :, None] * fitted.reshape(3, z, -1)
            left = A[:z, z:] @ columns - A[:z, :z] @ back.sum(0)
            out.append(self.deviations[3][:, None] * left)
        return out

    def found(self, columns: np.ndarray) -> list[np.ndarray]:
        """Mean, after the data, of the coefficients of each condition's shapes, by part [4, z].

        Args:
            columns: Combination of the columns that is left of the measurement [n].
        """
        first, *own = (p[:, 0] for p in self.products(columns[:, None]))
        shared = self.deviations[:3] * first.reshape(3, -1)
        return [
            np.vstack([covariates[:, None] * shared, self.deviations[3] * g])
            for covariates, g in zip(self.problem.factors, own, strict=True)
        ]

    def covariances(self, fitted: Sequence[int], covariance: np.ndarray) -> list[np.ndarray]:
        """Covariance, after the data, of the coefficients of each condition's shapes [z, z].

        Args:
            fitted: Numbers of other columns that are fitted beside them [k].
            covariance: Of the coefficients of these [k, k].
        """
        z, s, D = len(self.problem.shapes), self.size, self.deviations[3]
        beside = cho_solve(self.factor, self.shared[:s, [s + k for k in fitted]])
        columns = [*range(z), *(z + k for k in fitted)]
        out = []
        for L, S, scale, half in zip(
            self.roots, self.solved, self.scales, self._shared_inverse[1], strict=True
        ):
            # A condition's own part follows from all else, and adds what it is unsure of.
            back = D[:, None] * dtrtrs(L, S[:, columns], lower=1, trans=1)[0]
            left = np.eye(z) - back[:, :z]
            shared = (scale[:, :, None] * beside.reshape(3, z, -1)).sum(0)
            of_fitted = left @ shared + back[:, z:]
            own = dtrtrs(L, np.diag(D), lower=1)[0]
            out.append(left @ (half + half.T) @ left.T + own.T @ own)
            out[-1] += of_fitted @ covariance @ of_fitted.T
        return out

    def products_of_record(
        self, rows: np.ndarray, condition: int, columns: np.ndarray
    ) -> np.ndarray:
        """Products of columns that one record alone has with combinations of the columns [n, k].

        Args:
            rows: Products of the record's columns with all columns, own ones left out [e, all].
            condition: Of the record.
            columns: The combinations.

        Returns:
            [e, k].
        """
        z, s = len(self.problem.shapes), self.size
        D, L = self.deviations[3], self.roots[condition]
        weights = D[:, None] * dtrtrs(L, self.solved[condition], lower=1, trans=1)[0]
        left = rows[:, self.order]
        left = left - left[:, :z] @ weights
        scaled = np.tile(left[:, :z], 3) * self.scales[condition].ravel()
        fitted = cho_solve(self.factor, self.shared[:s, s:] @ columns, check_finite=False)
        return np.asarray(left[:, z:] @ columns - scaled @ fitted)

    @functools.cached_property
    def _shared_inverse(self) -> tuple[np.ndarray, np.ndarray]:
        """Covariance, after the data, of the coefficients that conditions share, each over its
        standard deviation: its lower triangle [3 z, 3 z]. And half of the covariance of their sum
        in each condition, to which its transpose adds the other half [C, z, z]."""
        z, wide = len(self.problem.shapes), self.deviations[:3]
        P, _ = dpotri(self.factor[0], lower=1)
        blocks = P.reshape(3, z, 3, z)
        pairs = np.empty((len(FIRST), z, z))
        for pair, a, b in zip(pairs, FIRST, SECOND, strict=True):
            # Of what is on the diagonal the lower triangle alone is there, and counts twice.
            lower = np.tril(blocks[a, :, a]) if a == b else blocks[b, :, a]
            pair[:] = wide[b][:, None] * lower * wide[a]
        pairs[FIRST == SECOND] *= 1.0 - 0.5 * np.eye(z)
        F = np.array(self.problem.factors)
        among = (F[:, FIRST] * F[:, SECOND]) @ pairs.reshape(len(pairs), -1)
        return P, among.reshape(len(F), z, z)

    def traces(self) -> list[np.ndarray]:
        """z' V^-1 z of each coefficient z of the discrepancy, over its standard deviation, as
        `products` but with nothing else projected out."""
        z, D = len(self.problem.shapes), self.deviations[3]
        # With P the inverse of E + B, E nearly 1, B - B P B has the diagonal of E - E P E.
        P, among = self._shared_inverse
        E = 1.0 + JITTER * (1.0 + np.diag(self.shared)[: self.size])
        out = [E - E * np.diag(P) * E]
        ZZ = self.of_condition[:, :z, :z]
        products = among @ (ZZ * D)
        for A, product in zip(ZZ, products, strict=True):
            out.append(D * D * np.diag(A) - 2.0 * D * (A * product).sum(0))
        return out


class Discrepancy:
    """The sizes of a discrepancy, from moments.

    Args:
        shapes: Numbers of the shapes' columns in Gram matrices [z].
        channel, phase: Number of the channel and of the phase of each [z].
        others: Numbers of the other columns [n], the residual last.
        covariates: Of each condition.
        usual: Median of the size of each channel before any data [c], N and Nm.
    """

    def __init__(
        self,
        shapes: Sequence[int],
        channel: np.ndarray,
        phase: np.ndarray,
        others: Sequence[int],
        covariates: Sequence[Covariates],
        usual: np.ndarray,
    ) -> None:
        self.shapes, self.channel, self.phase = list(shapes), channel, phase
        self.others = list(others)
        speeds = np.array([c.speed for c in covariates])
        known = np.isfinite(speeds)
        self._middle = float(speeds[known].mean()) if known.any() else 0.0
        self.factors = [self.factor(c) for c in covariates]
        phases = len(PHASES) - 1
        less = np.log(np.full(3 + phases, LESS))
        self.prior = Sizes(np.log(usual), less[:3], less[3:])
        self.spread = np.concatenate(
            [
                np.full(len(usual), PRIOR["channel"]),
                [PRIOR["part"]] * 3,
                [PRIOR["board" if name == "board" else "phase"] for name in PHASES[1:]],
            ]
        )

    def factor(self, of: Covariates) -> np.ndarray:
        """By which the parts of a condition's discrepancy count, but for its own [3]."""
        away = of.speed - self._middle if np.isfinite(of.speed) else 0.0
        return np.array([1.0, away, of.draw])

    def likelihood(
        self, grams: Sequence[np.ndarray], sizes: Sizes, fitted: Sequence[int], prior: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """Logarithm of the restricted likelihood and of the prior, and its gradient by the sizes.

        Args:
            grams: Moments of each condition.
            sizes: Of the discrepancy.
            fitted: Columns that are fitted, as numbers in `others` [k].
            prior: Precisions of their coefficients; 0 where nothing is known [k].
        """
        W = Weighted(self, grams, sizes, [*(self.others[k] for k in fitted), self.others[-1]])
        T, y = W.total, len(fitted)
        inner = T[:y, :y] + np.diag(prior)
        scale = np.sqrt(np.maximum(np.diag(inner), 1e-30))
        values, vectors = np.linalg.eigh(inner / np.outer(scale, scale))
        kept = values > 1e-9
        root = vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]
        seen = root.T @ T[:y, y]
        proper = prior > 0.0
        log_det = W.log_det + float(np.log(values[kept]).sum())
        log_det += 2.0 * float(np.log(scale[proper]).sum()) - float(np.log(prior[proper]).sum())
        # Flat columns have no scale of their own: their determinant is as in the first model.
        log_det += 2.0 * float(np.log(scale[~proper]).sum())
        value = -0.5 * (log_det + T[y, y] - float(seen @ seen))
        columns = np.zeros((y + 1, len(root.T) + 1))
        columns[:y, :-1] = root
        columns[y, -1], columns[:y, -1] = 1.0, -root @ seen
        shares = []
        for product, trace in zip(W.products(columns), W.traces(), strict=True):
            shares.append(product[:, -1] ** 2 - trace + (product[:, :-1] ** 2).sum(1))
        by_shape = np.array([*shares[0].reshape(3, -1), np.sum(shares[1:], axis=0)])
        gradient = self._by_size(by_shape)
        away = (sizes.flat - self.prior.flat) / self.spread
        return value - 0.5 * float(away @ away), gradient - away / self.spread

    def _by_size(self, by_shape: np.ndarray) -> np.ndarray:
        """Sums of what belongs to shapes [4, z] by the size that it belongs to."""
        channels = len(self.prior.channel)
        of_channel = np.bincount(self.channel, by_shape.sum(0), channels)
        of_phase = np.bincount(self.phase, by_shape.sum(0), len(PHASES))[1:]
        return np.concatenate([of_channel, by_shape.sum(1)[1:], of_phase])

    def uncertain(
        self, grams: Sequence[np.ndarray], sizes: Sizes, fitted: Sequence[int], prior: np.ndarray
    ) -> np.ndarray:
        """Covariance of the logarithms of sizes that `fit` found, by Laplace's approximation."""
        step, flat = 0.05, sizes.flat
        rows = []
        for e in step * np.eye(len(flat)):
            ends = [self.likelihood(grams, Sizes.of(flat + d), fitted, prior)[1] for d in (e, -e)]
            rows.append((ends[1] - ends[0]) / (2.0 * step))
        values, vectors = np.linalg.eigh(0.5 * (np.array(rows) + np.array(rows).T))
        # Nothing is less certain than before any data.
        values = np.maximum(values, 1.0 / self.spread.max() ** 2)
        return np.asarray((vectors / values) @ vectors.T)

    def fit(
        self,
        grams: Sequence[np.ndarray],
        fitted: Sequence[int],
        prior: np.ndarray,
        start: Sizes | None = None,
        tolerance: float = 1e-2,
        covariance: np.ndarray | None = None,
    ) -> tuple[Sizes, float]:
        """Sizes of largest likelihood and prior, and its logarithm; see `likelihood`.

        Args:
            grams, fitted, prior: As for `likelihood`.
            start: Where the search begins; the prior's medians by default.
            tolerance: Of the gradient.
            covariance: About that of the logarithms of the sizes: in its units a search takes few
                evaluations.
        """
        first = (start or self.prior).flat
        ends = self.prior.flat - 5.0 * self.spread, self.prior.flat + 3.0 * self.spread

        def least(root: np.ndarray, bounds: Bounds | None) -> tuple[np.ndarray, float]:
            def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
                flat = first + root @ x
                # A step of the search may go anywhere.
                near = np.clip(flat, *ends)
                value, gradient = self.likelihood(grams, Sizes.of(near), fitted, prior)
                return -value, -root.T @ (gradient * (near == flat))

            found = minimize(
                objective,
                np.zeros(len(first)),
                jac=True,
                method="L-BFGS-B",
                bounds=bounds,
                options={"ftol": 1e-12, "gtol": tolerance, "maxiter": 60},
            )
            return first + root @ found.x, -float(found.fun)

        if covariance is not None:
            flat, value = least(np.linalg.cholesky(covariance), None)
            if (flat >= ends[0]).all() and (flat <= ends[1]).all():
                return Sizes.of(flat), value
            first = np.clip(flat, *ends)
        flat, value = least(np.eye(len(first)), Bounds(ends[0] - first, ends[1] - first))
        return Sizes.of(flat), value
