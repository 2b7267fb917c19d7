"""The simulation's own error against the same model written out: one covariance for all rows.

Four records of two conditions that differ in speed and in the share of the draw, two channels.
"""

import numpy as np
import pytest
from scipy.linalg import block_diag

from sliceit_drake.diagnosis.evidence.columns import Column, RecordSensitivity, Sensitivities
from sliceit_drake.diagnosis.evidence.effect_size import OwnError
from sliceit_drake.diagnosis.evidence.linear import PLAUSIBLE, LinearProblem
from sliceit_drake.diagnosis.evidence.noise_levels import ChannelNoise
from sliceit_drake.prediction.discrepancy import (
    FINER,
    PHASES,
    SHAPES,
    Covariates,
    Sizes,
    motion_shapes,
)

ROWS, CHANNELS = 70, ("force_z", "torque_y")
NOISE = [ChannelNoise(0.05, 0.1, 0.1), ChannelNoise(0.002, 0.1, 0.003)]
VARIATION = 0.7
COLUMNS = [
    Column("base", "material.toughness"),
    Column("record", "toughness", per_record=True),
    Column("cause", "shared", "x"),
    Column("cause", "own", "x", per_record=True),
]


def motion(speed: float, share: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, depth and way of a cut down into the board, with a rest, up, and down again."""
    s = np.linspace(0.0, 1.0, ROWS)
    depth = np.interp(s, [0, 0.1, 0.4, 0.6, 0.75, 1], [-0.002, 0, 0.02, 0.0202, 0.005, 0.02])
    rests = (s > 0.42) & (s < 0.55)
    depth[rests] = depth[np.argmax(rests)]
    down = np.abs(np.diff(depth, prepend=depth[0]))
    path = np.cumsum(down / np.sqrt(1.0 - share**2))
    return s * 0.02 / speed, depth, path


def records(rng: np.random.Generator) -> list[RecordSensitivity]:
    out = []
    for k, (speed, share) in enumerate([(0.01, 0.0), (0.01, 0.0), (0.05, 0.7), (0.05, 0.7)]):
        time, depth, path = motion(speed, share)
        touching = depth > 0.0
        level = (touching * np.sqrt(np.clip(depth, 0.0, None) / 0.02))[:, None]
        scale = np.array([1.0, 0.02])
        shapes = [level, level, np.sin(300.0 * depth)[:, None] * touching[:, None], level**3]
        columns = np.stack([s * scale * np.array([1.0, 0.5 + j]) for j, s in enumerate(shapes)], 2)
        out.append(
            RecordSensitivity(
                name=f"slice {k}",
                condition=f"{speed}",
                channels=CHANNELS,
                time=time,
                phase=np.full(ROWS, "slice"),
                depth=depth,
                path=path,
                in_contact=touching,
                measured=5.0 * level * scale + rng.normal(size=(ROWS, 2)) * scale,
                predicted=5.0 * level * scale,
                columns=columns,
                even=np.zeros_like(columns),
                height=0.02,
            )
        )
    return out


def problem(found: list[RecordSensitivity]) -> LinearProblem:
    return LinearProblem(Sensitivities(COLUMNS, found), NOISE, np.array([VARIATION]))


@pytest.fixture(scope="module")
def known() -> LinearProblem:
    return problem(records(np.random.default_rng(1)))


def some_sizes(seed: int) -> Sizes:
    rng = np.random.default_rng(seed)
    return Sizes(
        np.log([0.3, 0.01]) + 0.3 * rng.normal(size=2),
        0.3 * rng.normal(size=3) - 0.5,
        0.3 * rng.normal(size=len(PHASES) - 1) - 0.5,
    )


class Written:
    """The model written out: y, covariance V, what is fitted X, and the discrepancy's own part."""

    def __init__(self, p: LinearProblem, sizes: Sizes, fitted: list[int], own: list[float]) -> None:
        D = p.discrepancy
        deviations = sizes.deviations(D.channel, D.phase)
        y, X, noise, effects, blocks = [], [], [], [], []
        shared = []
        for r, record in enumerate(p.found.records):
            factors = p.discrepancy.factors[p.condition_of[r]]
            # Channel by channel, as the shapes are.
            y.append(record.residual.T.ravel())
            X.append(record.columns[:, :, fitted].transpose(1, 0, 2).reshape(-1, len(fitted)))
            of_own = record.columns[:, :, [1, 3]].transpose(1, 0, 2).reshape(-1, 2)
            effects.append(of_own * own)
            error = p.model_error(record)
            dt = np.abs(record.time[:, None] - record.time)
            noise.append(
                block_diag(
                    *(
                        n.ar**2 * np.exp(-dt / n.tau) + np.diag(n.white**2 + error[:, c] ** 2)
                        for c, n in enumerate(NOISE)
                    )
                )
            )
            Z = block_diag(*[p.shape_values[r]] * len(NOISE))
            shared.append(np.hstack([f * Z * d for f, d in zip(factors, deviations, strict=False)]))
            blocks.append(Z * deviations[3])
        self.y, self.X = np.concatenate(y), np.concatenate(X)
        same = np.equal.outer(p.condition_of, p.condition_of)
        S, rows = np.concatenate(shared), len(y[0])
        self.own_error = S @ S.T + np.kron(same, np.ones((rows, rows))) * (
            np.concatenate(blocks) @ np.concatenate(blocks).T
        )
        self.V = block_diag(*noise) + block_diag(*(e @ e.T for e in effects)) + self.own_error

    def projection(self, prior: np.ndarray) -> np.ndarray:
        inverse = np.linalg.inv(self.V)
        inner = self.X.T @ inverse @ self.X + np.diag(prior)
        return inverse - inverse @ self.X @ np.linalg.solve(inner, self.X.T @ inverse)

    def likelihood(self, prior: np.ndarray) -> float:
        inner = self.X.T @ np.linalg.solve(self.V, self.X) + np.diag(prior)
        dets = np.linalg.slogdet(self.V)[1] + np.linalg.slogdet(inner)[1]
        proper = prior[prior > 0.0]
        rest = self.y @ self.projection(prior) @ self.y
        return float(-0.5 * (dets - np.log(proper).sum() + rest))


def prior_of(p: LinearProblem, sizes: Sizes) -> float:
    D = p.discrepancy
    return float(-0.5 * (((sizes.flat - D.prior.flat) / D.spread) ** 2).sum())


@pytest.mark.parametrize("causes", [[], [2], [3], [2, 3]])
def test_the_likelihood_is_that_of_the_model_written_out(
    known: LinearProblem, causes: list[int]
) -> None:
    """Also between models with other causes: what is fitted and what is random may differ."""

    def both(sizes: Sizes, causes: list[int]) -> tuple[float, float]:
        model = known.with_causes(causes)
        grams = known.by_condition(model)
        value, _ = known.discrepancy.likelihood(
            grams, sizes, model.shared, model.prior[model.shared]
        )
        own = [VARIATION, PLAUSIBLE if 3 in causes else 0.0]
        written = Written(known, sizes, model.shared, own)
        wanted = written.likelihood(model.prior[model.shared]) + prior_of(known, sizes)
        return value - 0.5 * known.own_log_det(model), wanted

    first, one = both(some_sizes(0), [])
    second, other = both(some_sizes(1), causes)
    assert abs(other - one) > 1.0
    assert second - first == pytest.approx(other - one, rel=1e-6)


def test_the_gradient_is_that_of_differences(known: LinearProblem) -> None:
    model = known.with_causes([2])
    grams = known.by_condition(model)
    prior, sizes = model.prior[model.shared], some_sizes(2)

    def value(flat: np.ndarray) -> float:
        return known.discrepancy.likelihood(grams, Sizes.of(flat), model.shared, prior)[0]

    gradient = known.discrepancy.likelihood(grams, sizes, model.shared, prior)[1]
    for k, e in enumerate(1e-4 * np.eye(len(sizes.flat))):
        slope = (value(sizes.flat + e) - value(sizes.flat - e)) / 2e-4
        assert gradient[k] == pytest.approx(slope, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("narrow", [1.0, 0.05], ids=["inside", "at the ends"])
def test_sizes_are_the_same_in_units_of_their_uncertainty(narrow: float) -> None:
    whole = problem(records(np.random.default_rng(1)))
    D = whole.discrepancy
    D.spread = narrow * D.spread
    model = whole.with_causes([2])
    given = whole.by_condition(model), model.shared, model.prior[model.shared]
    plain, value = D.fit(*given, tolerance=1e-5)
    covariance = D.uncertain(given[0], plain, *given[1:])
    away = Sizes.of(plain.flat + 0.2 * D.spread)
    scaled, same = D.fit(*given, away, 1e-5, covariance)
    np.testing.assert_allclose(scaled.flat, plain.flat, atol=1e-3 * narrow)
    assert same == pytest.approx(value, abs=1e-6)
    ends = (plain.flat - D.prior.flat) / D.spread
    assert ((ends < -4.99) | (ends > 2.99)).any() == (narrow < 1.0)


def test_no_step_of_a_search_leaves_the_ranges_of_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = problem(records(np.random.default_rng(1)))
    D, model = whole.discrepancy, whole.with_causes([2])
    seen, likelihood = [], D.likelihood

    def looked_at(grams, sizes, fitted, prior):
        seen.append((sizes.flat - D.prior.flat) / D.spread)
        return likelihood(grams, sizes, fitted, prior)

    monkeypatch.setattr(D, "likelihood", looked_at)
    given = whole.by_condition(model), model.shared, model.prior[model.shared]
    wide = 1e4 * np.eye(len(D.spread))
    D.fit(*given, D.prior, 1e-5, wide)
    assert len(seen) > 3 and np.min(seen) > -5.001 and np.max(seen) < 3.001


def test_what_is_found_of_it_is_its_mean_after_the_data(known: LinearProblem) -> None:
    sizes, model = some_sizes(3), known.with_causes([2])
    written = Written(known, sizes, model.shared, [VARIATION, 0.0])
    seen = written.own_error @ written.projection(model.prior[model.shared])
    wanted = seen @ written.y
    found = OwnError(known, model, sizes)
    values = np.concatenate([v.T.ravel() for v in found.values])
    np.testing.assert_allclose(values, wanted, atol=1e-6 * np.abs(wanted).max())
    # Its scale is the root mean square that it has in a phase after the data, where the knife
    # touches: of what was found and of how unsure that is.
    after = np.diag(written.own_error - seen @ written.own_error)
    variance = after.reshape(4, 2, ROWS).transpose(0, 2, 1)
    inside = np.array([r.in_contact for r in known.found.records])
    squares = np.concatenate([v[i] ** 2 for v, i in zip(found.values, inside, strict=True)]).mean(0)
    for scale, square in (
        (found.scales(found=True)[0], squares),
        (found.scales()[0], squares + variance[inside].mean(0)),
    ):
        wanted = np.broadcast_to(square, (inside[0].sum(), 2))
        np.testing.assert_allclose(scale[inside[0]] ** 2, wanted, rtol=1e-6)
        assert not scale[~inside[0]].any()


def test_its_sizes_are_found_from_many_records() -> None:
    """Coefficients drawn of known sizes, 30 conditions of 2 records."""
    rng = np.random.default_rng(5)
    base = records(rng)
    found = []
    p = problem(base)
    wanted = Sizes(np.log([0.8, 0.02]), np.log([0.2, 0.2, 0.6]), p.discrepancy.prior.phase)
    D = p.discrepancy
    deviations = wanted.deviations(D.channel, D.phase)
    shared = deviations[:3] * rng.normal(size=deviations[:3].shape)
    for k in range(30):
        own = deviations[3] * rng.normal(size=deviations.shape[1])
        for j in (0, 1):
            record, factors = base[2 * (k % 2) + j], D.factors[k % 2]
            coefficients = (factors @ shared + own).reshape(2, -1)
            error = p.shape_values[2 * (k % 2) + j] @ coefficients.T
            noise = rng.normal(size=(ROWS, 2)) * [n.deviation for n in NOISE]
            kind = record.predicted + error + noise
            found.append(
                RecordSensitivity(
                    **{**vars(record), "measured": kind, "condition": f"{k}", "name": f"{k} {j}"}
                )
            )
    sizes = problem(found).sizes
    ratio = np.exp(sizes.channel + sizes.part[2] - wanted.channel - wanted.part[2])
    np.testing.assert_allclose(ratio, 1.0, atol=0.35)


def test_units_and_the_order_of_records_change_nothing(known: LinearProblem) -> None:
    found = records(np.random.default_rng(1))
    turned = problem(found[::-1])
    scale = np.array([1000.0, 1000.0])
    moved = [
        RecordSensitivity(
            **{
                **vars(r),
                "measured": r.measured * scale,
                "predicted": r.predicted * scale,
                "columns": r.columns * scale[:, None],
            }
        )
        for r in found
    ]
    milli = LinearProblem(
        Sensitivities(COLUMNS, moved),
        [ChannelNoise(1e3 * n.ar, n.tau, 1e3 * n.white) for n in NOISE],
        np.array([VARIATION]),
    )
    start = known.sizes
    np.testing.assert_allclose(turned.sizes.flat, start.flat, atol=0.03)
    np.testing.assert_allclose(milli.sizes.channel, start.channel + np.log(1e3), atol=0.03)
    np.testing.assert_allclose(milli.sizes.flat[2:], start.flat[2:], atol=0.03)


@pytest.mark.parametrize("period", [8e-3, 12e-3])
def test_shapes_of_uneven_slices_follow_their_waves_down_to_the_board(period: float) -> None:
    depth = np.linspace(1e-4, 0.03, 600)
    wave, left = np.sin(2.0 * np.pi * depth / period), []
    for count in (SHAPES["in"], FINER):
        values, phase = motion_shapes(depth / 0.02, depth, depth, depth > 0.0, 0.03, 0.03, count)
        inside = values[:, phase == PHASES.index("in")]
        rest = wave - inside @ np.linalg.lstsq(inside, wave, rcond=None)[0]
        left.append(np.std(rest[depth > 0.015]))
    assert left[1] < 0.6 * left[0]


def test_phases_and_covariates_are_those_of_the_motion() -> None:
    time, depth, path = motion(0.05, 0.7)
    values, phase = motion_shapes(time, depth, path, depth > 0.0, 0.0202, 0.02)
    rows = {name: np.abs(values[:, phase == k]).max(1) > 0.0 for k, name in enumerate(PHASES)}
    deepest = np.maximum.accumulate(depth)
    assert not rows["in"][depth < deepest - 1e-3].any()
    rests = np.flatnonzero(np.gradient(path, time) < 3e-4)
    assert rows["rest"][rests[2:-2]].all() and not rows["rest"][: rests[0]].any()
    assert (rows["out"] & (np.gradient(depth) < 0.0)).sum() > 5
    assert rows["again"][-3:].all() and not rows["again"][: rests[-1]].any()
    assert rows["board"][depth > 0.02 + 1e-6].all() and not rows["board"][depth <= 0.02].any()
    assert rows["any"][depth < 0.0][1:].all()
    covariates = Covariates.of(time, depth, path)
    assert covariates.draw == pytest.approx(0.7, abs=0.05)
    assert covariates.speed == pytest.approx(
        np.log10(np.median(np.gradient(path, time)[rows["in"]])), abs=0.15
    )
