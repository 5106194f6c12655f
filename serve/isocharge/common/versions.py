"""Version of the installed package.

The lookup of the version is slow, and is therefore delayed until the version is used for the first time.
"""

from functools import cache


@cache
def package_version() -> str:
    """Return the version of isocharge from the metadata of the installed package.

    The result is stored after the first call, because a busy server may have no file descriptor left for reading the
    metadata again.
    """
    from importlib.metadata import version  # imported late, because the import is slow

    return version("isocharge")
