"""Douglas-Peucker keeps the vertices of the textbook recursion, or exactly as many as asked."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfit._base._douglas_peucker import chord_lengths, densify, simplify


def naive(points, tolerance, first=0):
    """The recursion, vertex by vertex."""
    start, chord = points[0], points[-1] - points[0]

    def distance(p):
        t = np.clip((p - start) @ chord / (chord @ chord), 0, 1) if chord @ chord > 0 else 0.0
        return np.linalg.norm(p - start - t * chord)

    distances = [distance(p) for p in points]
    k = int(np.argmax(distances))
    if distances[k] <= tolerance:
        return {first, first + len(points) - 1}
    return naive(points[: k + 1], tolerance, first) | naive(points[k:], tolerance, first + k)


@given(st.integers(3, 40), st.floats(0.05, 1.5), st.integers(0, 2**16))
def test_same_vertices_as_the_recursion(count, tolerance, seed):
    points = np.cumsum(np.random.default_rng(seed).normal(size=(count, 2)), axis=0)
    assert set(simplify(points, tolerance).tolist()) == naive(points, tolerance)


def test_a_closed_polyline_is_split_at_its_far_side():
    angle = np.linspace(0, 2 * np.pi, 41)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ring[-1] = ring[0]
    np.testing.assert_array_equal(simplify(ring, 0.1, most=3), [0, 20, 40])


@pytest.mark.parametrize("shift", [1.0, 0.1, 5e6])
def test_which_of_equal_pieces_goes_first_does_not_depend_on_rounding(shift):
    t = np.linspace(0, 1, 25)
    lines = [np.stack([t, 0 * t], axis=1), np.stack([t, np.abs(np.sin(4 * np.pi * t))], axis=1)]
    for line in lines:
        for most in range(3, 20):
            first, moved = (simplify(x, 1e-3, least=most, most=most) for x in (line, line + shift))
            np.testing.assert_array_equal(first, moved)
        np.testing.assert_allclose(densify(line + shift, 40), densify(line, 40) + shift, atol=1e-8)


@pytest.mark.parametrize("count", [2, 5, 17, 64])
def test_exactly_as_many_vertices_as_asked(count):
    points = np.cumsum(np.random.default_rng(0).normal(size=(64, 3)), axis=0)
    kept = simplify(points, 0.0, least=count, most=count)
    assert len(kept) == count
    assert (np.diff(kept) > 0).all()


def test_a_straight_line_is_shared_evenly():
    x = np.linspace(0, 1, 101)
    kept = simplify(np.stack([x, 2 * x], axis=1), 1e-9, least=5)
    np.testing.assert_array_equal(kept, [0, 25, 50, 75, 100])


def test_a_hundred_thousand_vertices_do_not_recurse_too_deep():
    x = np.linspace(0, 1, 100_000)
    parabola = np.stack([x, x**2], axis=1)
    kept = simplify(parabola, 1e-7)
    assert 800 < len(kept) < 3000  # splits are balanced here; chord error is (step)^2 / 4
    zigzag = np.stack([x, (-1.0) ** np.arange(len(x))], axis=1)
    assert len(simplify(zigzag, 1e-7, most=64)) == 64


def test_densify_reaches_the_count_and_stays_on_the_line():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 9.0]])
    dense = densify(points, 11)
    assert len(dense) == 11
    assert chord_lengths(dense)[-1] == pytest.approx(10.0)
    assert np.diff(chord_lengths(dense)).max() <= 9 / 4  # the long edge got most of them
    np.testing.assert_array_equal(densify(points, 2), points)
