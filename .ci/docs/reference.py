"""Generation of the reference of all modules from their docstrings."""

import re
import sys
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import Any

PUBLIC_PACKAGES = ("isocharge.serve", "isocharge.simulate", "isocharge.train")
ATTRIBUTE = re.compile(r":ivar (?P<names>[^:]+): ?(?P<text>.*)")
UNINDENTED_EXAMPLE = re.compile(r"^(from \w+ import|>>>|\w+ = \w+\()", re.MULTILINE)
DOTTED = re.compile(r"`(isocharge(?:\.\w+)+)`")


def modules() -> list[str]:
    """Return the names of all modules of isocharge except private modules, in alphabetical order."""
    packages = [import_module(name) for name in ("isocharge", "isocharge.cli")]
    names = {entry.name for package in packages for entry in walk_packages(package.__path__, f"{package.__name__}.")}
    return sorted(name for name in names if "._" not in name)


def check_docstrings(names: list[str]) -> None:
    """Check the names and the examples in the source of modules.

    A dotted name in backticks, such as `isocharge.serve.stream`, must be a module or an attribute of a module. An
    example in the docstring of a module must be indented, because only indented lines are shown as code.

    Args:
        names: Names of the modules.

    Raises:
        SystemExit: If a name or an example is wrong.
    """
    for name in names:
        module = import_module(name)
        if UNINDENTED_EXAMPLE.search(module.__doc__ or ""):
            sys.exit(f"{name}: expected the example in the docstring indented, after an empty line")

        source = Path(str(module.__file__)).read_text("utf-8")
        for dotted_name in DOTTED.findall(source):
            module_name, _, attribute = dotted_name.rpartition(".")
            is_module = dotted_name in names
            is_attribute = module_name in names and hasattr(import_module(module_name), attribute)
            if not is_module and not is_attribute:
                sys.exit(f"{name}: expected a module or an attribute of one, got `{dotted_name}`")


def write_pages(names: list[str], folder: Path) -> None:
    """Write a page for each module, and one page that lists all modules.

    The pages of the modules are in no table of contents, because every page of the site would repeat that table.

    Args:
        names: Names of the modules.
        folder: Folder for the pages.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        page = [
            ":orphan:",  # Sphinx then accepts that the page is in no table of contents
            "",
            name,
            "=" * len(name),
            "",
            f".. automodule:: {name}",
            "   :members:",
            "   :show-inheritance:",
        ]
        if hasattr(import_module(name), "__all__"):
            # The page shows the public names, but the index refers to the modules that define them.
            page += ["   :imported-members:", "   :no-index:"]
        _write(folder / f"{name}.rst", page)

    list_page = ["Modules", "=======", "", "The public names are those of these packages:", ""]
    list_page += [f"* :doc:`{name}`" for name in PUBLIC_PACKAGES]
    list_page += ["", "All modules:", ""]
    list_page += [f"* :doc:`{name}`" for name in names]
    _write(folder / "index.rst", list_page)


def _write(path: Path, lines: list[str]) -> None:
    """Write lines into a file unless the file already contains them. Sphinx does not read unchanged files again."""
    text = "\n".join(lines) + "\n"
    if not path.exists() or path.read_text("utf-8") != text:
        path.write_text(text, "utf-8")


def is_of_scikit_learn(_app: Any, _kind: str, name: str, _object: Any, skip: bool, _options: Any) -> bool:
    """Return whether a member of a class or module is omitted from the reference.

    The methods `set_..._request`, which scikit-learn generates, are omitted, because scikit-learn documents them.

    Args:
        name: Name of the member.
        skip: Whether Sphinx omits the member anyway.
    """
    return skip or (name.startswith("set_") and name.endswith("_request"))


def plain_text(_app: Any, kind: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Convert a docstring of plain text, in which names are in backticks, to reStructuredText.

    Indented lines after a blank line become a block of code, which ends before the next line that is not indented.
    Sphinx calls this function for each docstring and expects the result in the same list.

    Args:
        kind: Kind of the documented object, such as "data" for a constant.
        lines: Lines of the docstring, which are replaced by the converted lines.
    """
    converted = []
    is_code = False
    for previous_line, line in zip(["", *lines], lines, strict=False):  # the first line has no previous line
        if line.strip():  # a blank line does not end the code
            was_code = is_code
            follows_blank_line = not previous_line.strip()
            is_code = line.startswith("    ") and (was_code or follows_blank_line)
            if is_code and not was_code:
                converted += ["::", ""]  # the mark of reStructuredText for the beginning of a block of code
        converted.append(line if is_code else _escaped(line))
    if kind in ("attribute", "data"):
        # Without an escaped space at the beginning, Sphinx would interpret text before a colon as a type.
        converted.insert(0, "\\ ")
    lines[:] = converted


def list_attributes(_app: Any, _kind: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Write the attributes of a class as a list of names and descriptions.

    Napoleon writes a field `:ivar NAMES: text` for each attribute. If there are several names, as in `x_mm, y_mm`,
    Sphinx would interpret the first name as a type. The fields `:vartype NAME:`, which contain the types, are omitted.
    Sphinx calls this function for each docstring and expects the result in the same list.

    Args:
        lines: Lines of the docstring, which are replaced by the converted lines.
    """
    converted: list[str] = []
    is_in_list = False
    for line in lines:
        if line.startswith(":vartype "):
            continue
        attribute = ATTRIBUTE.match(line)
        # A blank or indented line belongs to the description of the previous attribute.
        continues_description = not line.strip() or line.startswith(" ")
        if attribute is not None:
            if not is_in_list:
                converted += [":Attributes:", ""]
            is_in_list = True
            converted.append(f"    * **{attribute['names']}**: {attribute['text']}")
        elif is_in_list and continues_description:
            converted.append(f"      {line.lstrip()}".rstrip())
        else:
            is_in_list = False
            converted.append(line)
    lines[:] = converted


def _escaped(line: str) -> str:
    """Escape the characters outside backticks that have a special meaning in reStructuredText."""
    # The parts between the backticks are alternately plain text and quoted names. A backslash is put before each
    # special character of the plain text: an asterisk, a bar, a backslash, or an underscore at the end of a word.
    parts = line.split("`")
    parts[::2] = [re.sub(r"([*|\\]|_(?=\W|$))", r"\\\1", part) for part in parts[::2]]
    # A quoted name that is followed by a letter, as in `press`es, must be separated from the letter by a backslash.
    return re.sub(r"(`[^`]*`)(?=\w)", r"\1\ ", "`".join(parts))
