"""Public names of a package that are imported from their modules only when they are used for the first time.

A program that reads a dataset therefore does not wait for the import of the solver, nor a calibration for PyTorch.
"""

import ast
import pkgutil
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

from isocharge.common.extras import require
from isocharge.common.versions import version_attribute


def lazy_names(package: str, extra: str) -> Callable[[str], Any]:
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
        extra: Extra of pyproject.toml that the package needs.
    """
    look_up_version = version_attribute(package)

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
        namespace = sys.modules[package]
        if name not in namespace.__all__:
            return look_up_version(name)  # the version, or AttributeError for all other names
        with require(extra):
            value = getattr(import_module(modules()[name]), name)
        setattr(namespace, name, value)
        return value

    return look_up
