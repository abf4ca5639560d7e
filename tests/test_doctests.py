"""Every public name has an example in its docstring, and the example is true."""

import doctest
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_docstrings import public_names

import jaxfit as jf

PUBLIC = dict(public_names())
ROOMS = sorted({value.__module__.split(".")[1] for value in PUBLIC.values()})


def examples(name, value):
    """The doctests of a public name and, if it is a class, of its public methods."""
    documented = {name: value}
    if inspect.isclass(value):
        documented |= {f"{name}.{key}": x for key, x in vars(value).items() if not key.startswith("_")}
    for each, x in documented.items():
        names = {"jf": jf, "np": np, "jax": jax, "jnp": jnp}
        text = inspect.getdoc(x) or ""
        test = doctest.DocTestParser().get_doctest(text, names, each, value.__module__, None)
        if test.examples and "builtins" not in str(getattr(x, "__module__", "")):
            yield test


@pytest.mark.parametrize("room", ROOMS)
def test_examples_are_true(room, monkeypatch):
    if room == "plot":  # whose examples say nothing about the resolution
        monkeypatch.setattr("jaxfit.plot._render._PIXELS", 400)
    names = [name for name, value in PUBLIC.items() if value.__module__.split(".")[1] == room]
    without = []
    for name in names:
        tests = list(examples(name, PUBLIC[name]))
        if not any(test.name == name for test in tests):
            without.append(name)
        for test in tests:
            report = []
            doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=report.append)
            assert not report, "".join(report)
    assert not without
