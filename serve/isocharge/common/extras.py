"""Installed packages: extras, the version of isocharge, and public names that are imported when they are used.

An import fails with the command that installs the missing extra. A program that reads a dataset does not wait for the
import of the solver, a calibration does not wait for PyTorch, and a program that predicts contacts does not wait for
the servers and the parsers of boards.
"""

import ast
import pkgutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import Any

from isocharge.common.errors import MissingExtra


@contextmanager
def require(*extras: str) -> Iterator[None]:
    """If an import in the `with` block fails, raise an error with the command that installs the extras.

    Args:
        extras: Names of the extras in pyproject.toml. Without extras, no error is changed.

    Raises:
        MissingExtra: If an import in the block fails because a package other than isocharge is not installed. If an
            import fails for any other reason, its error is not changed.

    Example:
        >>> with require("simulate"):
        ...     from isocharge.simulate import load_sensor
    """
    try:
        yield
    except (ModuleNotFoundError, MissingExtra) as error:  # another `require` inside the block may raise MissingExtra
        missing_module = error.name or ""
        package = missing_module.partition(".")[0]  # for example "google" for the module "google.protobuf"
        if not extras or package in ("", "isocharge"):
            raise
        raise MissingExtra(
            f"this needs the package {package!r}, which is not installed; pip install 'isocharge[{','.join(extras)}]'",
            name=package,
        ) from error


@cache
def package_version() -> str:
    """Return the version of isocharge from the metadata of the installed package.

    The result is stored after the first call, because a busy server may have no file descriptor left for reading the
    metadata again.
    """
    from importlib.metadata import version  # imported late, because the import is slow

    return version("isocharge")


def lazy_names(package: str, *extras: str) -> Callable[[str], Any]:
    """Return a function that imports a public name of a package when the name is used for the first time.

    The package assigns the function to the name `__getattr__`. Python calls a function of this name for each attribute
    that the package does not contain. The modules of the names are stated once, as imports that only type checkers
    execute:

        if TYPE_CHECKING:
            from isocharge.simulate.solver.press import press
        else:
            __getattr__ = lazy_names(__name__, "simulate")

    Args:
        package: Name of the package.
        *extras: Extras of pyproject.toml that the package needs.
    """

    @cache
    def modules() -> dict[str, str]:
        """Return the module of each public name, from the imports in the source of the package."""
        source = pkgutil.get_data(package, "__init__.py") or b""
        imports = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ImportFrom)]
        return {alias.name: node.module or "" for node in imports for alias in node.names}

    def look_up(name: str) -> Any:
        """Import a public name, and store it in the package, so that Python no longer calls this function for it.

        Raises:
            AttributeError: If the name is not public.
            MissingExtra: If a package of the extra is not installed.
        """
        if name == "__version__":
            return package_version()
        namespace = sys.modules[package]
        if name not in namespace.__all__:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with require(*extras):
            value = getattr(import_module(modules()[name]), name)
        setattr(namespace, name, value)
        return value

    return look_up
