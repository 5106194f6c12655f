"""Packages of the extras in pyproject.toml, and the error that is raised if an extra is not installed."""

from collections.abc import Iterator
from contextlib import contextmanager

from isocharge.common.errors import MissingExtra

SIMULATE = frozenset({"scipy", "threadpoolctl", "matplotlib", "contourpy", "shapely"})
HTTP = frozenset({"uvicorn", "uvloop", "httptools", "orjson", "prometheus_client"})
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
    """If an import in the `with` block fails, raise an error with the command that installs the extras.

    Args:
        extras: Names of the extras in pyproject.toml. `PACKAGES` contains the packages of each extra.

    Raises:
        MissingExtra: If an import in the block fails because a package of the extras is not installed. If an import
            fails for any other reason, its error is not changed.

    Example:
        >>> with require("simulate"):
        ...     from isocharge.simulate import load_sensor
    """
    try:
        yield
    except (ModuleNotFoundError, MissingExtra) as error:  # another `require` inside the block may raise MissingExtra
        missing_module = error.name or ""
        package = missing_module.partition(".")[0]  # for example "google" for the module "google.protobuf"
        is_package_of_extras = any(package in PACKAGES[extra] for extra in extras)
        if not is_package_of_extras:
            raise
        raise MissingExtra(
            f"this needs the package {package!r}, which is not installed; pip install 'isocharge[{','.join(extras)}]'",
            name=package,
        ) from error
