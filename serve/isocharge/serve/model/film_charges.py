"""Charges of a calibrated film at several pretensions, and the file `film_charges.npz` that contains them.

A service that follows the pretension of a film compares the charges of touches with the charges of the film at many
pretensions. The logarithm of each charge is a Chebyshev series in the contact, as in the module `charge_series`. The
file contains one series for each of several pretensions, which are called nodes. At other pretensions, the coefficients
are interpolated by a polynomial in the pretension. The file contains the following arrays:

    series       coefficients of ln Q, shape (n_node, degree + 1, degree + 1, force_degree + 1, n_electrode)
    node_MPa     pretensions of the nodes in ascending order, shape (n_node,), MPa
    radius_mm    largest distance of a contact from the centre, mm
    force_N      smallest and largest force, N
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.chebyshev_series import SeriesStack
from isocharge.common.errors import ModelError, cut
from isocharge.common.npz import DAMAGED_FILE_ERRORS, finite_array, npz_arrays
from isocharge.serve.model.companion_files import read_companion_file
from isocharge.serve.model.contact_range import clipped_unit_contact, read_contact_range
from isocharge.serve.model.pretension_nodes import check_nodes, interpolation_weights

FILE = "film_charges.npz"
"""Name of the file in a version folder."""

ADVICE = "copy the model's folder again, or calibrate again"
"""Advice to the user if a file is damaged, for error messages."""

MAX_DEGREE = 30
"""Largest degree of the series in a file."""

MAX_LOG_CHARGE = 100.0
"""Largest magnitude of ln Q, where Q is a charge in pC. The charges of calibrated films are between 0.01 and 1e5 pC."""


@dataclass(frozen=True)
class FilmChargeSeries:
    """Charges of a calibrated film as functions of the contact, at several pretensions.

    Attributes:
        node_MPa: Pretensions for which there are series (nodes), in ascending order, shape (n_node,), MPa.
        coefficients: Coefficients of the series of ln Q, shape (n_node, degree + 1, degree + 1, force_degree + 1,
            n_electrode).
        radius_mm: Largest distance of a contact from the centre, mm.
        force_N: Smallest and largest force, N.
    """

    node_MPa: Array
    coefficients: Array
    radius_mm: float
    force_N: tuple[float, float]

    @cached_property
    def _series(self) -> SeriesStack:
        """Series of ln Q, one for each node."""
        return SeriesStack(self.coefficients)

    def interpolated(self, pretension_MPa: Array) -> "FilmChargeSeries":
        """Return the charges with series that are interpolated to other pretensions, which become the nodes.

        Args:
            pretension_MPa: The other pretensions, shape (n,), MPa, in ascending order.
        """
        weights = interpolation_weights(self.node_MPa, pretension_MPa)  # shape (n, n_node)
        coefficients = np.tensordot(weights, self.coefficients, axes=1)
        return replace(self, node_MPa=pretension_MPa, coefficients=coefficients)

    def unit_contact(self, contacts: Array) -> Array:
        """Convert contacts (x, y, F), shape (n, 3), to coordinates of the series; see `clipped_unit_contact`."""
        return clipped_unit_contact(contacts, self.radius_mm, self.force_N)

    def charges(self, unit_contact: Array) -> tuple[Array, Array]:
        """Compute the charges of contacts, and their derivatives with respect to the coordinates of the series.

        The contacts may differ from node to node.

        Args:
            unit_contact: Contacts in the coordinates of the series, shape (n_node, m, 3).

        Returns:
            Charges, shape (n_node, m, n_electrode), pC, and their derivatives, shape (n_node, m, n_electrode, 3), pC.
        """
        values = self._series.values_and_derivatives(unit_contact)  # shape (n_node, m, 4, n_electrode)
        charge_pC = np.exp(values[:, :, 0])
        log_slopes = values[:, :, 1:].swapaxes(2, 3)  # derivatives of ln Q, shape (n_node, m, n_electrode, 3)
        return charge_pC, charge_pC[..., None] * log_slopes  # dQ = Q d(ln Q)

    def to_bytes(self) -> bytes:
        """Return the content of the file `film_charges.npz`."""
        file = io.BytesIO()
        np.savez_compressed(
            file,
            series=self.coefficients.astype(np.float32),
            node_MPa=self.node_MPa,
            radius_mm=np.array(self.radius_mm),
            force_N=np.array(self.force_N),
        )
        return file.getvalue()


def read_film_charges(version_folder: Path, n_electrode: int) -> FilmChargeSeries | None:
    """Read the charges of a calibrated film from the file `film_charges.npz` of its model.

    Models that were calibrated by an earlier version of isocharge have no such file.

    Args:
        version_folder: Folder of the model, which contains `model.onnx`.
        n_electrode: Number of electrodes of the model.

    Returns:
        The charges, or None if the file does not exist.

    Raises:
        ModelError: If the file is damaged or belongs to another model.
    """
    path = version_folder / FILE
    if not path.exists():
        return None
    data = read_companion_file(version_folder, FILE, ADVICE)
    try:
        return _film_charges(npz_arrays(data), n_electrode)
    except DAMAGED_FILE_ERRORS as error:
        raise ModelError(f"{path}: {cut(str(error))}; {ADVICE}") from error


def _film_charges(arrays: Mapping[str, np.ndarray], n_electrode: int) -> FilmChargeSeries:
    """Check the arrays of a file, and return the charges that they describe.

    Args:
        arrays: Arrays of the file by name.
        n_electrode: Number of electrodes of the model.

    Raises:
        ValueError: If an array is missing or not valid, or the arrays do not fit together.
    """
    node_MPa = finite_array(arrays, "node_MPa", (None,))
    check_nodes(node_MPa)
    coefficients = finite_array(arrays, "series", (node_MPa.size, None, None, None, n_electrode))
    _n_node, n_x, n_y, n_force, _n_electrode = coefficients.shape
    largest_degree = max(n_x, n_force) - 1  # a series has one coefficient more than its degree
    if n_x != n_y or largest_degree > MAX_DEGREE:
        raise ValueError(
            f"series: expected equal degrees in x and y and degrees up to {MAX_DEGREE}, got the shape "
            f"{coefficients.shape}"
        )

    # The magnitude of a Chebyshev polynomial is at most 1. The magnitude of a series is therefore at most the sum of
    # the magnitudes of its coefficients.
    max_log_charges = np.abs(coefficients).sum(axis=(1, 2, 3))  # shape (n_node, n_electrode)
    largest_log_charge = float(max_log_charges.max())
    if largest_log_charge > MAX_LOG_CHARGE:
        raise ValueError(f"series: expected values of ln Q up to {MAX_LOG_CHARGE:g}, got up to {largest_log_charge:g}")
    radius_mm, force_N = read_contact_range(arrays)
    return FilmChargeSeries(node_MPa, coefficients, radius_mm, force_N)
