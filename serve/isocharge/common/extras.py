"""Optional parts: an import that fails because an extra is not installed says which one, and how to get it."""

from collections.abc import Iterator
from contextlib import contextmanager

from isocharge.common.errors import MissingExtra

SIMULATE = frozenset({"scipy", "threadpoolctl", "matplotlib", "contourpy"})
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
"""Import names that come with an extra of pyproject.toml."""


@contextmanager
def require(extra: str) -> Iterator[None]:
    """Import inside this context what needs an extra.

    Args:
        extra: Its name in pyproject.toml.

    Raises:
        MissingExtra: If one of its packages is not installed; any other failed import passes through.

    Example:
        >>> with require("simulate"):
        ...     from isocharge.simulate import load_sensor
    """
    try:
        yield
    except (ModuleNotFoundError, MissingExtra) as error:
        package = (error.name or "").partition(".")[0]
        if package not in PACKAGES[extra]:
            raise
        raise MissingExtra(
            f"this needs the package {package!r}, which is not installed; pip install 'isocharge[{extra}]'",
            name=package,
        ) from error
