"""Version of the installed package.

The lookup of the version is slow, and is therefore delayed until the version is used for the first time.
"""

from collections.abc import Callable
from functools import cache


@cache
def package_version() -> str:
    """Return the version of isocharge from the metadata of the installed package.

    The result is stored after the first call, because a busy server may have no file descriptor left for reading the
    metadata again.
    """
    from importlib.metadata import version  # imported late, because the import is slow

    return version("isocharge")


def version_attribute(module: str) -> Callable[[str], str]:
    """Return a function that provides the attribute `__version__` of a module.

    The module assigns the function to the name `__getattr__`. Python calls a function of this name for each attribute
    that the module does not contain.

    Args:
        module: Name of the module, for the error message about any other missing attribute.
    """

    def look_up(name: str) -> str:
        """Return the version for the name `__version__`, and raise an AttributeError for any other name."""
        if name == "__version__":
            return package_version()
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return look_up
