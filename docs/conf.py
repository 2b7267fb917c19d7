"""Builds the documentation as a site: sphinx-build -W -c docs . output/docs

The source is the whole checkout, so that links between README, docs and notebooks are the same here
and there. Pages of `docs/api` are written before each build, from the packages; the order of the
pages is that of the links in `docs/index.md`.
"""

import argparse
import ast
import dataclasses as dc
import importlib
import importlib.metadata
import inspect
import itertools
import pydoc
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat

# Before torch is mocked, which it asks about while it loads.
import scipy.stats  # noqa: F401
from myst_parser.parsers.sphinx_ import MystParser
from sphinx.application import Sphinx
from sphinx.ext.autodoc.mock import mock
from sphinx.util import logging

from sliceit_drake.cli.main import make_parser

ROOT = Path(__file__).resolve().parent.parent
API = ROOT / "docs" / "api"

project = "sliceit_drake"
author = "the authors of sliceit_drake"
release = importlib.metadata.version(project)

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = [
    "*.md",
    "docs/*.md",
    "docs/*/*.md",
    "docs/api/*",
    "notebooks/*",
    "calibration/*/README.md",
    "models/*/README.md",
]
exclude_patterns = [".*", "**/.*", "output"]
# "html_image": a picture of the given width, in a table.
myst_enable_extensions = ["dollarmath", "html_image"]
myst_heading_anchors = 3
# A single backtick in a docstring is code, as in Markdown.
default_role = "code"
highlight_language = "text"
# The contents of a page name its modules, not each of their names.
toc_object_entries = False

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
# Of the extra "learn": large, and what they would document is ours.
autodoc_mock_imports = ["gymnasium", "onnx", "stable_baselines3", "torch", "torchrl"]
# A type's name that several modules have.
suppress_warnings = ["ref.python"]
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
napoleon_custom_sections = [
    (title, "params_style")
    for title in ("Input port", "Input ports", "Output ports", "Further output port")
    + ("Further output ports", "Inputs", "Outputs")
]

html_theme = "furo"
html_title = project
html_show_sourcelink = False
html_copy_source = False


class NotebookParser(MystParser):
    """Shows a notebook as it is stored, with its outputs."""

    supported = ("notebook",)

    def parse(self, inputstring: str, document) -> None:
        parts = []
        for cell in nbformat.reads(inputstring, as_version=4).cells:
            language = "text" if cell.source.startswith("%%") else "python"
            code = f"```{language}\n{cell.source}\n```"
            parts.append(cell.source if cell.cell_type == "markdown" else code)
            for output in cell.get("outputs", []):
                data = output.get("data", {})
                if "image/png" in data:
                    image = data["image/png"].replace("\n", "")
                    parts.append(f"![What the code above draws](data:image/png;base64,{image})")
                elif text := output.get("text") or data.get("text/plain"):
                    parts.append(f"```text\n{text.rstrip()}\n```")
        super().parse("\n\n".join(parts), document)


# --- Pages that are written.


def packages() -> list[str]:
    """Every folder of modules but that of the program, which has a page of its own."""
    folders = sorted({file.parent for file in (ROOT / project).rglob("*.py")})
    names = [".".join(folder.relative_to(ROOT).parts) for folder in folders]
    return [name for name in names if name != f"{project}.cli"]


def modules(package: str) -> list[str]:
    files = sorted((ROOT / package.replace(".", "/")).glob("*.py"))
    return [f"{package}.{file.stem}" for file in files if file.stem != "__init__"]


EXTENSION_POINTS = (
    "ControllerSystem",
    "KnifeForceSystem",
    "PolicyAction",
    "PolicySystem",
    "MotionSource",
    "Cause",
)
"""What a user subclasses, or gives and connects in place of ours."""
GROUPS = {
    "Simulate a slice": ("diagrams", "configuration", "resources"),
    "Foods, knives, cuts without a robot": ("cutting",),
    "Systems and policies": ("systems",),
    "Records": ("records",),
    "Calibration": ("calibration",),
    "Diagnosis": ("diagnosis",),
    "Learning": ("learning",),
    "Robot": ("hardware", "robot_run", "emulator"),
}
"""Names of the front door by the folder that they come from."""


def names_of(package: str) -> dict[str, Any]:
    """Each name that a package has beside its modules, and what it is."""
    with mock(autodoc_mock_imports):
        module = importlib.import_module(package)
        return {name: getattr(module, name) for name in getattr(module, "__all__", ())}


def front_door() -> list[str]:
    """The names of `import sliceit_drake as sliceit`: a line for each, then each in full."""
    groups: dict[str, list[str]] = {title: [] for title in [*GROUPS, "Extension points", "Modules"]}
    in_full = ["In full", "-------", ""]
    for name, found in names_of(project).items():
        words = escape((inspect.getdoc(found) or "").partition("\n\n")[0].replace("\n", " "))
        if inspect.ismodule(found):
            groups["Modules"] += [f"- :py:mod:`{name} <{found.__name__}>`: {words}"]
            continue
        folder = found.__module__.split(".")[1]
        (title,) = (title for title, folders in GROUPS.items() if folder in folders)
        kind = "autoclass" if inspect.isclass(found) else "autofunction"
        title = "Extension points" if name in EXTENSION_POINTS else title
        groups[title] += [f"- :py:obj:`{name} <{project}.{name}>`: {words}"]
        in_full += [f".. {kind}:: {project}.{name}", ""]
    lines = []
    for title, entries in groups.items():
        lines += [title, "-" * len(title), "", *entries, ""]
    return [*lines, *in_full]


def further_names(package: str) -> list[str]:
    """The names that a package of the front door has itself, with links to where they are."""
    name = package.removeprefix(f"{project}.")
    if name not in names_of(project):
        return []
    lines = [f"``sliceit.{name}`` has", ""]
    for name, found in names_of(package).items():
        is_module = inspect.ismodule(found)
        path = found.__name__ if is_module else f"{found.__module__}.{name}"
        lines += [f"- ``{name}``: :py:{'mod' if is_module else 'obj'}:`{path}`"]
    return [*lines, ""]


def package_page(package: str) -> str:
    """The docstring of a package, then each of its modules with the names of its `__all__`."""
    title = "The names of sliceit_drake" if package == project else package
    lines = [title, "=" * len(title), "", f".. automodule:: {package}", "   :no-members:", ""]
    lines += front_door() if package == project else further_names(package)
    for module in modules(package):
        title = module.removeprefix(f"{package}.")
        lines += [title, "-" * len(title), "", f".. automodule:: {module}", ""]
        for name, words in constants(module):
            lines += [f".. py:data:: {name}", f"   :module: {module}", "", f"   {words}", ""]
    return "\n".join(lines)


def constants(module: str) -> Iterator[tuple[str, str]]:
    """Public constants and kernels that automodule passes over, and what is said of them.

    Those are the ones with a comment before them, or nothing, in place of a docstring after them.
    """
    text = (ROOT / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8")
    body, lines = ast.parse(text).body, text.splitlines()
    with mock(autodoc_mock_imports):
        found = importlib.import_module(module)
    # A class by assignment, such as an enumeration made by a call, is shown as a class.
    public = {name for name in found.__all__ if not inspect.isclass(getattr(found, name))}
    for node, following in itertools.pairwise([*body, ast.Pass()]):
        if isinstance(node, ast.FunctionDef):
            kernel = any(
                ast.unparse(d).startswith(("wp.kernel", "wp.func")) for d in node.decorator_list
            )
            names = [node.name] if kernel else []
            words = (ast.get_docstring(node) or "").partition("\n\n")[0].replace("\n", " ")
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            names = [n.id for n in ast.walk(target) if isinstance(n, ast.Name)]
            before = itertools.takewhile(
                lambda line: line.startswith("# "), reversed(lines[: node.lineno - 1])
            )
            words = " ".join(line[2:] for line in reversed(list(before)))
        else:
            continue
        if not (isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)):
            yield from ((name, escape(words)) for name in names if name in public)


def command_page() -> str:
    """The help of each command."""
    lines = ["# The program sliceit", ""]

    def add(parser: argparse.ArgumentParser, level: int) -> None:
        lines.extend([f"{'#' * level} {parser.prog}", ""])
        lines.extend(["```text", parser.format_help().rstrip(), "```", ""])
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for nested in action.choices.values():
                    add(nested, min(level + 1, 3))

    add(make_parser(), 2)
    return "\n".join(lines)


def write_api(app: Sphinx) -> None:
    """Writes `docs/api`; what is the same stays, so that it is not built again."""
    pages = {f"{package}.rst": package_page(package) for package in packages()}
    pages["commands.md"] = command_page()
    API.mkdir(exist_ok=True)
    for file in API.iterdir():
        if file.name not in pages:
            file.unlink()
    for name, text in pages.items():
        file = API / name
        if not file.exists() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")


def order_pages(app: Sphinx, docname: str, content: list[str]) -> None:
    """Gives each section of the index a table of contents, of what it links to.

    The pages that are written here join it: names and commands head the reference, and the
    modules come last.
    """
    if docname != root_doc:
        return
    first_pages = f"""## Reference

- [The names of `import sliceit_drake`](api/{project}.rst): a line for each, then each in full.
- [The program `sliceit`](api/commands.md): the help of each command."""
    modules = [f"- [{p}](api/{p}.rst)\n" for p in packages() if p != project]
    text = content[0].replace("## Reference\n", first_pages)
    text = f"{text}\n## API by module\n\n{''.join(modules)}"
    first, *sections = re.split(r"^(?=## )", text, flags=re.M)
    for k, section in enumerate(sections):
        title = section.partition("\n")[0].removeprefix("## ")
        links = re.findall(r"\]\(([^)#:]+)\.(?:md|rst|ipynb)\)", section)
        # Two pages have the project's name as their title.
        links = [{"../README": "README <../README>"}.get(link, link) for link in links]
        table = "\n".join([":hidden:", f":caption: {title}", "", *dict.fromkeys(links)])
        sections[k] = f"{section}\n```{{toctree}}\n{table}\n```\n\n"
    content[0] = "".join([first, *sections])


def open_at_the_index(app: Sphinx, exception: Exception | None) -> None:
    """Lets the folder be opened as a site: its first page leads to the index."""
    if exception is None and app.builder.format == "html":
        to = f'<meta http-equiv="refresh" content="0; url={root_doc}.html">'
        (Path(app.outdir) / "index.html").write_text(f"<!doctype html>{to}\n", encoding="utf-8")


def check_names(app: Sphinx, env) -> None:
    """Warns of a public name that no page has."""
    shown = env.get_domain("py").objects
    for name, found in names_of(project).items():
        if not inspect.ismodule(found) and f"{project}.{name}" not in shown:
            logging.getLogger(__name__).warning("%s is on no page", name)
    for package in packages():
        for module in modules(package):
            with mock(autodoc_mock_imports):
                names = importlib.import_module(module).__all__
            for name in names:
                if f"{module}.{name}" not in shown:
                    logging.getLogger(__name__).warning("%s.%s is on no page", module, name)


# --- Docstrings.


def add_limits(app, what: str, name: str, obj, options, lines: list[str]) -> None:
    """Adds to what a field of a configuration says of itself its unit and range."""
    owner, _, field_name = name.rpartition(".")
    if what != "attribute" or not dc.is_dataclass(configuration := pydoc.locate(owner)):
        return
    for field in dc.fields(configuration):
        rule = field.metadata.get(project)
        if rule is not None and field.name == field_name:
            lines[:] = [f"{' '.join(lines).rstrip()} {limits(rule)}".rstrip(), ""]


def limits(rule) -> str:
    """Unit and range of a quantity, values of a choice."""
    options = getattr(rule, "options", None)
    if options is not None:
        return f"One of {', '.join(options)}."
    ends = [
        f"at {end} {x:g}" for end, x in (("least", rule.low), ("most", rule.high)) if x is not None
    ]
    text = ", ".join(([rule.unit] if rule.unit else []) + ends)
    return f"({text})" if text else ""


def as_markdown(app, what: str, name: str, obj, options, lines: list[str]) -> None:
    """Reads a docstring as it is meant: indented blocks are literal, `|` and `*` themselves."""
    out: list[str] = []
    last, literal = 0, None
    for line in lines:
        indent = len(line) - len(line.lstrip())
        if line.strip():
            if literal is not None and indent <= literal:
                literal = None
            if literal is None and out and not out[-1].strip() and indent >= last + 4:
                out += [f"{' ' * last}::", ""]
                literal = last
            if literal is None:
                last = indent
        out.append(line if literal is not None else escape(line))
    # Napoleon takes what is before a colon in the first line of these for a type.
    lines[:] = ["", *out] if what in ("attribute", "data", "property") else out


def escape(line: str) -> str:
    """What neither is code nor stresses a word."""
    parts = re.split(r"(``.*?``|`[^`]*`|\*\w+\*)", line)
    return "".join(p if k % 2 else re.sub(r"[|*]", r"\\\g<0>", p) for k, p in enumerate(parts))


def setup(app: Sphinx) -> dict:
    app.add_source_suffix(".ipynb", "notebook")
    app.add_source_parser(NotebookParser)
    app.connect("builder-inited", write_api)
    # It names the pages of the API, which change while its file does not.
    app.connect("env-get-outdated", lambda *_: [root_doc])
    app.connect("source-read", order_pages)
    app.connect("env-check-consistency", check_names)
    app.connect("build-finished", open_at_the_index)
    # Before napoleon, which takes sections apart.
    app.connect("autodoc-process-docstring", add_limits, priority=300)
    app.connect("autodoc-process-docstring", as_markdown, priority=310)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
