"""Configuration of the site, which contains the pages, the example scripts with their pictures, and a reference.

The source folder of the site is the folder of the project. Links between the pages therefore work on the site and also
where the code is hosted.

Example of a build:

    python -m sphinx -W --keep-going -c .ci/docs . build/docs
"""

import shutil
import sys
import warnings
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(Path(__file__).parent))

import commands  # noqa: E402
import reference  # noqa: E402

from isocharge.serve.viewer.playground_page import playground_html  # noqa: E402

PORTIONS = ("simulate", "train", "serve")
HOME, REFERENCE, GALLERY, COMMANDS = "README", "build/reference", "build/gallery", "build/commands"
PLAYGROUND = "serve/docs/playground"
NAVIGATION: dict[tuple[tuple[str, Any], ...], Any] = {}
"""Navigation of the pages of modules, by the options with which the theme requests the navigation."""

project = "isocharge"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
extensions += ["sphinx_gallery.gen_gallery"]
root_doc = HOME
include_patterns = [
    "*.md",
    f"{COMMANDS}.md",
    "models/**/card.md",
    "models/README.md",
    f"{REFERENCE}/**",
    f"{GALLERY}/**",
]
include_patterns += [pattern for name in PORTIONS for pattern in (f"{name}/README.md", f"{name}/docs/*.md")]
exclude_patterns = [f"{GALLERY}/**/{name}" for name in ("*.py", "*.ipynb", "*.zip", "*.json")]
exclude_patterns += [".*", "build/docs", "build/kept", "tests"]  # large folders, in which Sphinx would search for pages
myst_heading_anchors = 3
default_role = "code"
napoleon_use_ivar = napoleon_use_rtype = True
autodoc_typehints = "none"
autodoc_use_type_comments = False  # there are none, and the search for them parses each function again
html_theme = "furo"
html_copy_source = html_show_sphinx = html_show_copyright = False
html_title = project
suppress_warnings = ["ref.python"]  # attributes of one name in many classes are not linked

# loky replaces worker processes whose memory has grown, and prints a warning.
warnings.filterwarnings("ignore", message="A worker stopped while some jobs", category=UserWarning)
sphinx_gallery_conf = {
    "examples_dirs": [f"{name}/examples" for name in PORTIONS],
    "gallery_dirs": [f"{GALLERY}/{name}" for name in PORTIONS],
    "filename_pattern": r"\.py$",
    "ignore_pattern": r"/paper/|_on_executors",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
    "write_computation_times": False,
    "parallel": 2,
    "copyfile_regex": r".*\.csv",
}


def add_contents(_app: Any, page: str, source: list[str]) -> None:
    """Append the table of contents to the first page, and insert links into the page about the playground.

    Args:
        page: Name of the page that Sphinx has read.
        source: List with the text of the page, which is changed in place.
    """
    if page == HOME:
        source[0] += (ROOT / ".ci" / "docs" / "contents.md").read_text("utf-8")
    if page == PLAYGROUND:
        source[0] = source[0].replace("`playground.html`", '<a href="../../playground.html">playground.html</a>')


def share_navigation(_app: Any, page: str, _template: str, context: dict[str, Any], _doctree: Any) -> None:
    """Use the same navigation for all pages of modules.

    The pages of modules are in one folder and in no table of contents. The navigation of these pages is therefore the
    same. The navigation is computed only once, because the computation takes more time than the rest of a page.

    Args:
        page: Name of the page that Sphinx writes.
        context: Values for the template of the page. Its function `toctree`, which computes the navigation, is
            replaced.
    """
    if page.startswith(f"{REFERENCE}/isocharge") and "toctree" in context:
        compute_navigation = context["toctree"]
        context["toctree"] = lambda **options: _shared_navigation(compute_navigation, tuple(sorted(options.items())))


def _shared_navigation(compute_navigation: Any, options: tuple[tuple[str, Any], ...]) -> Any:
    """Return the navigation bar that all pages of modules show. The navigation is computed for the first page only.

    Args:
        compute_navigation: Function of Sphinx that computes the navigation.
        options: Names and values of the options of this function.
    """
    if options not in NAVIGATION:
        NAVIGATION[options] = compute_navigation(**dict(options))
    return NAVIGATION[options]


def add_whole_pages(app: Any, error: Exception | None) -> None:
    """Add the playground to the site, and copy the first page to the file name that web servers expect.

    Args:
        app: The application of Sphinx.
        error: Error that ended the build; None after a successful build.
    """
    if error is None:
        folder = Path(app.outdir)
        shutil.copy(folder / f"{HOME}.html", folder / "index.html")
        (folder / "playground.html").write_text(playground_html(), "utf-8")


def setup(app: Any) -> None:
    """Write the pages that are generated, and connect the functions for the site to the events of Sphinx."""
    # The pages must exist before Sphinx looks for the sources.
    module_names = reference.modules()
    reference.check_docstrings(module_names)
    reference.write_pages(module_names, ROOT / REFERENCE)
    commands.write_page(ROOT / f"{COMMANDS}.md")

    # A function with a smaller priority runs earlier, and the default is 500. Napoleon, an extension of Sphinx that
    # converts sections such as `Args`, has the priority 500. It must run after the conversion of plain text to
    # reStructuredText, and before the attributes are listed.
    app.connect("source-read", add_contents)
    app.connect("autodoc-skip-member", reference.is_of_scikit_learn)  # omits the methods of scikit-learn
    app.connect("autodoc-process-docstring", reference.plain_text, priority=400)
    app.connect("autodoc-process-docstring", reference.list_attributes, priority=600)
    app.connect("html-page-context", share_navigation, priority=400)  # before the theme requests the navigation
    app.connect("build-finished", add_whole_pages)
