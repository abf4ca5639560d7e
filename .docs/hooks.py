"""What the site takes from elsewhere: README, results, notebooks, docstrings; and its formulas."""

import html
import re
from pathlib import Path

import nbformat
from latex2mathml.converter import convert
from mkdocs.structure.files import File

import jaxfit
import jaxfit.io
import jaxfit.plot

TOP = Path(__file__).resolve().parent.parent
COPIED = ("README.md", "LICENSE", "notebooks/*.png", "benchmarks/*.md", "benchmarks/results/*.*")

# Every room with public names stands on one page, or the build ends with a KeyError.
PAGES = {
    "clouds": "_approximation _streams _batch",
    "grids": "_interpolation _parameters",
    "base_surfaces": "_base",
    "results_and_methods": "_fit",
    "surfaces_and_curves": "_splines _trimmed",
    "closest_points_and_quality": "_closest _quality _normal_equations",
    "files": "io _program_folder",
    "pictures": "plot",
}
PAGE_OF = {room: page for page, rooms in PAGES.items() for room in rooms.split()}

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files, config):
    """Add the pages that are not in the folder of pages."""
    for pattern in COPIED:
        for path in sorted(TOP.glob(pattern)):
            name = path.relative_to(TOP).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(path)))
    for path in sorted(TOP.glob("notebooks/*.ipynb")):
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=notebook_page(path)))
    for page, text in reference_pages().items():
        files.append(File.generated(config, f"reference/{page}.md", content=text))
    return files


def on_page_markdown(markdown, **_):
    """Links as they are here, where notebooks are pages."""
    return markdown.replace(".ipynb)", ".md)").replace("](.docs/pages/", "](")


def on_page_content(content, **_):
    """Formulas as MathML, which browsers draw by themselves."""

    def drawn(found):
        display = "block" if found[1] == "div" else "inline"
        formula = convert(html.unescape(found[2]), display=display)
        if "\\" in formula:
            raise ValueError(f"a formula has a command that cannot be drawn: {found[2]}")
        return formula

    return FORMULA.sub(drawn, content)


def reference_pages():
    """One page for each group of rooms: its public names, functions first."""
    names = {page: [] for page in PAGES}
    for module in (jaxfit, jaxfit.io, jaxfit.plot):
        for name, value in vars(module).items():
            if not name.startswith("_") and getattr(value, "__module__", "").startswith("jaxfit."):
                page = PAGE_OF[value.__module__.split(".")[1]]
                names[page].append((isinstance(value, type), f"{module.__name__}.{name}"))
    return {page: reference_page(page, sorted(found)) for page, found in names.items()}


def reference_page(page, names):
    """A heading, and the docstrings of the names."""
    title = page.replace("_", " ").capitalize()
    return f"# {title}\n\n" + "\n\n".join(f"::: {name}" for _, name in names) + "\n"


def notebook_page(path):
    """A notebook with its stored outputs as Markdown."""
    parts = []
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        parts += [part for output in cell.outputs for part in output_of(output)]
    return "\n\n".join(parts) + "\n"


def output_of(output):
    """The pictures or the text of one output."""
    data = output.get("data", {})
    pictures = [kind for kind in data if kind.startswith("image/")]
    yield from (f"![output](data:{kind};base64,{data[kind].strip()})" for kind in pictures)
    text = output.get("text", "" if pictures else data.get("text/plain", ""))
    if text.strip():
        yield f"```text\n{text.rstrip()}\n```"
