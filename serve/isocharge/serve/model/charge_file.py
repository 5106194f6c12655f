"""File `charges.npz` of a model, which contains a compact charge map.

The file is in the same folder as `model.onnx`. It contains these arrays, with the symbols of the module
`charge_series`:

    format           version of the format
    series           coefficients c, shape (n_node, degree + 1, degree + 1, force_degree + 1, n_electrode)
    node_MPa         values of t at the nodes, shape (n_node,), MPa
    directions       coefficients of d, shape (degree + 1, degree + 1, force_degree + 1, K, n_electrode); missing if
                     K = 0. The degrees may differ from those of `series`
    log_size         Chebyshev coefficients of ln S as a function of l; missing if all charges are positive
    radius_mm        radius r of the domain, mm
    force_N          smallest and largest force of the domain, N
    is_folded        1 if the map has a fold, otherwise 0
    charge_std       see `ChargeSeries`
    offset_pC        charge that is added to Q of each electrode, pC, for example because of a wrong tare
    pretension_MPa   see `ChargeSeries`
    tension_std_MPa  see `ChargeSeries`
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import ModelError, cut
from isocharge.common.npz import finite_array, finite_number, npz_arrays
from isocharge.serve.model.charge_series import MAX_VALUE, ChargeSeries
from isocharge.serve.model.golden import read_companion_file

FILE = "charges.npz"
"""Name of the file in a version folder."""

FORMAT = 2
"""Version of the format of the file. Files of the first version contain no version."""

ADVICE = "copy the model's folder again, or calibrate or train again"
"""What the user can do about a damaged file, for error messages."""

MAX_DEGREE = 100
"""Largest degree of a series in a file."""

MAX_NODES = 50
"""Largest number of nodes in a file."""

MAX_DIRECTIONS = 100
"""Largest number of directions in a file."""

MAX_PRETENSION_MPa = 50.0
"""Largest magnitude of the numbers in MPa in a file."""

MAX_OFFSET_pC = 1e5
"""Largest magnitude of the offset in a file, pC."""

MIN_NODE_DISTANCE_MPa = 1e-3
"""Smallest distance between two nodes in a file, MPa."""

MAX_RADIUS_mm = 1e4
"""Largest radius in a file, mm."""


def charge_map_bytes(series: ChargeSeries) -> bytes:
    """Return the content of the file `charges.npz` for a charge map."""
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT),
        "series": series.coefficients.astype(np.float32),
        "node_MPa": series.node_MPa,
        "radius_mm": np.array(series.domain.radius),
        "force_N": np.array(series.domain.force_range),
        "is_folded": np.array(int(series.is_folded)),
        "charge_std": np.array(series.charge_std),
        "offset_pC": np.array(series.offset_pC),
        "pretension_MPa": np.array(series.pretension_MPa),
        "tension_std_MPa": np.array(series.tension_std_MPa),
    }
    if series.direction_count > 0:
        assert series.directions is not None
        arrays["directions"] = series.directions.astype(np.float32)
    if series.log_size is not None:
        arrays["log_size"] = series.log_size
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def read_charge_map(version_folder: Path, electrodes: tuple[str, ...]) -> ChargeSeries | None:
    """Read the charge map in the file `charges.npz` of a model. Return None if the model has no such file.

    Args:
        version_folder: Folder of the model, which contains `model.onnx`.
        electrodes: Names of the electrodes of the model.

    Raises:
        ModelError: If the file is damaged, has another format, belongs to another model, or does not describe the
            charges of contacts.
    """
    path = version_folder / FILE
    if not path.exists():
        return None
    return charge_map_from_bytes(read_companion_file(version_folder, FILE, ADVICE), electrodes, str(path))


def charge_map_from_bytes(data: bytes, electrodes: tuple[str, ...], where: str = FILE) -> ChargeSeries:
    """Create the charge map from the content of a file `charges.npz`, and check the map.

    Args:
        data: Content of the file.
        electrodes: Names of the electrodes of the model.
        where: Path of the file, for the error message.

    Raises:
        ModelError: If the file is damaged, has another format, or does not describe the charges of contacts.
    """
    try:
        return _charges_from_arrays(npz_arrays(data), electrodes)
    except (ValueError, TypeError) as error:  # TypeError: the format is not a single number
        raise ModelError(f"{where}: {cut(str(error))}; {ADVICE}") from error


def _charges_from_arrays(arrays: Mapping[str, np.ndarray], electrodes: tuple[str, ...]) -> ChargeSeries:
    """Create the charge map from the arrays of a file, and check the map.

    Args:
        arrays: Arrays of the file by name.
        electrodes: Names of the electrodes of the model.

    Raises:
        ValueError: If an array is missing or not valid, or the arrays do not fit together.
    """
    file_format = int(arrays["format"]) if "format" in arrays else 1
    if file_format != FORMAT:
        raise ValueError(f"format {file_format} is not supported (this version reads {FORMAT})")
    node_MPa = finite_array(arrays, "node_MPa", (None,))
    gaps_MPa = np.diff(node_MPa)
    if not (
        node_MPa.size <= MAX_NODES
        and 0.0 in node_MPa
        and (gaps_MPa >= MIN_NODE_DISTANCE_MPa).all()
        and np.abs(node_MPa).max() <= MAX_PRETENSION_MPa
    ):
        raise ValueError(
            f"node_MPa: expected up to {MAX_NODES} rising changes up to {MAX_PRETENSION_MPa:g} MPa with 0 among them, "
            f"got {cut(str(node_MPa))}"
        )
    series = ChargeSeries(
        domain=_read_domain(arrays),
        electrodes=electrodes,
        coefficients=_read_series(arrays, "series", (node_MPa.size, None, None, None, len(electrodes))),
        node_MPa=node_MPa,
        directions=_read_directions(arrays, len(electrodes)),
        log_size=_read_log_size(arrays),
        is_folded=_read_number(arrays, "is_folded", 0.0, 1.0) == 1.0,
        charge_std=_read_number(arrays, "charge_std", 0.0, 1.0),
        offset_pC=_read_number(arrays, "offset_pC", -MAX_OFFSET_pC, MAX_OFFSET_pC),
        pretension_MPa=_read_number(arrays, "pretension_MPa", -MAX_PRETENSION_MPa, MAX_PRETENSION_MPa),
        tension_std_MPa=_read_number(arrays, "tension_std_MPa", 0.0, MAX_PRETENSION_MPa),
    )
    _check_dependence(series)
    return series


def _read_number(arrays: Mapping[str, np.ndarray], name: str, smallest: float, largest: float) -> float:
    """Return the number in an array of a file.

    Raises:
        ValueError: If the array is missing or not a single number, or the number is outside the given range.
    """
    value = finite_number(arrays, name)
    if not smallest <= value <= largest:
        raise ValueError(f"{name}: expected a number from {smallest:g} to {largest:g}, got {value:g}")
    return value


def _read_domain(arrays: Mapping[str, np.ndarray]) -> Domain:
    """Read the contacts for which a map is valid from the arrays `radius_mm` and `force_N` of a file.

    Raises:
        ValueError: If an array is missing or not valid.
    """
    radius_mm = finite_number(arrays, "radius_mm")
    if not 0.0 < radius_mm <= MAX_RADIUS_mm:
        raise ValueError(f"radius_mm: expected a radius up to {MAX_RADIUS_mm:g} mm, got {radius_mm:g}")
    min_force_N, max_force_N = finite_array(arrays, "force_N", (2,)).tolist()
    if not 0.0 < min_force_N <= max_force_N:
        raise ValueError(
            "force_N: expected a smallest force above 0 and a largest force that is not smaller, got "
            f"{min_force_N:g} and {max_force_N:g} N"
        )
    return Domain(radius_mm, (min_force_N, max_force_N))


def _read_series(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int | None, ...]) -> Array:
    """Read the coefficients of Chebyshev series from an array of a file.

    Args:
        arrays: Arrays of the file by name.
        name: Name of the array.
        shape: Expected shape of the coefficients; None stands for any length.

    Raises:
        ValueError: If the array is missing, has another shape or too high degrees, or describes too large values.
    """
    coefficients = finite_array(arrays, name, shape)
    degree_axes = (1, 2, 3) if name == "series" else (0, 1, 2)
    x_degree, y_degree, force_degree = (coefficients.shape[axis] - 1 for axis in degree_axes)
    if x_degree != y_degree or max(x_degree, force_degree) > MAX_DEGREE:
        raise ValueError(
            f"{name}: expected equal degrees in x and y and degrees up to {MAX_DEGREE}, got the shape "
            f"{coefficients.shape}"
        )
    # The magnitude of a Chebyshev polynomial is at most 1. The magnitude of a series is therefore at most the sum of
    # the magnitudes of its coefficients.
    largest_value = float(np.abs(coefficients).sum(axis=degree_axes).max())
    if largest_value > MAX_VALUE:
        raise ValueError(f"{name}: expected values up to {MAX_VALUE:g}, got up to {largest_value:g}")
    return coefficients


def _read_directions(arrays: Mapping[str, np.ndarray], n_electrode: int) -> Array | None:
    """Read the coefficients of the directions from a file, or return None if the file contains no directions.

    Raises:
        ValueError: If the coefficients are not valid.
    """
    if "directions" not in arrays:
        return None
    directions = _read_series(arrays, "directions", (None, None, None, None, n_electrode))
    if directions.shape[3] > MAX_DIRECTIONS:
        raise ValueError(f"directions: expected up to {MAX_DIRECTIONS}, got the shape {directions.shape}")
    return directions


def _read_log_size(arrays: Mapping[str, np.ndarray]) -> Array | None:
    """Read the coefficients of ln S from a file, or return None if all charges of the map are positive.

    Raises:
        ValueError: If the coefficients are not valid.
    """
    if "log_size" not in arrays:
        return None
    log_size = finite_array(arrays, "log_size", (None,))
    if log_size.size > MAX_DEGREE or np.abs(log_size).sum() > MAX_VALUE:
        raise ValueError(f"log_size: expected values up to {MAX_VALUE:g}, got the coefficients {cut(str(log_size))}")
    return log_size


def _check_dependence(series: ChargeSeries) -> None:
    """Check that the charges of the calibrated film depend on x, on y and on the force.

    The force is not checked if the domain has a single force.

    Raises:
        ValueError: If all charges are independent of x, of y or of the force.
    """
    calibrated = series.coefficients[series.node_MPa.searchsorted(0.0)]
    smallest_N, largest_N = series.domain.force_range
    depends_on_force = calibrated[:, :, 1:].any() or series.log_size is not None or smallest_N == largest_N
    if not (calibrated[1:].any() and calibrated[:, 1:].any() and depends_on_force):
        raise ValueError("series: expected charges that change with x, y and the force")
