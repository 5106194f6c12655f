"""The version of the installed package, with a slow lookup that is delayed until the version is first used."""

from collections.abc import Callable
from functools import cache


@cache
def package_version() -> str:
    """Return the version of isocharge from the metadata of the installed package.

    The result is cached, because a busy server may have no file descriptor left to read the metadata again.
    """
    from importlib.metadata import version  # imported late, because the import is slow

    return version("isocharge")


def version_attribute(module: str) -> Callable[[str], str]:
    """Return a function `__getattr__` for a module that provides the attribute `__version__`.

    Args:
        module: Name of the module, for the error message about any other attribute.
    """

    def look_up(name: str) -> str:
        """Return the version for `__version__`, and raise AttributeError for any other name."""
        if name == "__version__":
            return package_version()
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return look_up
