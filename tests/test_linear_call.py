"""Linear functions with programs of their own are differentiated, batched and traced like any others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import count_compilations

from jaxfit._linear_call import linear_call, transpose_ahead

MATRIX = np.arange(12.0).reshape(3, 4)
KNOWN = {"matrix": MATRIX, "factor": np.asarray(2.0)}
X = {"vector": np.arange(4.0), "number": np.asarray(5.0)}
LIKE = (np.zeros(3), np.zeros(()))


def product(known, x):
    return known["factor"] * (known["matrix"] @ x["vector"]), 3.0 * x["number"] + jnp.sum(x["vector"])


def called(x):
    return linear_call(product, KNOWN, x, LIKE)


def size(x, y):
    along, number = y(x)
    return jnp.sum(jnp.sin(along)) * number


TRANSFORMS = {
    "call": lambda f: f(X),
    "jvp": lambda f: jax.jvp(f, (X,), (X,)),
    "grad": lambda f: jax.grad(size)(X, f),
    "gradient inside jit": lambda f: jax.jit(jax.grad(lambda x: size(x, f)))(X),
    "transpose inside jit": lambda f: jax.jit(jax.vjp(f, X)[1])(f(X)),
    "jacrev": lambda f: jax.jacrev(f)(X),
    "jacfwd": lambda f: jax.jacfwd(f)(X),
    "hessian": lambda f: jax.hessian(lambda x: size(x, f))(X),
    "vmap": lambda f: jax.vmap(f)(jax.tree.map(lambda x: jnp.stack([x, 2 * x]), X)),
    "gradients of a part": lambda f: jax.grad(lambda number: size({**X, "number": number}, f))(X["number"]),
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_it_is_what_the_function_is(name):
    found, expected = TRANSFORMS[name](called), TRANSFORMS[name](lambda x: product(KNOWN, x))
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert np.allclose(x, y, rtol=1e-14)


def test_what_is_known_may_be_traced():
    found = jax.jit(lambda known: linear_call(product, known, X, LIKE))(KNOWN)
    assert np.allclose(found[0], product(KNOWN, X)[0])


def test_the_transpose_is_compiled_once_and_ahead():
    def other(known, x):
        return product(known, x)

    with count_compilations() as ahead:
        transpose_ahead(other, KNOWN, X, LIKE)
        jax.grad(lambda x: linear_call(other, KNOWN, x, LIKE)[1])(X)
    assert ahead.names.count("jit(_program)") == 2  # forward, too
