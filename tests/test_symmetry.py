"""Symmetric is symmetric to the bit, the plane is found in noise, and zebra stripes show both."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import clamped_uniform, data, eps, random_clamped_knots, wavy_surface

from jaxfit import BSplineSurface, Reflection, averaging_knots, grid_parameters, zebra
from jaxfit._quality._zebra import zebra_grid

SIZES = [(6, 5), (7, 5)]


def mirror_by_hand(points, point, normal):
    return points - 2 * ((points - point) @ normal)[..., None] * normal


def hood(n=6, m=5, d=3, axis=0, noise=0.0, seed=0):
    """A grid symmetric about a plane in general position, plus noise; the plane's point and normal."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(0, 1.5, m), indexing="ij")
    coordinates = [x * (1 - 0.3 * y), y + 0.1 * x**2, 0.4 * (1 - x**2) * np.cos(y)]
    turn, _ = np.linalg.qr(rng.normal(size=(d, d)))
    shift = rng.normal(size=d)
    grid = np.stack(coordinates[:d], axis=-1) @ turn.T + shift
    if axis == 1:
        grid = grid.swapaxes(0, 1)
    return grid + noise * rng.normal(size=grid.shape), shift, turn[:, 0]


# ------------------------------------------------------------------ the plane


@pytest.mark.float32_too
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_the_plane_is_found_to_the_noise(size, axis, noise):
    grid, inside, true = hood(*size, axis=axis, noise=noise)
    point, normal = Reflection(axis).plane(grid)
    level = 20 * eps() + 4 * noise / np.sqrt(size[0] * size[1])
    assert abs((np.asarray(point) - inside) @ true) < level
    assert 1 - abs(float(normal @ true)) < level**2 + 8 * eps()
    assert float(jnp.linalg.norm(normal)) == pytest.approx(1, abs=4 * eps())
    rows = np.moveaxis(grid, axis, 0)
    assert (rows[-1].mean(axis=0) - rows[0].mean(axis=0)) @ np.asarray(normal) > 0


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_plane_is_found_in_every_dimension(d):
    grid, inside, true = hood(d=d)
    reflection = Reflection().located(grid)
    np.testing.assert_allclose(abs(reflection.normal @ true), 1, atol=1e-14)
    np.testing.assert_allclose(reflection.mirror(grid), mirror_by_hand(grid, inside, true), atol=1e-14)


def test_the_plane_is_found_where_the_surface_reaches_across_it():
    grid, _, true = hood(8, 5)
    swapped = grid.copy()
    swapped[[1, 6]] = grid[[6, 1]]  # one pair has changed sides
    np.testing.assert_allclose(abs(Reflection().plane(swapped)[1] @ true), 1, atol=1e-14)


def test_no_other_plane_is_closer_to_a_noisy_grid():
    grid, _, _ = hood(7, 5, noise=0.05)
    point, normal = (np.asarray(x) for x in Reflection().plane(grid))

    def deviation(point, normal):
        image = mirror_by_hand(grid[::-1], point, normal / np.linalg.norm(normal))
        return np.sum((grid - image) ** 2)

    rng = np.random.default_rng(1)
    for _ in range(20):
        other = point + 1e-3 * rng.normal(size=3), normal + 1e-3 * rng.normal(size=3)
        assert deviation(*other) >= deviation(point, normal)


def test_what_is_given_is_kept():
    grid, _, _ = hood()
    reflection = Reflection(point=[1.0, 2.0, 3.0], normal=(0, 0, -2))
    point, normal = reflection.plane(grid)
    np.testing.assert_array_equal(point, [1, 2, 3])
    np.testing.assert_array_equal(normal, [0, 0, -1])
    np.testing.assert_array_equal(reflection.mirror(np.ones((1, 3))), [[1, 1, 5]])
    np.testing.assert_allclose(Reflection(normal=(1, 0, 0)).plane(grid)[0], grid.mean(axis=(0, 1)))
    assert Reflection(point=grid[0, 0]).plane(grid)[1].shape == (3,)


def test_the_unit_does_not_matter():
    grid, _, _ = hood(noise=0.01)
    centre, scale = np.array([5.0, -3.0, 2.0]), 0.25
    outside = Reflection().located(grid)
    inside = outside.in_unit(centre, scale)
    moved = inside.symmetrise_points((grid - centre) / scale)
    np.testing.assert_allclose(
        np.asarray(moved) * scale + centre, outside.symmetrise_points(grid), atol=1e-14
    )
    for factor in (1e-170, 1e170):
        np.testing.assert_allclose(Reflection().plane(grid * factor)[1], outside.normal, atol=1e-13)


@pytest.mark.parametrize(
    ("grid", "reflection", "sentence"),
    [
        (np.ones((4, 5, 3)), Reflection(), "no plane of symmetry for this pairing.*pair the other index"),
        (np.repeat(hood()[0][:1], 4, axis=0), Reflection(), "no common direction"),
        (hood()[0][:1], Reflection(), "at least two points along index 0"),
        (hood()[0], Reflection(normal=(1.0, 0.0)), "as many coordinates as the normal"),
        (hood()[0][0], Reflection(), "grid must have 3 dimensions"),
    ],
)
def test_grids_without_a_plane_get_a_sentence(grid, reflection, sentence):
    with pytest.raises(ValueError, match=sentence):
        reflection.plane(grid)


def test_a_half_turn_is_no_reflection():
    angle, height = np.meshgrid(np.arange(8) * np.pi / 4, np.linspace(0, 1, 4), indexing="ij")
    ring = np.stack([np.cos(angle), np.sin(angle), height], axis=-1)
    turned = np.concatenate([ring[:4], ring[4:][::-1]])  # opposite points are paired
    with pytest.raises(ValueError, match="no common direction"):
        Reflection().plane(turned)
    assert np.isfinite(jax.jit(Reflection().symmetrise_points)(turned)).all()


def test_impossible_reflections_get_a_sentence():
    with pytest.raises(ValueError, match="axis must be 0"):
        Reflection(2)
    with pytest.raises(ValueError, match="normal must not be zero"):
        Reflection(normal=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="3 and 2"):
        Reflection(point=(0.0, 0.0, 0.0), normal=(1.0, 0.0))
    with pytest.raises(ValueError, match="no plane yet"):
        Reflection().mirror(np.zeros((2, 3)))


# ------------------------------------------------------------- the projection


@pytest.mark.float32_too
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("size", "d"), [((6, 5), 2), ((7, 5), 3)])
def test_symmetrised_points_are_symmetric_to_the_bit(size, d, axis):
    grid, _, _ = hood(*size, d=d, axis=axis, noise=0.1)
    reflection = Reflection(axis).located(grid)
    net = reflection.symmetrise_points(grid)
    assert net.shape == grid.shape
    rows = np.moveaxis(np.asarray(net), axis, 0)
    half = size[0] // 2
    np.testing.assert_array_equal(rows[::-1][:half], reflection.mirror(rows[:half]))
    assert float(reflection.asymmetry(net)) <= (8 * eps() if size[0] % 2 else 0)
    np.testing.assert_allclose(reflection.symmetrise_points(net), net, atol=16 * eps())
    assert float(reflection.asymmetry(grid)) > 0.1


def test_a_coordinate_plane_leaves_nothing_to_rounding():
    grid = np.random.default_rng(0).normal(size=(7, 4, 3))
    reflection = Reflection(point=(0, 0, 0), normal=(2, 0, 0))
    net = np.asarray(reflection.symmetrise_points(grid))
    np.testing.assert_array_equal(net, net[::-1] * [-1, 1, 1])
    np.testing.assert_array_equal(reflection.symmetrise_points(net), net)
    assert float(reflection.asymmetry(net)) == 0


@pytest.mark.parametrize("size", SIZES)
def test_the_projection_is_orthogonal(size):
    grid, _, _ = hood(*size, noise=0.1)
    reflection = Reflection().located(grid)
    rng = np.random.default_rng(2)
    net, other = (
        np.asarray(reflection.symmetrise_points(x)) for x in (grid, grid + rng.normal(size=grid.shape))
    )
    assert abs(np.sum((grid - net) * (other - net))) < 1e-13


def test_asymmetry_is_the_largest_distance():
    grid, point, normal = hood(7, 5, noise=0.1)
    by_hand = np.linalg.norm(grid - mirror_by_hand(grid[::-1], point, normal), axis=-1).max()
    np.testing.assert_allclose(Reflection(0, point, normal).asymmetry(grid), by_hand, rtol=1e-13)


def test_a_digitised_hood_becomes_symmetric():
    grid = data("hood_beetle_10x10")["grid"]
    reflection = Reflection().located(grid)
    np.testing.assert_allclose(np.abs(reflection.normal), [1, 0, 0], atol=1e-5)
    net = reflection.symmetrise_points(grid)
    assert 1e-6 < float(reflection.asymmetry(grid)) < 2e-5
    assert float(reflection.asymmetry(net)) == 0
    assert np.abs(net - grid).max() < 1e-5


# ------------------------------------------------------- parameters and knots


@pytest.mark.float32_too
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("size", SIZES)
def test_parameters_become_symmetric_to_the_bit(size, axis):
    rng = np.random.default_rng(0)
    vectors = [np.append(0, np.cumsum(rng.uniform(0.1, 1, n - 1))) for n in size]
    given = [(x / x[-1]).astype(jnp.result_type(float)) for x in vectors]
    per_point = np.stack(np.meshgrid(*given, indexing="ij")) ** rng.uniform(0.9, 1.1, (2, *size))
    per_point = per_point.astype(given[0].dtype)
    reflection = Reflection(axis)
    vectors = reflection.symmetrise_parameters(*given)
    paired = np.asarray(vectors[axis])
    assert paired[0] == 0
    assert paired[-1] == 1
    assert (np.diff(paired) > 0).all()
    np.testing.assert_array_equal(paired, 1 - paired[::-1])
    np.testing.assert_allclose(paired, (given[axis] + 1 - given[axis][::-1]) / 2, atol=2 * eps())
    np.testing.assert_array_equal(vectors[1 - axis], given[1 - axis])
    arrays = reflection.symmetrise_parameters(*per_point)
    own = np.moveaxis(np.asarray(arrays[axis]), axis, 0)
    across = np.moveaxis(np.asarray(arrays[1 - axis]), axis, 0)
    np.testing.assert_array_equal(own, 1 - own[::-1])
    np.testing.assert_array_equal(across, across[::-1])
    values = reflection.symmetrise_values(per_point[0])
    np.testing.assert_array_equal(values, np.flip(values, axis))
    again = reflection.symmetrise_parameters(*arrays)
    for twice, once in zip(again, arrays, strict=True):
        np.testing.assert_array_equal(twice, once)


@pytest.mark.float32_too
@pytest.mark.parametrize("count", [7, 8, 11])
def test_knots_become_symmetric_to_the_bit(count):
    knots = random_clamped_knots(np.random.default_rng(0), count, 4, repeats=1)
    symmetric = np.asarray(Reflection().symmetrise_knots(knots))
    np.testing.assert_array_equal(symmetric, 1 - symmetric[::-1])
    np.testing.assert_allclose(symmetric, (knots + 1 - knots[::-1]) / 2, atol=2 * eps())
    assert (np.diff(symmetric) >= 0).all()
    np.testing.assert_array_equal(symmetric[:4], 0)
    np.testing.assert_array_equal(symmetric[-4:], 1)
    np.testing.assert_array_equal(Reflection().symmetrise_knots(symmetric), symmetric)


def test_knots_keep_the_ends_of_any_domain():
    knots = 0.1 + 3.3 * random_clamped_knots(np.random.default_rng(0), 8, 3)
    symmetric = np.asarray(Reflection().symmetrise_knots(knots))
    np.testing.assert_array_equal(symmetric[[0, 1, 2, -3, -2, -1]], knots[[0, 1, 2, -3, -2, -1]])
    np.testing.assert_allclose(symmetric + symmetric[::-1], knots[0] + knots[-1], rtol=1e-15)


def test_parameters_of_two_grids_get_a_sentence():
    for u, v in ((np.zeros(3), np.zeros((3, 2))), (np.zeros((3, 2)), np.zeros((2, 3)))):
        with pytest.raises(ValueError, match="parameters of one grid"):
            Reflection().symmetrise_parameters(u, v)


# ------------------------------------------------------------ transformations


def everything(grid):
    """A number that depends on every step of making a fit symmetric."""
    reflection = Reflection().located(grid)
    net = reflection.symmetrise_points(grid)
    u, v = reflection.symmetrise_parameters(*grid_parameters(net)[:2])
    knots = reflection.symmetrise_knots(averaging_knots(u, 4))
    numbers = (net**2, reflection.normal[0], reflection.asymmetry(grid), u**2, v**2, knots**2)
    return sum(jnp.sum(x) for x in numbers)


@pytest.fixture(scope="module")
def value_and_slope():
    return jax.jit(jax.value_and_grad(everything))


def test_everything_goes_through_jit_and_grad(value_and_slope):
    grid = jnp.asarray(hood(7, 5, noise=0.05)[0])
    value, slope = value_and_slope(grid)
    np.testing.assert_allclose(value, everything(grid), rtol=1e-12)
    way = jnp.asarray(np.random.default_rng(3).normal(size=grid.shape))
    step = 1e-6
    difference = (value_and_slope(grid + step * way)[0] - value_and_slope(grid - step * way)[0]) / (2 * step)
    np.testing.assert_allclose(jnp.sum(slope * way), difference, rtol=1e-6)


def test_gradients_are_finite_on_symmetric_and_on_degenerate_grids(value_and_slope):
    exact = hood(7, 5)[0]
    line = exact * np.array([1.0, 0.0, 0.0])  # two eigenvalues coincide
    for grid in (exact, line, np.zeros((7, 5, 3))):
        assert np.isfinite(value_and_slope(jnp.asarray(grid))[1]).all()


def test_a_batch_is_its_grids():
    grids = jnp.stack([jnp.asarray(hood(noise=0.05, seed=seed)[0]) for seed in range(3)])
    nets = jax.vmap(Reflection().symmetrise_points)(grids)
    for grid, net in zip(grids, nets, strict=True):
        np.testing.assert_allclose(net, Reflection().symmetrise_points(grid), atol=1e-14)


# -------------------------------------------------------------- zebra stripes


def symmetric_surface(n=7):
    """Symmetric about x = 0, with rows u paired."""
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(0, 1.5, 6), indexing="ij")
    grid = np.stack([x * (1 - 0.3 * y), y, 0.6 * np.cos(2 * x) * np.cos(y)], axis=-1)
    return BSplineSurface(grid, clamped_uniform(n, 4), clamped_uniform(6, 4))


def test_stripes_follow_the_law_of_reflection():
    surface = wavy_surface()
    u, v = np.random.default_rng(0).uniform(size=(2, 40))
    eye, axis = np.array([0.3, -0.2, 1.0]), np.array([1.0, 2.0, 0.5])
    values = zebra(surface, u, v, axis, 5, eye)
    eye, axis = eye / np.linalg.norm(eye), axis / np.linalg.norm(axis)
    normal = np.asarray(surface.normal(u, v))
    ray = 2 * (normal @ eye)[:, None] * normal - eye
    by_hand = 0.5 + 0.5 * np.cos(2 * 5 * np.arccos(ray @ axis))
    np.testing.assert_allclose(values, by_hand, atol=1e-12)
    assert (values >= 0).all()
    assert (values <= 1).all()
    assert np.ptp(values) > 0.9


@pytest.mark.float32_too
def test_a_grid_of_stripes_is_its_points():
    surface = wavy_surface()
    us, vs = np.linspace(0, 1, 9), np.linspace(0, 1, 8)
    grid = zebra_grid(surface, us, vs, stripes=3)
    u, v = (x.ravel() for x in np.meshgrid(us, vs, indexing="ij"))
    points = zebra(surface, u[:40], v[:40], stripes=3)
    np.testing.assert_allclose(grid.ravel()[:40], points, atol=1e3 * eps())


def test_a_plane_has_one_value():
    onto = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.3, -0.2, 0.0]])
    plane = wavy_surface().affine(onto)
    assert np.ptp(zebra_grid(plane, np.linspace(0, 1, 9), np.linspace(0, 1, 8))) < 1e-12


@pytest.mark.parametrize("direction", [(0, 1, 0.3), (1, 0, 0)])
def test_a_symmetric_surface_has_symmetric_stripes(direction):
    us, vs = np.linspace(0, 1, 9), np.linspace(0, 1, 8)
    values = zebra_grid(symmetric_surface(), us, vs, direction, 12, (0, 0.5, 1))
    np.testing.assert_allclose(values, values[::-1], atol=1e-11)
    assert np.ptp(values) > 0.9


def test_both_sides_and_ends_of_the_axis_are_alike():
    surface = wavy_surface()
    u, v = np.random.default_rng(0).uniform(size=(2, 40))
    values = zebra(surface, u, v, (1.0, 2.0, 0.0))
    # Run through backwards, u turns the normal round.
    other = BSplineSurface(surface.control_points[::-1], 1 - surface.knots_u[::-1], surface.knots_v)
    np.testing.assert_allclose(zebra(other, 1 - u, v, (-1.0, -2.0, 0.0)), values, atol=1e-12)


def test_stripes_go_through_jit_and_grad():
    surface = wavy_surface()
    flat = surface.affine(np.diag([1.0, 1.0, 0.0]))  # in which the ray is the axis
    gradient = jax.jit(jax.grad(lambda s: zebra(s, 0.3, 0.4, (0, 0, 1))))
    for slope in (gradient(surface), gradient(flat)):
        assert np.isfinite(slope.control_points).all()


def test_where_there_is_no_normal_there_is_no_stripe():
    line = wavy_surface().affine(np.diag([1.0, 0.0, 0.0]))
    assert np.isnan(zebra(line, *np.full((2, 40), 0.5))).all()


def test_impossible_stripes_get_a_sentence():
    surface = wavy_surface()
    with pytest.raises(ValueError, match="direction must not be zero"):
        zebra(surface, 0.5, 0.5, (0, 0, 0))
    with pytest.raises(ValueError, match="view must have 3 coordinates"):
        zebra(surface, 0.5, 0.5, view=(0, 1))
    with pytest.raises(ValueError, match="stripes must be a whole number"):
        zebra(surface, 0.5, 0.5, stripes=0)
    flat = surface.affine(np.eye(3)[:2])
    with pytest.raises(ValueError, match="three dimensions"):
        zebra(flat, 0.5, 0.5)
    with pytest.raises(ValueError, match="three dimensions"):
        zebra_grid(flat, np.zeros(2), np.zeros(2))


# ---------------------------------------------------------------- the picture


@pytest.fixture
def zebra_stripes(monkeypatch):
    pytest.importorskip("matplotlib")
    from jaxfit.plot import zebra_stripes

    monkeypatch.setattr("jaxfit.plot._render._PIXELS", 160)
    monkeypatch.setattr("jaxfit.plot._render._MOST", 200)  # one shape, compiled once
    return zebra_stripes


def test_stripes_of_two_surfaces_are_saved_side_by_side(tmp_path, zebra_stripes):
    path = tmp_path / "zebra.png"
    surfaces = [symmetric_surface(), wavy_surface()]
    figure = zebra_stripes(surfaces, path, captions=["symmetric", "wavy"], view=(0, 0.4, 1), title="both")
    assert path.stat().st_size > 10_000
    assert [file.name for file in tmp_path.iterdir()] == ["zebra.png"]
    assert [axes.get_title() for axes in figure.axes] == ["symmetric", "wavy"]
    image = np.asarray(figure.axes[0].images[0].get_array())
    seen = image[image[..., 3] > 0.99]
    assert seen[:, 0].min() < 0.1
    assert seen[:, 0].max() > 0.9
    level = image[..., 0] * image[..., 3]
    left, right = level, level[:, ::-1]
    assert np.mean(np.abs(left - right) > 0.3) < 0.06  # along the edges of the stripes only


def test_one_surface_needs_no_list_and_has_no_stripe_without_a_normal(zebra_stripes):
    figure = zebra_stripes(wavy_surface().affine(np.diag([1.0, 0.0, 0.0])), direction=(0, 1, 0))
    assert len(figure.axes) == 1
    image = np.asarray(figure.axes[0].images[0].get_array())
    red = image[image[..., 3] > 0.99]
    assert (red[:, 0] > red[:, 1] + 0.5).all()


def test_impossible_pictures_get_a_sentence(tmp_path, zebra_stripes):
    surface = wavy_surface()
    with pytest.raises(ValueError, match="at least one surface"):
        zebra_stripes([])
    with pytest.raises(ValueError, match="one for each of the 1 surfaces"):
        zebra_stripes([surface], captions=["a", "b"])
    with pytest.raises(ValueError, match="three dimensions"):
        zebra_stripes([surface.affine(np.eye(3)[:2])], tmp_path / "no.png")
    with pytest.raises(ValueError, match="view must have 3"):
        zebra_stripes(surface, view=(1, 0))
    assert not list(tmp_path.iterdir())
