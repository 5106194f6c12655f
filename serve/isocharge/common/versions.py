"""The version of the installed package, looked up only when somebody asks: importlib.metadata is slow to import."""

from collections.abc import Callable
from functools import cache


@cache
def package_version() -> str:
    """The version of isocharge, as pip knows it; kept, because it is read from files, which a busy server may lack."""
    from importlib.metadata import version  # late, see above

    return version("isocharge")


def version_attribute(module: str) -> Callable[[str], str]:
    """The `__getattr__` of a module that gives it a `__version__`.

    Args:
        module: Its name, for the error of every other attribute.
    """

    def look_up(name: str) -> str:
        if name == "__version__":
            return package_version()
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return look_up
