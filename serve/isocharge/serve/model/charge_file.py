"""File `charges.npz` of a model, which contains a compact charge map.

The file is in the same folder as `model.onnx`. It contains these arrays, with the symbols of the module
`charge_series`:

    format           version of the format
    series           coefficients c, shape (n_node, degree + 1, degree + 1, force_degree + 1, n_electrode)
    node_MPa         values of t at the nodes, shape (n_node,), MPa
    directions       coefficients of d and d', shape (degree + 1, degree + 1, force_degree + 1, 2, K, n_electrode); may
                     be missing if K = 0. The degrees may differ from those of `series`
    log_size         Chebyshev coefficients of ln S as a function of l; missing if all charges are positive
    radius_mm        radius r of the domain, mm
    force_N          smallest and largest force of the domain, N
    is_folded        1 if the map has a fold, otherwise 0
    charge_std       see `ChargeSeries`
    offset_pC        charges that are added to Q, shape (n_electrode,) or one for all, pC, for example because of a
                     wrong tare
    pretension_MPa   see `ChargeSeries`
    tension_std_MPa  see `ChargeSeries`
"""

import io
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.common.arrays import npz_arrays
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import ModelError, cut
from isocharge.common.files import read_needed
from isocharge.serve.model.charge_series import NO_DIRECTIONS, ChargeSeries

FILE = "charges.npz"
"""Name of the file in a version folder."""

FORMAT = 3
"""Version of the format of the file. Files of the first version contain no version."""

ADVICE = "copy the model's folder again, or calibrate or train again"
"""What the user can do about a damaged file, for error messages."""

NUMBERS = ("charge_std", "offset_pC", "pretension_MPa", "tension_std_MPa")
"""Arrays for attributes of `ChargeSeries` that are one number or, for `offset_pC`, one number for each electrode."""


def charge_map_bytes(series: ChargeSeries) -> bytes:
    """Return the content of the file `charges.npz` for a charge map, which is a Chebyshev series in the contact.

    The arrays of coefficients with many elements are stored in single precision. `NUMBERS` contains the names of the
    attributes that are one number, or one number for each electrode, such as "charge_std".
    """
    arrays: dict[str, Any] = {
        "format": FORMAT,
        "series": series.coefficients.astype(np.float32),
        "node_MPa": series.node_MPa,
        "directions": series.directions.astype(np.float32),
        "radius_mm": series.domain.radius,
        "force_N": series.domain.force_range,
        "is_folded": int(series.is_folded),
    }
    arrays |= {name: getattr(series, name) for name in NUMBERS}
    if series.log_size is not None:  # coefficients of the logarithm of the typical charge; None if all are positive
        arrays["log_size"] = series.log_size
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def read_charge_map(version_folder: Path, electrodes: tuple[str, ...]) -> ChargeSeries | None:
    """Read the charge map in the file `charges.npz` of a model. Return None if the model has no such file.

    The numbers are not checked. When a model is loaded, the file is compared with its checksum in `golden.json`.
    `NUMBERS` contains the names of the attributes that are one number, or one number for each electrode.

    Args:
        version_folder: Folder of the model, which contains `model.onnx`.
        electrodes: Names of the electrodes of the model.

    Raises:
        ModelError: If the file cannot be read, is not an npz file, has another format, or belongs to a model with other
            electrodes.
    """
    path = version_folder / FILE
    if not path.exists():
        return None
    data = read_needed(path, ModelError, ADVICE)
    try:
        arrays: dict[str, Any] = npz_arrays(data)
        file_format = arrays.get("format", 1)  # files of the first version contain no version
        if file_format != FORMAT:
            raise ValueError(f"format {file_format} is not supported (this version reads {FORMAT})")
        coefficients = arrays["series"]
        if coefficients.shape[-1] != len(electrodes):
            raise ValueError(f"series: expected charges of {electrodes}, got an array of shape {coefficients.shape}")
        return ChargeSeries(
            domain=Domain(float(arrays["radius_mm"]), tuple(arrays["force_N"].tolist())),
            electrodes=electrodes,
            coefficients=coefficients.astype(float),
            node_MPa=arrays["node_MPa"],
            directions=arrays.get("directions", NO_DIRECTIONS).astype(float),  # by default, an array without directions
            log_size=arrays.get("log_size"),  # None if all charges are positive
            is_folded=bool(arrays["is_folded"]),
            **{name: arrays[name][()] for name in NUMBERS},  # a number instead of an array of shape ()
        )
    except (ValueError, KeyError) as error:
        raise ModelError(f"{path}: {cut(str(error))}; {ADVICE}") from error
