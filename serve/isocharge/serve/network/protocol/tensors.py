"""Tensors of a request as charges: their names, number types, shapes and parameters, however they were carried.

`charges_of` and `outputs_of` read a request in JSON; gRPC's messages are read with the functions below them.
"""

import struct
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Singles
from isocharge.common.errors import RequestError, TooLarge
from isocharge.serve.model.charges import as_singles, write_finite
from isocharge.serve.model.session import INPUT, OUTPUTS

UNSUPPORTED = ("shared_memory_region", "classification")
"""Parameters of Triton that change what a request means and that this server does not know."""


def parameters_of(holder: dict[str, Any]) -> dict[str, Any]:
    """The parameters of a request, input or output; unknown ones are ignored, as Triton does.

    Raises:
        RequestError: If they are no object, or one of them is not supported.
    """
    parameters = holder.get("parameters")
    if parameters is None:
        return {}
    if not isinstance(parameters, dict):
        raise RequestError(f"parameters: expected an object, got {parameters!r:.100}")
    for name in UNSUPPORTED:
        if parameters.get(name):
            raise RequestError(f"parameters: {name!r} is not supported by this server")
    return parameters


def flag(holder: dict[str, Any], name: str, *, default: bool) -> bool:
    """A yes or no among the parameters.

    Raises:
        RequestError: If it is neither true nor false.
    """
    value = parameters_of(holder).get(name, default)
    if not isinstance(value, bool):
        raise RequestError(f"the parameter {name!r}: expected true or false, got {value!r:.100}")
    return value


DATATYPES: dict[str, np.dtype[Any]] = {"FP32": np.dtype("<f4"), "FP64": np.dtype("<f8")}
"""Number types of charges, little-endian as the protocol has them."""


ALL_OUTPUTS = tuple(OUTPUTS)
"""The outputs of a request that names none."""


def charges_of(tensor: dict[str, Any], binary: memoryview, electrodes: tuple[str, ...], batch: int) -> Singles:
    """Charges, shape (n, electrodes), pC, of the input tensor of a request in JSON.

    Args:
        tensor: The input as it came.
        binary: The bytes after the JSON; its numbers, if the tensor announces them.
        electrodes: Names of the model's electrodes.
        batch: Presses that one request may have.

    Raises:
        RequestError: If the tensor is not what the model takes.
        TooLarge: If there are more presses than `batch`.
        ChargeError: If a charge is not finite.
    """
    head = check_head(tensor.get("name"), tensor.get("datatype"), tensor.get("shape"), electrodes, batch)
    size = parameters_of(tensor).get("binary_data_size")
    if size is None and not binary:
        return charges_from_values(tensor.get("data"), head, electrodes)
    if type(size) is not int or size != len(binary) or "data" in tensor:
        raise RequestError(
            f"expected either `data` or {head.nbytes} bytes after the JSON, announced by `binary_data_size` of the "
            f"input and Inference-Header-Content-Length, got binary_data_size {size!r:.50} and {len(binary)} bytes"
        )
    return charges_from_bytes(binary, head, electrodes)


def outputs_of(outputs: list[Any], *, all_binary: bool) -> tuple[tuple[str, ...], frozenset[str]]:
    """Names of the outputs that a request in JSON asks for, and those of them that it wants in binary.

    Args:
        outputs: The list of the request; empty for all outputs.
        all_binary: Whether an output is sent in binary that does not say how.

    Raises:
        RequestError: If an output is unknown, asked for twice, or no object.
    """
    if not outputs:
        return ALL_OUTPUTS, frozenset(ALL_OUTPUTS if all_binary else ())
    if not all(isinstance(output, dict) for output in outputs):
        raise RequestError(f"expected `outputs`, a list of objects with a name, got {outputs!r:.100}")
    names = check_outputs([output.get("name") for output in outputs])
    return names, frozenset(output["name"] for output in outputs if flag(output, "binary_data", default=all_binary))


class Head(NamedTuple):
    """What a request says about its one input, checked: number type and shape (n, electrodes)."""

    dtype: np.dtype[Any]
    shape: tuple[int, int]

    @property
    def nbytes(self) -> int:
        """Size of its numbers in binary."""
        return self.shape[0] * self.shape[1] * self.dtype.itemsize


def check_head(name: Any, datatype: Any, shape: Any, electrodes: tuple[str, ...], batch: int) -> Head:
    """Check what a request says about its input before anything of that size is touched.

    Args:
        name, datatype, shape: As they came.
        electrodes: Names of the model's electrodes.
        batch: Presses that one request may have.

    Raises:
        RequestError: If one is not what the model takes.
        TooLarge: If there are more presses than `batch`.
    """
    if name != INPUT:
        raise RequestError(f"expected one input named {INPUT!r}, got {name!r:.100}")
    if not isinstance(datatype, str) or datatype not in DATATYPES:
        raise RequestError(f"input {INPUT!r}: expected the datatype FP32 or FP64, got {datatype!r:.100}")
    if not _is_shape(shape, len(electrodes)):
        raise RequestError(
            f"input {INPUT!r}: expected the shape [n, {len(electrodes)}] with n > 0, "
            f"a column for each of {electrodes}, got {shape!r:.100}"
        )
    if shape[0] > batch:
        raise TooLarge(f"input {INPUT!r}: expected at most {batch} presses in one request, got {shape[0]}")
    return Head(DATATYPES[datatype], (shape[0], shape[1]))


def _is_shape(shape: Any, width: int) -> bool:
    if type(shape) is not list or len(shape) != 2:
        return False
    rows, columns = shape
    return type(rows) is int and type(columns) is int and rows > 0 and columns == width


def charges_from_bytes(raw: bytes | memoryview, head: Head, electrodes: tuple[str, ...]) -> Singles:
    """Charges, shape (n, electrodes), pC, from little-endian numbers row by row.

    Raises:
        RequestError: If the bytes are fewer or more than the shape says.
        ChargeError: If a charge is not finite.
    """
    if len(raw) != head.nbytes:
        raise RequestError(
            f"input {INPUT!r}: expected {head.nbytes} bytes of binary data for the shape {list(head.shape)} "
            f"of {head.dtype.itemsize} bytes each, got {len(raw)}"
        )
    # A copy: what follows a JSON text may lie at any address, and a runtime expects numbers at even ones.
    return as_singles(np.frombuffer(raw, head.dtype).reshape(head.shape).copy(), electrodes)


def charges_from_values(values: Any, head: Head, electrodes: tuple[str, ...]) -> Singles:
    """Charges, shape (n, electrodes), pC, from a list of numbers, flat or nested as the shape.

    Raises:
        RequestError: If there are no numbers, or not as many as the shape says.
        ChargeError: If a charge is not finite.
    """
    rows, columns = head.shape
    # struct is several times faster than making and testing arrays, for a few numbers; it takes True as 1.0, so a list
    # that holds one or the other is looked at below.
    if type(values) is list and len(values) == rows * columns and not (True in values or False in values):
        charges = np.empty(head.shape, np.float32)
        if write_finite(partial(_packer(len(values)), charges.data, 0), values):
            return charges
    return _examined(values, head, electrodes)


@lru_cache(64)
def _packer(count: int) -> Callable[..., None]:
    """Packs this many float32 numbers into a buffer."""
    return struct.Struct(f"={count}f").pack_into


def _examined(values: Any, head: Head, electrodes: tuple[str, ...]) -> Singles:
    """Charges from values that may be rows of numbers; the error says what is wrong with others."""
    if type(values) is not list:
        raise RequestError(f"input {INPUT!r}: expected `data`, a list of numbers, got {values!r:.100}")
    try:
        numbers = np.asarray(values)
    except (ValueError, OverflowError) as error:
        raise RequestError(f"input {INPUT!r}: expected a list of numbers, or rows of them ({error})") from error
    rows, columns = head.shape
    fits = numbers.dtype.kind in "fiu" and numbers.shape in ((rows * columns,), head.shape)
    if not fits or _has_booleans(values):
        raise RequestError(
            f"input {INPUT!r}: expected numbers for the shape {list(head.shape)}, flat or in rows, "
            f"got {numbers.dtype if not fits else 'true or false'} of shape {list(numbers.shape)}"
        )
    return as_singles(numbers.reshape(head.shape), electrodes)


def _has_booleans(values: list[Any]) -> bool:
    """Whether a list, or a list of lists, has true or false in it, which arrays take for 1 and 0."""
    return any(type(value) is bool or (type(value) is list and any(type(q) is bool for q in value)) for value in values)


def check_outputs(names: Sequence[Any]) -> tuple[str, ...]:
    """The outputs that a request asks for, in its order; all of them if it names none.

    Raises:
        RequestError: If one is unknown, or asked for twice.
    """
    for name in names:
        if not isinstance(name, str) or name not in OUTPUTS:
            raise RequestError(f"expected outputs out of {list(OUTPUTS)}, got {name!r:.100}")
    if len(set(names)) < len(names):
        raise RequestError(f"expected each output once, got {list(names)!r:.200}")
    return tuple(names) or ALL_OUTPUTS
