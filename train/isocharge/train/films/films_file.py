"""Writer and reader of `films.npz`, a file in a version folder that contains a network for all films.

    about              JSON: format, sensor, probe, spread, domain, activation, noise
    family.*           the forward maps of the films (`FilmFamily.to_arrays`)
    contact.*          weights of the contact network, integers of `BITS` bits, with their scales
    misfit.*           weights of the misfit network
    mean, whitening    mean and whitening matrix of the inputs
    sha256             checksum of all arrays above

The weights are rounded to `BITS` bits. The rounding makes the file smaller, because the removed bits are nearly random
and could not be compressed.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.common.activations import ACTIVATIONS, TANH, Activation
from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, ModelError
from isocharge.common.files import sha256_of
from isocharge.common.npz import DAMAGED_FILE_ERRORS, npz_arrays
from isocharge.serve.model.companion_files import read_companion_file
from isocharge.simulate import Circle, Domain, NoiseModel
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.sensor.film_prior import FilmPrior, FilmSpread
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.films.films_model import ConditionalWeights, FilmsModel

FILE = "films.npz"
"""Name of the file of a network for all films in a version folder."""

FORMAT = 1
"""Version of the file's format."""

BITS = 14
"""Number of bits of a rounded weight, including its sign."""

FILE_UNITS = {"pretension": 1e6, "shift": 1e-3, "probe_radius": 1e-3}
"""Factors that convert quantities from MPa and mm to the units of the file, Pa and m, by the name of the quantity."""

COULOMB_PER_PC = 1e-12
"""Factor that converts the white noise from pC to the unit of the file, C."""

MAX_LAYER_WIDTH = 2048
"""Largest number of nodes of a layer that is accepted from a file."""

MIN_LARGEST_WEIGHT = 1e-30
"""Lower limit of the largest magnitude in a row of weights, so that the scale of a row of zeros is positive."""

ADVICE = "copy the model's folder again, or train it again (isocharge train fit --films)"
"""Part of the error message about a damaged file that states what the user can do."""


def films_bytes(films: FilmsModel) -> bytes:
    """Return the content of the file `films.npz` for a network.

    Args:
        films: The network for all films.
    """
    arrays = {
        "about": np.array(json.dumps(_about_table(films), allow_nan=False)),
        "mean": films.mean,
        "whitening": films.whitening,
        **{f"family.{name}": np.asarray(value) for name, value in films.family.to_arrays().items()},
        **_pack_weights("contact", films.contact.arrays),
        **_pack_weights("misfit", films.misfit.arrays),
    }
    checksum = np.array(_checksum(arrays))
    return _npz({**arrays, "sha256": checksum})


def read_films(version_folder: Path) -> FilmsModel:
    """Read the network for all films from the version folder of a model.

    Args:
        version_folder: The folder that contains `model.onnx` and the file, as `find_model` returns it.

    Raises:
        ModelError: If the file is missing or damaged, or has another format.
    """
    advice = "expected the version folder of a model for all films, as `isocharge train fit --films` writes it"
    data = read_companion_file(version_folder, FILE, advice)
    return films_from_bytes(data, str(version_folder / FILE))


def films_from_bytes(data: bytes, where: str) -> FilmsModel:
    """Read a network for all films from the content of its file.

    Args:
        data: Content of the file.
        where: Name of the file, for error messages.

    Raises:
        ModelError: If the file is damaged or has another format.
    """
    try:
        arrays = _checked_arrays(data)
        about = json.loads(str(arrays["about"]))
        if about["format"] != FORMAT:
            raise ModelError(f"{where}: format {about['format']} is not supported (this version reads {FORMAT})")
        return _model_from_arrays(about, arrays, sha256_of(data))
    except ModelError:  # a subclass of ValueError, which the next clause would report as damage
        raise
    except DAMAGED_FILE_ERRORS as error:
        raise ModelError(f"{where}: damaged ({type(error).__name__}: {error}); {ADVICE}") from error


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return the content of an npz file with LZMA compression.

    The file is smaller than an npz file with the usual compression.

    Args:
        arrays: The arrays by name.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_LZMA) as file:
        for name, array in arrays.items():
            with file.open(f"{name}.npy", "w") as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
    return buffer.getvalue()


def _checked_arrays(data: bytes) -> dict[str, np.ndarray]:
    """Read and check the arrays of a file, and return them by name, without the checksum.

    Args:
        data: Content of the file.

    Raises:
        ValueError: If the stored checksum differs from that of the arrays, or if an array contains neither a text nor
            finite real numbers.
    """
    arrays = npz_arrays(data)
    expected = str(arrays.pop("sha256"))
    actual = _checksum(arrays)
    if actual != expected:
        raise ValueError(f"expected the checksum {expected:.12}..., got {actual:.12}...")
    for name, array in arrays.items():
        is_text = array.dtype.kind == "U" and array.ndim == 0
        is_real = array.dtype.kind in "fiu"  # floating-point numbers, integers and unsigned integers
        is_finite = is_real and bool(np.isfinite(array).all())
        if not (is_text or is_finite):
            raise ValueError(f"{name}: expected a text or finite real numbers, got {array.dtype}")
    return arrays


def _checksum(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 checksum of the names, types, shapes and values of arrays.

    Args:
        arrays: The arrays by name.
    """
    checksum = hashlib.sha256()
    for name in sorted(arrays):
        array = arrays[name]
        checksum.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        checksum.update(array.tobytes())
    return checksum.hexdigest()


def _about_table(films: FilmsModel) -> dict[str, Any]:
    """Return the JSON object that describes the films, the domain, the noise and the activation of a network.

    The numbers are converted into the units of the file. The object has an entry for the activation only if the
    activation is not tanh.

    Args:
        films: The network for all films.
    """
    prior = films.prior
    activation = films.contact.activation
    # Standard deviations of the parameters of the films, by name
    spread = {name: _converted(value, FILE_UNITS.get(name, 1.0)) for name, value in asdict(prior.spread).items()}
    about = {
        "format": FORMAT,
        "sensor": sensor_to_dict(prior.sensor),
        "probe_radius": _converted(prior.probe.radius, FILE_UNITS["probe_radius"]),
        "spread": spread,
        "radius_mm": films.domain.radius,
        "force_range_N": list(films.domain.force_range),
        "noise": {**asdict(films.noise), "white": _converted(films.noise.white, COULOMB_PER_PC)},
    }
    if activation != TANH:
        about["activation"] = activation.name
    return about


def _model_from_arrays(about: dict[str, Any], arrays: Mapping[str, np.ndarray], sha256: str) -> FilmsModel:
    """Create a network for all films from the JSON object and the arrays of its file.

    The numbers of the JSON object are converted from the units of the file. The function is the inverse of
    `_about_table` and `_pack_weights`.

    Args:
        about: The JSON object of the file.
        arrays: Arrays of the file by name.
        sha256: Checksum of the file.

    Raises:
        InputError: If the sensor, the inputs and the weights in the file do not fit together.
    """
    spread = {name: _converted(value, 1.0 / FILE_UNITS.get(name, 1.0)) for name, value in about["spread"].items()}
    probe = Circle(_converted(about["probe_radius"], 1.0 / FILE_UNITS["probe_radius"]))
    prior = FilmPrior(sensor_from_dict(about["sensor"]), probe, FilmSpread(**spread))
    noise_table = about["noise"]
    noise = NoiseModel(**{**noise_table, "white": _converted(noise_table["white"], 1.0 / COULOMB_PER_PC)})
    min_force, max_force = about["force_range_N"]
    domain = Domain(float(about["radius_mm"]), (float(min_force), float(max_force)))
    activation = ACTIVATIONS[about.get("activation", TANH.name)]
    films = FilmsModel(
        family=FilmFamily.from_arrays(_arrays_of_part(arrays, "family")),
        scaling=FilmScaling(prior, domain),
        mean=arrays["mean"],
        whitening=arrays["whitening"],
        contact=_unpack_weights(_arrays_of_part(arrays, "contact"), activation),
        misfit=_unpack_weights(_arrays_of_part(arrays, "misfit"), activation),
        noise=noise,
        sha256=sha256,
    )

    n_electrode = len(prior.sensor.electrodes)
    if films.mean.shape != (n_electrode,) or films.whitening.shape != (n_electrode, n_electrode):
        raise InputError(f"inputs of {films.mean.size} electrodes, a sensor with {n_electrode}")
    films.fold(prior.mean)  # raises an error if the weights do not fit together
    return films


def _converted(value: float, factor: float) -> float:
    """Convert a number to another unit: multiply it by a factor, and round the product to 15 digits.

    A number with at most 15 digits is therefore unchanged after a conversion to another unit and back. If the factor is
    1, the number is returned without rounding.
    """
    if factor == 1.0:
        return value
    return float(f"{factor * value:.15g}")


def _arrays_of_part(arrays: Mapping[str, np.ndarray], part: str) -> dict[str, np.ndarray]:
    """Return the arrays of one part of the file by name. The names do not contain the prefix of the part."""
    prefix = f"{part}."
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _pack_weights(part: str, weights: Mapping[str, Array]) -> dict[str, np.ndarray]:
    """Round weights to integers, with one scale for each row of an array.

    The rows extend along the last axis. A weight is approximately its integer times the scale of its row. The scale of
    a row converts the largest magnitude in the row into the largest integer of `BITS` bits.

    Args:
        part: Name of the part of the file.
        weights: Arrays of weights by name.

    Returns:
        Integers and scales by their names in the file.
    """
    largest_integer = 2 ** (BITS - 1) - 1  # one bit is the sign
    packed: dict[str, np.ndarray] = {}
    for name, values in weights.items():
        # The lower limit avoids a division by zero for a row of zeros.
        row_largest = np.maximum(np.abs(values).max(axis=-1, keepdims=True), MIN_LARGEST_WEIGHT)
        scale = (row_largest / largest_integer).astype(np.float32)
        packed[f"{part}.{name}"] = np.round(values / scale).astype(np.int16)
        packed[f"{part}.{name}.scale"] = scale
    return packed


def _unpack_weights(packed: Mapping[str, np.ndarray], activation: Activation) -> ConditionalWeights:
    """Convert the rounded weights in a file into the weights of a network. This is the inverse of `_pack_weights`.

    Args:
        packed: Integers and scales by their names in the part of the file. The name of a scale ends with ".scale".
        activation: Activation of the hidden layers.

    Raises:
        ValueError: If a layer is wider than `MAX_LAYER_WIDTH`.
    """
    names = [name for name in packed if not name.endswith(".scale")]
    for name in names:
        largest_dimension = max(packed[name].shape, default=1)  # an array without dimensions is a single number
        if largest_dimension > MAX_LAYER_WIDTH:
            raise ValueError(f"{name}: expected layers of at most {MAX_LAYER_WIDTH} nodes, got {packed[name].shape}")
    arrays = {name: packed[name] * packed[f"{name}.scale"].astype(float) for name in names}
    return ConditionalWeights(arrays, activation)
