"""What a public name owes its reader: `python tests/test_docstrings.py` lists the names that lack some of it.

Every name owes a docstring, a runnable example (`test_doctests.py` runs it) and a word on each argument;
arguments and results that are arrays owe their shape. Who checks arguments owes "Raises". Who writes
mathematics owes its source: an equation or section of the paper, a book, an article, or that there is none.
Exceptions and enumerations owe an example only.
"""

import ast
import enum
import inspect
import re
import sys
import textwrap

import equinox as eqx

import jaxfit as jf
import jaxfit.io
import jaxfit.plot

SECTION = re.compile(r"^(\w+)\n-{3,}\n", re.MULTILINE)
ENTRY = re.compile(r"^(\*{0,2}\w+(?:, \*{0,2}\w+)*)(?: : (.*))?$", re.MULTILINE)
SHAPE = re.compile(r"arrays? \(|shape|^(float|int|function)\b")
SOURCE = re.compile(
    r"\bpapers?\b|[Ee]quations? \(|[Ss]ection \d|NURBS Book|Source: |\b(19|20)\d\d\b|Algorithm 1|Box I"
)
MATHEMATICS = re.compile(r"\$.+\$|\.\. math::", re.DOTALL)
NOT_MARKDOWN = re.compile(r"^={3,} +=|^\.\. \w+::", re.MULTILINE)  # the site shows them raw
CONSTRUCTION = ("__init__", "__check_init__", "__post_init__", "__new__")


def public_names():
    """The public names of the three public modules, and their values."""
    for module in (jf, jaxfit.io, jaxfit.plot):
        for name, value in vars(module).items():
            if not name.startswith("_") and getattr(value, "__module__", "").startswith("jaxfit"):
                yield f"{module.__name__}.{name}", value


def sections(text):
    """The sections of a docstring in NumPy's style, by their titles; the text before them has none."""
    parts = SECTION.split(text)
    return {"": parts[0]} | dict(zip(parts[1::2], parts[2::2], strict=True))


def entries(section):
    """What a section of arguments says of each: the type on its line, and the text below."""
    parts = ENTRY.split(section)
    return {
        name.strip("*"): f"{kind or ''}\n{text}"
        for names, kind, text in zip(parts[1::3], parts[2::3], parts[3::3], strict=True)
        for name in names.split(", ")
    }


def joined(section, arguments):
    """Names that share an entry but no default: the site shows the default of the first for all of them."""
    for names in ENTRY.split(section)[1::3]:
        named = [arguments[name] for name in names.split(", ") if name in arguments]
        if len({(x.kind is x.VAR_KEYWORD, repr(x.default)) for x in named}) > 1:
            yield names


def checks_arguments(value):
    """Whether the function, or the making of the object, raises or calls a check."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(value))).body
    made = [x for x in definition.body if getattr(x, "name", None) in CONSTRUCTION]
    nodes = [x for maker in (made if inspect.isclass(value) else [definition]) for x in ast.walk(maker)]
    called = [ast.unparse(x.func).split(".")[-1] for x in nodes if isinstance(x, ast.Call)]
    return any(isinstance(x, ast.Raise) and x.exc for x in nodes) or any("check" in x for x in called)


def is_plain(value):
    """Whether a name is an exception or an enumeration."""
    kinds = (BaseException, enum.Enum, eqx.Enumeration)
    return inspect.isclass(value) and issubclass(value, kinds)


def lacks(value):
    """What the docstring of a public name lacks, in words."""
    text = inspect.getdoc(value) or ""
    parts = sections(text)
    if not text:
        yield "docstring"
    if NOT_MARKDOWN.search(text):
        yield "Markdown"
    if ">>>" not in parts.get("Examples", ""):
        yield "example"
    if is_plain(value):
        return
    told = {}
    for title in ("Parameters", "Attributes", "Returns"):
        told |= entries(parts.get(title, ""))
    arguments = inspect.signature(value).parameters
    yield from (f"word on {x}" for x in arguments if x not in told)
    if not inspect.isclass(value):
        yield from (f"entries of their own for {x}" for x in joined(parts.get("Parameters", ""), arguments))
    kinds = {name: words.splitlines()[0] for name, words in told.items() if "As for" not in words}
    arrays = {x.name for x in arguments.values() if "Array" in str(x.annotation)} | {
        name for name, kind in kinds.items() if "array" in kind
    }
    yield from (f"shape of {x}" for x in sorted(arrays & set(kinds)) if not SHAPE.search(kinds[x]))
    if checks_arguments(value) and "Raises" not in parts:
        yield "raises"
    if MATHEMATICS.search(text) and not SOURCE.search(text):
        yield "source"


def shortcomings():
    """One line for each public name that lacks something."""
    found = {name: list(lacks(value)) for name, value in public_names()}
    return [f"{name}: {', '.join(missing)}" for name, missing in found.items() if missing]


def test_public_names_have_shapes_raises_source_and_example():
    assert shortcomings() == []


if __name__ == "__main__":
    sys.stdout.writelines(f"{line}\n" for line in shortcomings())
