"""Ends of faces at the border of the field of view are told from edges."""
from __future__ import annotations

from handeye_ros.data import Array, EdgePoint, FaceLine, Sample
from handeye_ros.sampling.field_of_view import border_lines, without_border_ends
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

HALF = 0.14  # slope of the sides of the field of view


def face_between(stamp: int, start: Array, end: Array, kinds: tuple[str, str]) -> Sample:
    """Return a sample whose face runs from start to end; kinds: of its ends, '' for none."""
    along = (end - start) / np.linalg.norm(end - start)
    line = FaceLine((start + end) / 2, along, float(np.linalg.norm(end - start) / 12 ** 0.5), 1e-6)
    ends = [EdgePoint(p, d, 1e-5, 1e-6, kind) for p, d, kind in
            zip((start, end), (-along, along), kinds, strict=True) if kind]
    return Sample(stamp, np.eye(4), (line, *ends))


def recording(kind: str = 'open', count: int = 12, seed: int = 0) -> list[Sample]:
    """Return samples whose faces run from an edge inside to the right side of the field."""
    rng = np.random.default_rng(seed)
    samples = []
    for stamp, z in enumerate(np.linspace(0.155, 0.195, count)):
        edge = np.array([rng.uniform(-0.6, 0.4) * HALF * z, z])
        border = np.array([HALF * (z + 0.002), z + 0.002]) + rng.normal(0, 3e-5, 2)
        samples.append(face_between(stamp, edge, border, (kind, kind)))
    return samples


def edges(sample: Sample) -> list[EdgePoint]:
    return [f for f in sample.features if isinstance(f, EdgePoint)]


@pytest.mark.parametrize('kind', ['open', 'gap'])
def test_ends_on_one_line_at_the_side_are_no_edges(kind: str) -> None:
    samples = recording(kind)
    kept, rejects = without_border_ends(samples)
    assert len(kept) == len(samples) and not rejects
    for before, after in zip(samples, kept, strict=True):
        assert edges(after) == edges(before)[:1], 'the edge inside stays'
        assert after.features[0] is before.features[0]
        assert (after.stamp, after.profiles) == (before.stamp, before.profiles)


def test_a_sample_without_another_edge_is_refused_with_a_reason() -> None:
    samples = recording()
    z = 0.17
    only = face_between(99, np.array([-0.01, z]), np.array([HALF * z, z]), ('', 'open'))
    kept, rejects = without_border_ends([*samples, only])
    assert len(kept) == len(samples)
    (reject,) = rejects
    assert reject.stamp == 99 and 'border of the field of view' in reject.reason


@pytest.mark.parametrize('kind', ['step', 'roof'])
def test_edges_with_something_behind_them_stay_wherever_they_are(kind: str) -> None:
    samples = recording(kind)
    assert without_border_ends(samples) == (samples, [])


def test_edges_inside_stay_though_many() -> None:
    rng = np.random.default_rng(3)
    samples = []
    for stamp in range(16):
        z = rng.uniform(0.155, 0.195)
        edge = np.array([rng.uniform(-0.7, 0.7) * HALF * z, z])
        other = edge + [rng.choice([-1, 1]) * 0.015, rng.normal(0, 2e-3)]
        samples.append(face_between(stamp, edge, other, ('gap', '')))
    kept, rejects = without_border_ends(samples)
    assert not rejects and [edges(s) for s in kept] == [edges(s) for s in samples]


def test_edges_on_one_line_with_the_face_on_both_sides_stay() -> None:
    # a plate kept at one place of the field of view, seen from both sides
    samples = [face_between(k, np.array([0.001, z]), np.array([side * 0.02, z]), ('gap', ''))
               for k, (z, side) in enumerate(zip(np.linspace(0.16, 0.19, 10), [1, -1] * 5,
                                                 strict=True))]
    kept, rejects = without_border_ends(samples)
    assert not rejects and [edges(s) for s in kept] == [edges(s) for s in samples]


@pytest.mark.parametrize('scatter', [2e-5, 5e-5, 2e-4])
@pytest.mark.parametrize('kind', ['gap', 'open'])
def test_edges_that_a_programme_brings_to_one_place_stay(kind: str, scatter: float) -> None:
    # no table: the face ends in nothing, and at the border of the view where the driver is silent
    for seed in range(5):
        rng = np.random.default_rng(seed)
        samples = []
        for stamp, z in enumerate(rng.uniform(0.155, 0.195, 16)):
            edge = np.array([rng.normal(0.001, scatter), z])
            slope = rng.uniform(-0.4, 0.4)
            reach = (HALF * z - edge[0]) / (1 - HALF * slope)
            border = edge + reach * np.array([1.0, slope]) + rng.normal(0, 1e-5, 2)
            kinds = (kind, 'open' if kind == 'open' else '')
            samples.append(face_between(stamp, edge, border, kinds))
        kept, rejects = without_border_ends(samples)
        assert not rejects and len(kept) == len(samples)
        for before, after in zip(samples, kept, strict=True):
            assert edges(after) == edges(before)[:1]


def test_few_ends_are_left_alone() -> None:
    samples = recording(count=2)
    assert without_border_ends(samples) == (samples, [])
    assert without_border_ends([]) == ([], [])


def test_the_order_of_samples_is_no_matter() -> None:
    samples = recording(seed=4)
    shuffled = [samples[k] for k in np.random.default_rng(0).permutation(len(samples))]
    after = {s.stamp: len(edges(s)) for s in without_border_ends(samples)[0]}
    assert {s.stamp: len(edges(s)) for s in without_border_ends(shuffled)[0]} == after


def test_inputs_stay_as_they_are() -> None:
    samples = recording()
    features = [s.features for s in samples]
    without_border_ends(samples)
    assert all(s.features is f for s, f in zip(samples, features, strict=True))


@given(arrays(float, st.tuples(st.integers(5, 20), st.just(2)),
              elements=st.floats(-0.1, 0.3)))
def test_any_ends_give_lines_with_all_on_one_side(ends: Array) -> None:
    lines = border_lines(ends, ends)
    assert np.isfinite(lines).all()
    for line in lines:
        away = ends @ line[:2] - line[2]
        assert away.max() < 1e-3 or away.min() > -1e-3
