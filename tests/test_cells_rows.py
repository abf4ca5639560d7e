"""Every point sits in exactly one slot of a row of its cell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfit._cells import make_rows, overlap_add, powers, row_width

POINTS, CELLS = 60, 9
compiled = jax.jit(make_rows, static_argnums=(1, 2))


def assert_rows(cell, cells, width):
    rows = compiled(jnp.asarray(cell), cells, width)
    point, taking_part = np.asarray(rows.point), np.flatnonzero(cell < cells)
    count, width_of_rows = point.shape
    assert width_of_rows == width
    assert count <= len(cell) // width + min(cells, len(cell))
    assert rows.used == np.sum(-(-np.bincount(cell[cell < cells], minlength=cells) // width))
    filled = np.asarray(rows.filled)
    np.testing.assert_array_equal(np.sort(point[filled]), taking_part)
    assert (point[~filled] == len(cell)).all()
    owner = np.broadcast_to(np.asarray(rows.cell)[:, None], point.shape)
    np.testing.assert_array_equal(owner[filled], cell[point[filled]])
    assert filled[: rows.used, 0].all()
    assert not filled[rows.used :].any()
    return rows


@given(st.lists(st.integers(0, CELLS), min_size=POINTS, max_size=POINTS))
def test_every_point_has_one_slot_in_a_row_of_its_cell(cell):
    assert_rows(np.array(cell, np.int32), CELLS, 8)


@pytest.mark.float32_too
@pytest.mark.parametrize("case", ["all in the first", "all in the last", "none", "one each"])
def test_lopsided_clouds_fit_the_bounded_number_of_rows(case):
    cell = {
        "all in the first": np.zeros(POINTS),
        "all in the last": np.full(POINTS, CELLS - 1),
        "none": np.full(POINTS, CELLS),
        "one each": np.arange(POINTS) % CELLS,
    }[case]
    assert_rows(cell.astype(np.int32), CELLS, 8)


@pytest.mark.float32_too
def test_words_too_long_to_pack_are_sorted_all_the_same():
    # 2^15 cells and 2^18 points need 33 bits: a 64-bit word, or without x64 a sort with a payload.
    cells = (1 << 15) - 1
    cell = np.random.default_rng(0).integers(0, cells, (1 << 18) - 1).astype(np.int32)
    assert_rows(cell, cells, 8)


@pytest.mark.float32_too
def test_far_fewer_points_than_cells_get_rows_of_their_own():
    cell = np.full(POINTS, CELLS, np.int32)
    taking_part = np.random.default_rng(0).choice(POINTS, CELLS // 4, replace=False)
    cell[taking_part] = np.random.default_rng(1).integers(0, CELLS, CELLS // 4)
    rows = compiled(jnp.asarray(cell), CELLS, 8)
    assert rows.used == CELLS // 4
    assert (rows.filled.sum(axis=1)[: CELLS // 4] == 1).all()
    held = np.asarray(rows.point)[np.asarray(rows.filled)]
    np.testing.assert_array_equal(np.sort(held), np.sort(taking_part))
    np.testing.assert_array_equal(rows.cell[: CELLS // 4], cell[held])


@pytest.mark.float32_too
def test_spread_puts_values_where_the_points_are():
    cell = np.random.default_rng(0).integers(0, CELLS, POINTS).astype(np.int32)
    rows = assert_rows(cell, CELLS, 8)
    x = jnp.asarray(np.random.default_rng(1).normal(size=(2, POINTS)))
    there = rows.spread(x)
    assert np.isfinite(there).all()
    np.testing.assert_array_equal(there[:, rows.filled], x[:, rows.point[rows.filled]])


@pytest.mark.float32_too
def test_rows_of_one_point_each():
    cell = np.random.default_rng(2).integers(0, CELLS + 1, POINTS).astype(np.int32)
    rows = compiled(jnp.asarray(cell), CELLS, 1)
    taking_part = np.flatnonzero(cell < CELLS)
    assert rows.used == taking_part.size
    np.testing.assert_array_equal(np.sort(rows.point[: rows.used, 0]), taking_part)
    np.testing.assert_array_equal(rows.cell[: rows.used], cell[rows.point[: rows.used, 0]])


def test_rows_get_wider_with_more_points_in_a_cell():
    widths = [row_width(n, 100) for n in (10, 1_000, 10_000, 1_000_000)]
    assert widths == sorted(widths)
    assert set(widths) <= {8, 16, 32}


@pytest.mark.float32_too
@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_powers_are_those_of_numpy(count):
    x = jnp.asarray(np.random.default_rng(count).uniform(-1, 1, (3, 5)))
    expected = np.asarray(x)[None] ** np.arange(count)[:, None, None]
    np.testing.assert_allclose(powers(x, count), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, -1])
def test_terms_overlap_one_place_farther_each(axis):
    terms = np.random.default_rng(3).normal(size=(3, 4, 5, 2))
    expected = 0.0
    for place, term in enumerate(terms):
        sides = [(0, 0)] * 3
        sides[axis] = (place, 2 - place)
        expected = expected + np.pad(term, sides)
    np.testing.assert_allclose(overlap_add(terms, axis), expected, atol=1e-15)
    np.testing.assert_allclose(overlap_add(jnp.asarray(terms), axis), expected, atol=1e-15)
