"""The same work by other programs, on the same arrays: grids, least squares, closest points.

SciPy and splipy get the parameters and knots that jaxfit chose, for nothing; ours include making them, the
checks and the errors. splinepy, geomdl and Open CASCADE choose their own. A peer that is not installed is
named. interpax is none: it interpolates values at query points and makes no surface.
"""

import importlib

import numpy as np
import scipy.sparse
from scipy.interpolate import NdBSpline, make_interp_spline
from scipy.sparse.linalg import splu

import jaxfit as jf
from benchmarks import _inputs
from benchmarks._referee import distances, judged
from benchmarks._timing import in_turns

ALL_PEERS = 'pip install splinepy splipy pygismo geomdl cvxopt ".[cad]"'
MOST_GEOMDL = 2_000  # points: it takes seconds for more
CASES = ((3_000, 11, 15), (11_500, 42, 42), (100_000, 62, 57))


def installed(report, *names):
    """The modules, or None after saying which one is missing."""
    try:
        return [importlib.import_module(name) for name in names]
    except ImportError:
        report.remark(f"{names[0].partition('.')[0]} is not installed: left out ({ALL_PEERS} brings all)")
        return None


def ratios(report, done, cells, **first):
    """A row for each program, with its time as a multiple of ours."""
    for name, found in done.items():
        ratio = found.median / done["jaxfit"].median
        report.row(**first, program=name, **cells(found.result), **found.cells(), times_ours=ratio)


# ------------------------------------------------------------------ grids


def grids(report, options):
    """Bicubic surfaces through grids."""
    note = "Errors by the referee, in % of the diagonal; each program's own surface."
    report.table("Interpolation of grids", note)
    for grid in _inputs.grids(options.stand_ins):
        if options.quick and grid.role != "hood":
            continue
        works = {"jaxfit": lambda grid=grid: _ours(grid.points)}
        works |= _given_parameters(report, grid.points) | _own_parameters(report, grid.points)
        if grid.points.shape[0] * grid.points.shape[1] > MOST_GEOMDL:
            works.pop("geomdl", None)
            report.remark(f"geomdl is left out of {grid.role}: it takes seconds to minutes")
        done = in_turns(works, options.runs)
        ratios(report, done, lambda x, at=grid.points: judged(*x, at), model=f"{grid.role} ({grid.source})")


def _ours(grid):
    surface = jf.interpolate(grid, jf.StandardInterpolation()).surface
    return np.asarray(surface.control_points), (np.asarray(surface.knots_u), np.asarray(surface.knots_v))


def _given_parameters(report, grid):
    fit = jf.interpolate(grid, jf.StandardInterpolation())
    u, v = np.asarray(fit.u[:, 0]), np.asarray(fit.v[0])
    knots = np.asarray(fit.surface.knots_u), np.asarray(fit.surface.knots_v)

    def scipys():
        half = make_interp_spline(u, grid, 3, t=knots[0]).c
        return make_interp_spline(v, half, 3, t=knots[1], axis=1).c.swapaxes(0, 1), knots

    works = {"SciPy, two passes": scipys}
    if found := installed(report, "splipy", "splipy.surface_factory"):
        splipy, factory = found

        def splipys():
            bases = [splipy.BSplineBasis(4, k) for k in knots]
            return factory.interpolate(grid, bases, [u, v]).controlpoints, knots

        works["splipy"] = splipys
    return works


def _own_parameters(report, grid):
    n, m = grid.shape[:2]
    works = {}
    if fit := installed(report, "splinepy.helpme.fit"):

        def splinepys():
            flat = grid.swapaxes(0, 1).reshape(-1, 3)  # its first index runs fastest
            spline, _ = fit[0].surface(flat, (n, m), (3, 3), (n, m), centripetal=False)
            net = np.asarray(spline.control_points).reshape(m, n, 3).swapaxes(0, 1)
            return net, tuple(np.asarray(k) for k in spline.knot_vectors)

        works["splinepy"] = splinepys
    if geomdl := installed(report, "geomdl.fitting"):

        def geomdls():
            surface = geomdl[0].interpolate_surface(grid.reshape(-1, 3).tolist(), n, m, 3, 3)
            net = np.asarray(surface.ctrlpts).reshape(n, m, 3)
            return net, (np.asarray(surface.knotvector_u), np.asarray(surface.knotvector_v))

        works["geomdl"] = geomdls
    if modules := installed(report, "OCP.GeomAPI", "OCP.collections", "OCP.gp"):
        works["Open CASCADE"] = lambda: _open_cascade(*modules, grid)
    return works


def _open_cascade(api, collections, gp, grid):
    n, m = grid.shape[:2]
    array = collections.Array2_gp_Pnt(1, n, 1, m)
    for i, j in np.ndindex(n, m):
        array.SetValue(i + 1, j + 1, gp.gp_Pnt(*map(float, grid[i, j])))
    maker = api.GeomAPI_PointsToBSplineSurface()
    maker.Interpolate(array)
    surface = maker.Surface()
    shape = surface.NbUPoles(), surface.NbVPoles()
    poles = [surface.Pole(i + 1, j + 1) for i, j in np.ndindex(*shape)]
    net = np.array([(p.X(), p.Y(), p.Z()) for p in poles]).reshape(*shape, 3)
    knots = []
    for side in "UV":
        values = [getattr(surface, f"{side}Knot"), getattr(surface, f"{side}Multiplicity")]
        count = getattr(surface, f"Nb{side}Knots")()
        knots.append(np.repeat(*([x(k + 1) for k in range(count)] for x in values)))
    return net, tuple(knots)


# ----------------------------------------------------------- least squares


def least_squares(report, options):
    """One solve with given parameters, all control points free."""
    note = "Points, parameters and knots in, control points out. Errors by the referee."
    report.table("Least squares at given parameters", note)
    solve, name = _cholesky()
    if name == "splu":
        report.remark("neither scikit-sparse nor cvxopt is installed: SciPy's splu stands in for CHOLMOD")
    for count, nu, nv in CASES[: 1 if options.quick else None]:
        u, v = np.random.default_rng(0).random((2, count))
        points = np.stack([u, v, 0.2 * np.sin(9 * u) * np.cos(7 * v) + 0.02 * np.sin(60 * u * v)], axis=-1)
        knots = tuple(np.asarray(jf.clamped_uniform_knots(n, 4)) for n in (nu, nv))
        works = {
            "jaxfit": lambda a=(knots, u, v, points): _our_solve(*a),
            f"SciPy + {name}": lambda a=(knots, (nu, nv), u, v, points): _sparse_solve(solve, *a),
        }
        if gismo := installed(report, "pygismo"):
            works["G+Smo (pygismo)"] = lambda a=(gismo[0], knots, u, v, points): _gismo_solve(*a)
        done = in_turns(works, options.runs)
        nets = [x.result for x in done.values()]
        apart = max(np.abs(net - nets[0]).max() for net in nets) / _inputs.diagonal(points)
        cells = lambda net, k=knots, p=points: judged(net, k, p)  # noqa: E731
        ratios(report, done, cells, points=f"{count}", net=f"{nu}x{nv}")
        report.remark(f"largest difference of a control point: {apart:.1e} of the diagonal")


def _our_solve(knots, u, v, points):
    at = (np.asarray(jf.greville_abscissae(k, 4)) for k in knots)
    net = np.stack([*np.meshgrid(*at, indexing="ij"), np.zeros([len(k) - 4 for k in knots])], axis=-1)
    method = jf.StandardApproximation(0.0, parameter_correction=False, border=jf.FreeBorder())
    options = dict(start=(u, v), tol_average=0.0, max_steps=1, errors=jf.AtParameters())
    return np.asarray(
        jf.approximate(points, jf.BSplineSurface(net, *knots), method, **options).surface.control_points
    )


def _sparse_solve(solve, knots, shape, u, v, points):
    a = NdBSpline.design_matrix(np.stack([u, v], axis=-1), knots, 3)
    return solve((a.T @ a).tocsc(), a.T @ points).reshape(*shape, 3)


def _gismo_solve(gismo, knots, u, v, points):
    bases = (gismo.nurbs.gsKnotVector(k.tolist(), 3) for k in knots)
    basis = gismo.nurbs.gsTensorBSplineBasis2(*bases)
    fit = gismo.modelling.gsFitting(np.stack([u, v]), np.ascontiguousarray(points.T), basis)
    fit.compute(0.0)
    surface = fit.result()  # lives as long as its coefficients are read; its first index runs fastest
    net = np.array(surface.coefs())
    return net.reshape(*(len(k) - 4 for k in reversed(knots)), 3).swapaxes(0, 1)


def _cholesky():
    try:
        from sksparse.cholmod import cholesky

        return (lambda matrix, right: cholesky(matrix)(right)), "CHOLMOD (scikit-sparse)"
    except ImportError:
        pass
    try:
        import cvxopt
        import cvxopt.cholmod
    except ImportError:
        return (lambda matrix, right: splu(matrix).solve(right)), "splu"

    def solve(matrix, right):
        lower = scipy.sparse.tril(matrix).tocoo()
        sparse = cvxopt.spmatrix(lower.data, lower.row.astype(int), lower.col.astype(int), matrix.shape)
        unknown = cvxopt.matrix(right)
        cvxopt.cholmod.linsolve(sparse, unknown)
        return np.array(unknown)

    return solve, "CHOLMOD (cvxopt)"


# ---------------------------------------------------------- closest points


def closest_points(report, options):
    """Closest points with no start known; `wrong` ones are farther than the referee's by 1e-6 of the size."""
    report.table("Closest points, no start given", "Points 1-5 % of the diagonal off a wavy 42 x 42 surface.")
    knots = np.asarray(jf.clamped_uniform_knots(42, 4))
    x, y = np.meshgrid(np.linspace(0, 1, 42), np.linspace(0, 1, 42), indexing="ij")
    net = np.stack([x, y, 0.1 * np.sin(5 * x + 1) * np.cos(4 * y) + 0.05 * x * y], axis=-1)
    surface = jf.BSplineSurface(net, knots, knots)
    rng = np.random.default_rng(0)
    u, v, high = rng.uniform(size=(3, 500 if options.quick else 5_000))
    away = (np.sign(high - 0.5) * (0.01 + 0.08 * np.abs(high - 0.5)) * 1.4)[:, None]
    points = np.asarray(surface(u, v)) + away * np.asarray(surface.normal(u, v))
    works = {"jaxfit": lambda: np.asarray(jf.closest_point(surface, points).distance)}
    if splinepy := installed(report, "splinepy"):
        spline = splinepy[0].BSpline([3, 3], [knots, knots], net.swapaxes(0, 1).reshape(-1, 3))
        works["splinepy"] = lambda: _splinepy_distances(spline, points)
    if modules := installed(report, "OCP.GeomAPI", "OCP.gp", "OCP.collections", "OCP.Geom"):
        works["Open CASCADE"] = lambda: _open_cascade_distances(modules, net, knots, points[:500])
        report.remark("Open CASCADE gets 500 points only")
    done = in_turns(works, min(options.runs, 3))
    expected = np.minimum(distances(net, (knots, knots), points), done["jaxfit"].result)
    for name, found in done.items():
        count = len(found.result)
        wrong = int(np.sum(found.result - expected[:count] > 1e-6))
        per_point = 1e6 * found.median / count
        report.row(program=name, points=count, wrong=wrong, us_a_point=per_point, **found.cells())


def _splinepy_distances(spline, points):
    return np.asarray(spline.proximities(points, return_verbose=True)[3]).ravel()


def _open_cascade_distances(modules, net, knots, points):
    api, gp, collections, geom = modules
    shape = net.shape[:2]
    poles = collections.Array2_gp_Pnt(1, shape[0], 1, shape[1])
    for i, j in np.ndindex(*shape):
        poles.SetValue(i + 1, j + 1, gp.gp_Pnt(*map(float, net[i, j])))
    values, counts = np.unique(knots, return_counts=True)
    reals, integers = (
        collections.Array1_double(1, len(values)),
        collections.Array1_int(1, len(values)),
    )
    for k, (value, count) in enumerate(zip(values, counts, strict=True)):
        reals.SetValue(k + 1, float(value))
        integers.SetValue(k + 1, int(count))
    surface = geom.Geom_BSplineSurface(poles, reals, reals, integers, integers, 3, 3)
    found = (api.GeomAPI_ProjectPointOnSurf(gp.gp_Pnt(*map(float, p)), surface) for p in points)
    return np.array([x.LowerDistance() if x.NbPoints() else np.inf for x in found])


PARTS = {"grids": grids, "least_squares": least_squares, "closest_points": closest_points}
