"""Bad queries are refused in one sentence before anything is compiled."""

import helpers
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit import _precision, closest_point

GOOD = np.zeros((5, 3))


@pytest.mark.parametrize(
    ("points", "start", "sentence"),
    [
        (np.where(np.arange(15).reshape(5, 3) == 7, np.nan, 0.0), None, "points must be finite"),
        (np.zeros((5, 2)), None, "points must have 3 coordinates"),
        (np.zeros((0, 3)), None, "points must hold at least 1"),
        (np.zeros(3), None, "points must have 2 dimensions"),
        (GOOD, np.zeros(5), "start must be a pair"),
        (GOOD, (np.zeros(4), np.zeros(5)), "start u must hold one parameter for each of the 5"),
        (GOOD, (np.zeros(5), np.zeros((5, 1))), "start v must have 1 dimension"),
        (GOOD, (np.zeros(5), np.full(5, np.inf)), "start v must be finite"),
    ],
)
def test_bad_queries_name_the_argument_and_the_remedy(points, start, sentence):
    with pytest.raises(ValueError, match=sentence), helpers.count_compilations() as compiled:
        closest_point(helpers.wavy_surface(), points, start)
    assert compiled.count == 0


def test_points_must_be_numbers():
    with pytest.raises(TypeError, match="points must hold real numbers"):
        closest_point(helpers.wavy_surface(), np.zeros((5, 3), complex))


@pytest.mark.float32_too
def test_the_advice_to_use_double_precision_is_given_once(monkeypatch, recwarn):
    monkeypatch.setattr(_precision, "_advised", False)
    surface = helpers.wavy_surface(dtype=jnp.float32)
    points = np.zeros((5, 3), np.float32)
    with pytest.warns(UserWarning, match="jax_enable_x64"):
        closest_point(surface, points, tolerance=1e-9)
    closest_point(surface, points, tolerance=1e-9)
    assert not recwarn.list
