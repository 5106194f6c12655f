"""Public names of a package that are imported from their modules only when they are used for the first time.

A program that reads a dataset therefore does not wait for the import of the solver, a calibration does not wait for
PyTorch, and a program that predicts contacts does not wait for the servers and the parsers of boards.
"""

import ast
import pkgutil
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

from isocharge.common.extras import require
from isocharge.common.versions import package_version


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
