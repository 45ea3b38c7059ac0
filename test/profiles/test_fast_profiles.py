"""What is done quickly in profiles/ gives what the plain way of the same gives."""
from __future__ import annotations

from handeye_ros.profiles import circles, faces, line_search, lines
from handeye_ros.profiles.continuation import Returns
from handeye_ros.profiles.segment import Segment
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.integers(1, 200), st.integers(2, 300))
def test_votes_for_lines(seed: int, lines: int, points: int) -> None:
    rng = np.random.default_rng(seed)
    slope, offset = rng.normal(size=lines), rng.normal(0.2, 0.02, lines)
    x, z = rng.normal(0.0, 0.02, points), rng.normal(0.2, 0.02, points)
    plain = np.abs(z - offset[:, None] - slope[:, None] * x) < 1e-2
    votes = line_search._votes(np.stack([offset, slope, np.full(lines, -1.0)]),
                               np.stack([np.ones(points), x, z]), 1e-2)
    np.testing.assert_array_equal(votes, plain.sum(axis=1))


@given(SEEDS, st.integers(3, 300), st.booleans())
def test_lines_through_pairs(seed: int, n: int, above: bool) -> None:
    rng = np.random.default_rng(seed)
    x, z = rng.normal(0.0, 0.02, n), rng.normal(0.0, 0.02, n)
    x[:n // 2 if above else 0] = 0.01  # points above each other give no line
    first, second = line_search._pairs(n)
    assert 0 <= first.min() and second.max() < n
    apart = np.abs(x[second] - x[first]) > line_search.NARROWEST
    offset, slope, minus = line_search._hypotheses(x, z)
    assert (minus == -1).all() and len(minus) == apart.sum()
    for ends in (first[apart], second[apart]):
        np.testing.assert_allclose(offset + slope * x[ends], z[ends], rtol=1e-6, atol=1e-9)


@given(st.integers(1, 3000))
def test_those_who_vote_are_evenly_spread(size: int) -> None:
    first, others = line_search._voters(size)
    both = np.sort(np.concatenate([first, others]))
    assert both[0] == 0 and len(np.unique(np.diff(both))) <= 1
    assert len(both) <= line_search.SEARCH_POINTS and size - both[-1] <= -(-size // len(both))
    assert not len(others) or len(first) >= line_search.FIRST_VOTERS


@pytest.mark.parametrize('share', [0.55, 0.7, 0.95])
def test_a_line_that_most_vote_for_first_is_that_of_all(share: float) -> None:
    for seed in range(40):
        rng = np.random.default_rng(seed)
        x = np.linspace(-0.02, 0.02, 900)
        z = 0.2 + rng.uniform(-0.6, 0.6) * x + rng.normal(0.0, 3e-5, len(x))
        z[int(share * len(x)):] += 0.004 * rng.choice([-1, 1])
        wrong = rng.random(len(x)) < 0.04
        z[wrong] += rng.uniform(-0.01, 0.01, wrong.sum())
        terms = line_search.line_terms(x, z)
        found = line_search.dominant_line(terms, 1.2e-4, 20)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(line_search, 'SURE', 2.0)
            np.testing.assert_array_equal(found, line_search.dominant_line(terms, 1.2e-4, 20))
        assert found is not None and found.sum() > 0.94 * share * len(x)


@given(SEEDS, st.integers(30, 300), st.floats(-1.0, 1.0))
def test_lines_from_sums(seed: int, n: int, away: float) -> None:
    rng = np.random.default_rng(seed)
    x, near = away + rng.normal(0.0, 0.01, n), rng.random(n) < 0.7
    z = 0.2 + rng.normal() * x + rng.normal(0.0, 1e-4, n)
    terms = line_search.line_terms(x, z)
    got = line_search._fitted(*(terms @ near).tolist())
    offset, slope = np.polynomial.Polynomial.fit(
        x[near] - x.mean(), z[near] - z.mean(), 1).convert().coef
    np.testing.assert_allclose(got, [offset, slope, -1.0], rtol=0, atol=1e-9)


def test_points_above_each_other_are_level() -> None:
    terms = line_search.line_terms(np.full(50, 0.3), np.linspace(0.1, 0.2, 50))
    np.testing.assert_allclose(line_search._fitted(*(terms @ np.ones(50)).tolist()),
                               [0.0, 0.0, -1.0], rtol=0, atol=1e-12)


@given(SEEDS, st.integers(1, 100), st.integers(5, 300), st.sampled_from([1e-4, 1e-2]))
def test_votes_for_circles(seed: int, count: int, n: int, tolerance: float) -> None:
    rng = np.random.default_rng(seed)
    # some circles are smaller than the tolerance
    found = np.column_stack([rng.normal(0.0, 0.02, count), rng.normal(0.2, 0.02, count),
                             rng.uniform(1e-3, 0.05, count)])
    points = np.column_stack([rng.normal(0.0, 0.02, n), rng.normal(0.2, 0.02, n)])
    away = np.linalg.norm(points - found[:, None, :2], axis=2) - found[:, 2:]
    on = np.abs(away) < tolerance
    np.testing.assert_array_equal(circles._on_circle(found, points, tolerance), on)
    votes = on.sum(axis=1)
    variance = np.array([points[row].var(axis=0).sum() if row.any() else 0.0 for row in on])
    sagitta = 12 * variance / (8 * found[:, 2])
    clear = np.abs(sagitta - circles.LEAST_SAGITTA * tolerance) > 1e-12
    expected = np.where(sagitta > circles.LEAST_SAGITTA * tolerance, votes, 0)
    np.testing.assert_array_equal(circles._votes(on, found, points, tolerance)[clear],
                                  expected[clear])


@given(SEEDS, st.integers(1, 400))
def test_quantiles_and_bins(seed: int, n: int) -> None:
    values = np.random.default_rng(seed).normal(size=n)
    np.testing.assert_allclose(circles._quantiles(values, (0.005, 0.995)),
                               np.quantile(values, [0.005, 0.995]), rtol=0, atol=1e-15)
    parts = min(n, 7)
    got, size = lines.bin_means(values, parts)
    first = [*np.linspace(0, n, parts, endpoint=False).astype(int), n]
    plain = [values[a:b].mean() for a, b in zip(first, first[1:], strict=False)]
    np.testing.assert_allclose(got, plain, rtol=0, atol=1e-14)
    assert size.sum() == n
    with pytest.raises(ValueError):
        size[0] = 1


@given(SEEDS, st.sampled_from([2, 3]))
def test_normal_equations(seed: int, n: int) -> None:
    J = np.random.default_rng(seed).normal(size=(n, 50))
    A, b = J @ J.T, J[:, 0].copy()
    ridge = circles.TINY * np.trace(A) * np.eye(n)
    np.testing.assert_allclose(circles._solved(A.copy(), b), np.linalg.solve(A + ridge, b),
                               rtol=1e-12)


@given(SEEDS, st.integers(1, 5))
def test_the_preferred_face_is_that_of_all(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    lengths = rng.integers(20, 60, count)
    ends = np.cumsum(lengths)
    pieces = [Segment(int(b - n), int(b - 1), np.arange(b - n, b), 0.0, 0.0, 1e-5,
                      np.arange(b - n, b)) for b, n in zip(ends, lengths, strict=True)]
    kinds = [list(rng.choice(['step', 'gap'], rng.integers(0, 3))) for _ in pieces]
    behind = rng.random(count) < 0.3
    result = {id(p): ([Kind(k) for k in ks], bool(b))
              for p, ks, b in zip(pieces, kinds, behind, strict=True)}
    asked = [p for p in pieces if result[id(p)][0]]
    best = max(asked, key=lambda p: faces._preference(p, *result[id(p)]), default=None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(faces, '_edges', lambda p, *_: result[id(p)])
        seen = Returns(np.zeros((int(ends[-1]), 2)), np.arange(int(ends[-1])), -1)
        assert faces._preferred(pieces, seen)[0] is best


class Kind:
    """An edge of which only its kind is asked for."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
