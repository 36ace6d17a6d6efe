"""Build steps of the site: pages for the API and the gallery, mathematics as MathML, figures in the text.

mkdocs calls the ``on_*`` functions; mkdocstrings loads ``Docstrings``. Everything happens at build time: the pages load
nothing from elsewhere.
"""

from __future__ import annotations

import ast
import functools
import html
import json
import logging
import re
import tomllib
from pathlib import Path
from typing import Any

try:
    import griffe
    from latex2mathml.converter import convert
    from mkdocs.structure.files import File
except ImportError:  # the page generators below need none of them
    griffe = None

ROOT = Path(__file__).parents[1]
PACKAGE = "torchrl_sspl"
SECTIONS = {  # in the order of the floors, from the mathematics to the tools
    "functional": "Equations",
    "sets": "Regions",
    "errors": "Errors",
    "lipschitz": "Lipschitz bounds",
    "modules": "Networks",
    "envs": "Environments",
    "certification": "Certification",
    "data": "Data",
    "objectives": "Losses",
    "viability": "True kernels",
    "evaluation": "Evaluation",
    "runtime": "At run time",
    "trainers": "Training",
    "viz": "Figures and reports",
    "experiments": "Experiments",
    "baselines": "Other methods",
    "configs": "Configuration",
    "cli": "Command line",
    "devices": "Devices",
    "files": "Files",
    "interrupts": "Signals",
    "seeds": "Seeds",
}
TOGETHER = ("errors", "configs")  # classes of a few lines each: all of them on one page
log = logging.getLogger("mkdocs.hooks.sspl")


# ---------------------------------------------------------------- API pages


def parts() -> list[str]:
    """Public modules and packages directly below the library, in reading order."""
    found = {p.stem for p in (ROOT / PACKAGE).iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()}
    found = {name for name in found if not name.startswith("_")}
    return [n for n in SECTIONS if n in found] + sorted(found - set(SECTIONS))


def definitions(path: Path) -> list[str]:
    """Public functions and classes that a file defines at its top level."""
    body = ast.parse(path.read_text()).body
    kinds = (ast.FunctionDef, ast.ClassDef)
    return [node.name for node in body if isinstance(node, kinds) and not node.name.startswith("_") and node.name != "main"]


def exported(path: Path) -> list[str]:
    """The names in a package's ``__all__``."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return [name for name in ast.literal_eval(node.value)]
    return []


def documented(part: str) -> list[str]:
    """Dotted names that the page of a part shows: what the package exports, then what else its modules define."""
    root = ROOT / PACKAGE / part
    if not root.is_dir():
        return [f"{PACKAGE}.{part}.{name}" for name in definitions(root.with_suffix(".py"))]
    public = exported(root / "__init__.py")
    names = [f"{PACKAGE}.{part}.{name}" for name in sorted(public, key=lambda name: (name.isupper(), name))]
    for path in sorted(root.rglob("*.py")):
        inner = path.relative_to(root).with_suffix("").parts
        if any(piece.startswith("_") for piece in inner):
            continue
        module = ".".join((PACKAGE, part, *inner))
        names += [f"{module}.{name}" for name in definitions(path) if name not in public]
    return names


def assigned(path: Path, name: str) -> Any:
    """Value of a literal that a file assigns at its top level."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == name:
            return ast.literal_eval(node.value)
    raise ValueError(f"expected a literal '{name}' in {path.name}, found none")


def top_level() -> dict[str, str]:
    """Names of ``import torchrl_sspl`` and where each is documented."""
    places = {}
    for name, module in assigned(ROOT / PACKAGE / "__init__.py", "_NAMES").items():
        part = module.split(".")[0]
        short = f"{PACKAGE}.{part}.{name}"
        places[name] = short if short in documented(part) else f"{PACKAGE}.{module}.{name}"
    return places


def anchor(name: str) -> str:
    return f'<a id="{PACKAGE}.{name}"></a>'


def api_index() -> str:
    """The names of ``import torchrl_sspl`` on one page."""
    lines = ["# API", "", "`import torchrl_sspl as sspl` is light: every name is loaded when it is first used.", ""]
    lines += ["| Name | Is |", "|---|---|"]
    for name, target in sorted(top_level().items(), key=lambda item: item[0].lower()):
        lines.append(f"| {anchor(name)}[`sspl.{name}`][{target}] | {summary(target)} |")
    for part in parts():
        words, title = f"`sspl.{part}`", SECTIONS.get(part, part)
        link = f"[{words}]({part}.md)" if documented(part) else words
        lines.append(f"| {anchor(part)}{link} | {title} |")
    return "\n".join([*lines, f"| {anchor('__version__')}`sspl.__version__` | version of the library |", ""])


@functools.cache
def statements(path: Path) -> list[ast.stmt]:
    """What a file of the library consists of; names are looked up in it again and again."""
    return ast.parse(path.read_text()).body


def definition(dotted: str) -> ast.FunctionDef | ast.ClassDef | None:
    """A function or class, wherever in its part it is written; None for a constant."""
    part, *inner, name = dotted.split(".")[1:]
    root = ROOT / PACKAGE / part
    paths = sorted(root.rglob("*.py")) if root.is_dir() else [root.with_suffix(".py")]
    if inner:
        paths = [root.joinpath(*inner).with_suffix(".py"), root.joinpath(*inner, "__init__.py"), *paths]
    for path in filter(Path.is_file, paths):
        for node in statements(path):
            if getattr(node, "name", None) == name and isinstance(node, ast.FunctionDef | ast.ClassDef):
                return node
    return None


def summary(dotted: str) -> str:
    """First sentence of the docstring of a function or class."""
    node = definition(dotted)
    first = " ".join((ast.get_docstring(node) or "" if node else "").split("\n\n")[0].split())
    return to_markdown(re.split(r"\.(?: |$)", first)[0]).replace("|", "\\|")


def api_page(part: str) -> str:
    root = ROOT / PACKAGE / part
    source = root / "__init__.py" if root.is_dir() else root.with_suffix(".py")
    intro = ast.get_docstring(ast.parse(source.read_text())) or ""
    names, apart = documented(part), own_pages(part)
    title = SECTIONS.get(part, part)
    lines = [f"# {title}", "", f"`{PACKAGE}.{part}`", "", to_markdown(intro.split("\n\n")[0]), ""]
    if len(names) > 4:
        lines += ["| Name | Is |", "|---|---|", *(f"| [`{n.rsplit('.', 1)[1]}`][{n}] | {summary(n)} |" for n in names), ""]
    for name in names:
        lines += [f"::: {name}", ""] if name not in apart else []
    return "\n".join(lines)


def own_pages(part: str) -> dict[str, str]:
    """Names of a part that are not on its page: each class has one, and what a module does not export shares that of the module."""
    if part in TOGETHER or not (ROOT / PACKAGE / part).is_dir():
        return {}
    pages = {}
    for name in documented(part):
        *inner, short = name.split(".")[2:]
        if isinstance(definition(name), ast.ClassDef):
            pages[name] = f"api/{part}/{short}.md"
        elif inner:
            pages[name] = f"api/{part}/{'.'.join(inner)}.md"
    classes = [place.lower() for place in pages.values() if not Path(place).stem[0].islower()]
    if len(set(classes)) < len(classes):
        raise ValueError(f"expected classes of different names in '{part}', found two pages of one name: rename one")
    return pages


def inner_page(place: str, names: list[str]) -> str:
    """Page of a class, or of the functions of a module."""
    if not Path(place).stem[0].islower():
        return f"::: {names[0]}\n    options: {{heading_level: 1}}\n"
    module = names[0].rsplit(".", 1)[0]
    return "\n".join([f"# {module.rsplit('.', 1)[1]}", "", f"`{module}`", "", *(f"::: {name}\n" for name in names)])


def inner_pages(part: str) -> dict[str, list[str]]:
    """Names on each further page of a part, by its place."""
    pages: dict[str, list[str]] = {}
    for name, place in own_pages(part).items():
        pages.setdefault(place, []).append(name)
    return dict(sorted(pages.items(), key=lambda item: Path(item[0]).stem[0].islower()))


def api_pages() -> dict[str, str]:
    """Content of all pages of the API, by place."""
    pages = {"api/index.md": api_index()}
    for part in filter(documented, parts()):
        pages[f"api/{part}.md"] = api_page(part)
        pages |= {place: inner_page(place, names) for place, names in inner_pages(part).items()}
    return pages


def api_navigation() -> list[Any]:
    """The parts, each with the pages of its classes."""
    entries: list[Any] = ["api/index.md"]
    for part in filter(documented, parts()):
        inner = [{Path(place).stem: place} for place in inner_pages(part)]
        entries.append({SECTIONS.get(part, part): [f"api/{part}.md", *inner] if inner else f"api/{part}.md"})
    return entries


# ------------------------------------------------------------------ gallery


def captions() -> dict[str, dict[str, str]]:
    return tomllib.loads((ROOT / "docs" / "images" / "captions.toml").read_text())


def examples() -> list[Path]:
    order = list(captions()["titles"])
    paths = (ROOT / "examples").glob("[!_]*.py")
    return sorted(paths, key=lambda path: (order.index(path.stem) if path.stem in order else len(order), path.stem))


def gallery_title(path: Path) -> str:
    first = (ast.get_docstring(ast.parse(path.read_text())) or path.stem).split("\n")[0]
    return captions()["titles"].get(path.stem) or re.split(r"[:.,;](?:\s|$)", first)[0]


def gallery_pictures(path: Path) -> dict[str, str]:
    """Pictures of an example and their captions."""
    return captions().get(path.stem, {})


def gallery_page(path: Path) -> str:
    source = path.read_text()
    doc = to_markdown(ast.get_docstring(ast.parse(source)) or "")
    lines = [f"# {gallery_title(path)}", "", doc, ""]
    for name, words in gallery_pictures(path).items():
        lines += [f"![{words}](../images/{name})", "", f"*{words}*", ""]
    code = source.split('"""', 2)[2].lstrip("\n") if source.startswith(('"""', 'r"""')) else source
    return "\n".join([*lines, f"`examples/{path.name}`", "", "```python", code.rstrip(), "```", ""])


def gallery_index() -> str:
    lines = ["# Gallery", "", "Every example is run by the tests. Start one with `python examples/<name>.py`.", ""]
    for path in examples():
        title = gallery_title(path)
        lines += [f"## [{title}]({path.stem}.md)", "", f"`examples/{path.name}`", ""]
        for name, words in list(gallery_pictures(path).items())[:1]:
            lines += [f"[![{words}](../images/{name}){{ width=420 }}]({path.stem}.md)", ""]
    return "\n".join(lines)


# ---------------------------------------------------------------- notebooks


def notebooks() -> list[Path]:
    return sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def cells(path: Path) -> list[tuple[str, str]]:
    """Kind ("markdown" or "code") and text of every cell of a notebook."""
    return [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(path.read_text())["cells"]]


def notebook_page(path: Path) -> str:
    parts = [text if kind == "markdown" else f"```python\n{text}\n```" for kind, text in cells(path)]
    link = f"[This page as a notebook]({path.name}){{ download }}; the tests run it."
    return "\n\n".join([parts[0], link, *parts[1:]]) + "\n"


# ------------------------------------------------- reStructuredText to Markdown

ROLE = re.compile(r":(?:py:)?(?:class|func|meth|mod|attr|data|obj):`~?([^`]+)`")
MATH = re.compile(r":math:`((?:[^`])+)`", re.DOTALL)
BLOCK = re.compile(r"^(?P<indent>[ ]*)\.\. math::(?P<first>[^\n]*)\n(?P<rest>(?:(?P=indent)[ ]+[^\n]*\n|[ ]*\n)*)", re.MULTILINE)


TABLE = re.compile(
    r"^(?P<indent>[ ]*)(?P<rule>=+(?: +=+)+)\n(?P<head>[^\n]*)\n(?P=indent)(?P=rule)\n(?P<body>(?:(?!(?P=indent)=)[^\n]*\n)*?)"
    r"(?P=indent)(?P=rule)$",
    re.MULTILINE,
)


def table(match: re.Match[str]) -> str:
    """A simple table of reStructuredText: columns lie under their rules."""
    indent = match["indent"]
    starts = [m.start() for m in re.finditer(r"=+", match["rule"])]

    def row(line: str) -> str:
        line = line[len(indent) :]
        cells = [line[a:b].strip() for a, b in zip(starts, [*starts[1:], None], strict=True)]
        return f"{indent}| {' | '.join(cells)} |"

    rows = [row(line) for line in match["body"].splitlines() if line.strip()]
    return "\n".join([row(match["head"]), f"{indent}|{'---|' * len(starts)}", *rows])


def to_markdown(text: str) -> str:
    r"""Docstrings are written for ``help()`` with the roles of Sphinx; this turns them into Markdown.

    Example:
        >>> to_markdown(r":math:`\psi` of :class:`LatentLoss` is ``float``")
        '\\(\\psi\\) of `LatentLoss` is `float`'
    """

    def block(match: re.Match[str]) -> str:
        body = "\n".join([match["first"], *match["rest"].split("\n")])
        formula = " ".join(body.split())
        if "&" in formula and r"\begin" not in formula:
            formula = rf"\begin{{aligned}} {formula} \end{{aligned}}"
        indent = match["indent"]
        return f"\n{indent}$$\n{indent}{formula}\n{indent}$$\n\n"

    text = BLOCK.sub(block, text + "\n")
    text = TABLE.sub(table, text)
    text = MATH.sub(lambda match: rf"\({' '.join(match[1].split())}\)", text)
    text = ROLE.sub(lambda match: f"`{match[1].rsplit('.', 1)[-1]}`", text)
    return re.sub(r"``([^`]+)``", r"`\1`", text).rstrip("\n")


if griffe is not None:

    class Docstrings(griffe.Extension):
        """Rewrites every docstring before it is parsed."""

        def on_object(self, *, obj: Any, **_: Any) -> None:
            self.rewrite(obj)

        on_instance = on_object

        def rewrite(self, obj: Any) -> None:
            if obj.is_alias or obj.docstring is None or getattr(obj.docstring, "_markdown", False):
                return
            text = to_markdown(obj.docstring.value)
            text = re.sub(r"^( *)Example:$", r"\1Examples:", text, flags=re.MULTILINE)
            text = re.sub(r"(^ *|[.)] )Source: ", r"\1**Source:** ", text, flags=re.MULTILINE)
            obj.docstring.value = text


# ------------------------------------------------------------------- mkdocs


def on_config(config: Any) -> Any:
    """Fills in the generated parts of the navigation."""
    docs = Path(config["docs_dir"])

    def fill(item: Any) -> Any:
        if isinstance(item, list):
            return [done for done in map(fill, item) if done]
        title, value = next(iter(item.items()))
        if value == "gallery/":
            value = ["gallery/index.md", *({gallery_title(p): f"gallery/{p.stem}.md"} for p in examples())]
        elif value == "api/":
            value = api_navigation()
        elif isinstance(value, list):
            value = fill(value)
        elif not (docs / value).exists() and not (docs / value).with_suffix(".ipynb").exists():
            log.info("no page %s yet", value)
            return None
        return {title: value}

    config["nav"] = fill(config["nav"])
    return config


def on_files(files: Any, config: Any) -> Any:
    pages = {"gallery/index.md": gallery_index()} | api_pages()
    pages |= {f"gallery/{path.stem}.md": gallery_page(path) for path in examples()}
    pages |= {f"notebooks/{path.stem}.md": notebook_page(path) for path in notebooks()}
    for place, content in pages.items():
        files.append(File.generated(config, place, content=content))
    return files


def readme_section(title: str) -> str:
    """A section of the README, with its links as seen from docs/."""
    found = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", (ROOT / "README.md").read_text(), re.DOTALL | re.MULTILINE)
    if found is None:
        raise ValueError(f"expected a section '{title}' in README.md, found none: rename it in the page that includes it")
    text = found[1].replace("[docs/deviations.md](", "[Deviations](")
    # What is not part of the site is named, but not linked.
    text = re.sub(r"\[([^\]]+)\]\((?!https?:|docs/|examples/\w+\.py)[^)]*\)", r"\1", text)
    text = re.sub(r"\]\(docs/", "](", text)
    return re.sub(r"\]\(examples/(\w+)\.py\)", r"](gallery/\1.md)", text).strip()


def on_page_markdown(markdown: str, **_: Any) -> str:
    return re.sub(r"<!-- README: (.*?) -->", lambda match: readme_section(match[1]), markdown)


INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
DISPLAY = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)
FIGURE = re.compile(r'<p><img alt="(?P<alt>[^"]*)" src="[^"]*images/(?P<name>[\w-]+\.svg)" ?/?></p>')


def formula(latex: str, display: str) -> str:
    return str(convert(html.unescape(latex).strip(), display=display))


def draw(match: re.Match[str]) -> str:
    """A figure inside the page takes the colours of the page."""
    svg = (ROOT / "docs" / "images" / match["name"]).read_text()
    svg = re.sub(r"<\?xml.*?\?>\s*", "", svg)
    return f'<figure class="diagram" role="img" aria-label="{match["alt"]}">{svg}</figure>'


def on_page_content(content: str, **_: Any) -> str:
    content = FIGURE.sub(draw, content)
    content = INLINE.sub(lambda match: f'<span class="in-line">{formula(match[1], "inline")}</span>', content)
    return DISPLAY.sub(lambda match: f'<div class="formula">{formula(match[1], "block")}</div>', content)
