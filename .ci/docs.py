"""The reference of every module, from the docstrings: build/docs/index.html.

python -W error .ci/docs.py OUTPUT_FOLDER

Every module gets a page. A reference that leads nowhere is an error, as every warning is.
"""

import re
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

from pdoc import render
from pdoc.doc import Module

ROOT = Path(__file__).parents[1]
DOTTED = re.compile(r"`(isocharge(?:\.\w+)+)`")


def modules() -> list[str]:
    """Every module of the namespace packages, private ones left out."""
    packages = [import_module(name) for name in ("isocharge", "isocharge.cli")]
    names = {entry.name for package in packages for entry in walk_packages(package.__path__, f"{package.__name__}.")}
    return sorted(name for name in names if "._" not in name)


def check_docstrings(names: list[str]) -> None:
    """Every dotted name in backticks is a module, or an attribute of one, and an example is indented, so it is code.

    Raises:
        SystemExit: If one is not.
    """
    for name in names:
        if re.search(r"^(from \w+ import|>>>|\w+ = \w+\()", import_module(name).__doc__ or "", re.MULTILINE):
            sys.exit(f"{name}: expected the example in the docstring indented, under a line that ends with no colon")
        for dotted in DOTTED.findall(Path(str(import_module(name).__file__)).read_text("utf-8")):
            home, _, attribute = dotted.rpartition(".")
            if dotted not in names and not (home in names and hasattr(import_module(home), attribute)):
                sys.exit(f"{name}: expected a module or an attribute of one, got `{dotted}`")


def main(folder: Path) -> None:
    """Write a page for each module, the index and what its search reads."""
    names = modules()
    check_docstrings(names)
    render.configure(docformat="google", math=True, template_directory=ROOT / ".ci" / "docs")
    pages = {name: Module(import_module(name)) for name in names}
    for name, module in pages.items():
        path = folder / f"{name.replace('.', '/')}.html"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(render.html_module(module, pages), "utf-8")
    (folder / "index.html").write_text(render.html_index(pages), "utf-8")
    (folder / "search.js").write_text(render.search_index(pages), "utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
