"""Packages of the extras in pyproject.toml, and the error for an extra that is not installed."""

from collections.abc import Iterator
from contextlib import contextmanager

from isocharge.common.errors import MissingExtra

SIMULATE = frozenset({"scipy", "threadpoolctl", "matplotlib", "contourpy", "shapely"})
HTTP = frozenset({"uvloop", "httptools", "orjson", "prometheus_client", "websockets"})
PACKAGES = {
    "simulate": SIMULATE,
    "train": SIMULATE | {"torch", "onnx", "sklearn"},
    "http": HTTP,
    "grpc": HTTP | {"grpc", "google"},
    "cluster": frozenset({"dask", "distributed"}),
    "design": SIMULATE | {"ezdxf"},
    "record": frozenset({"mcap", "lz4", "zstandard"}),
    "parquet": frozenset({"pyarrow"}),
}
"""Import names of the packages of each extra."""


@contextmanager
def require(*extras: str) -> Iterator[None]:
    """Raise an error that names the install command if an import inside this context finds no package of the extras.

    Args:
        extras: Names of the extras in pyproject.toml.

    Raises:
        MissingExtra: If a package of the extras is not installed. Any other failed import is not changed.

    Example:
        >>> with require("simulate"):
        ...     from isocharge.simulate import load_sensor
    """
    try:
        yield
    except (ModuleNotFoundError, MissingExtra) as error:
        package = (error.name or "").partition(".")[0]  # the package of the missing module
        if not any(package in PACKAGES[extra] for extra in extras):
            raise
        raise MissingExtra(
            f"this needs the package {package!r}, which is not installed; pip install 'isocharge[{','.join(extras)}]'",
            name=package,
        ) from error
