"""One inference of the Open Inference Protocol.

The steps of an inference read the request, run the model and write the response.

A body is JSON, which may be followed by binary tensors. If there are binary tensors, a header contains the length of
the JSON. The gRPC service converts its messages to the same JSON objects and also uses `parse_request`.
"""

import struct
import time
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
import orjson

from isocharge.common.arrays import Singles
from isocharge.common.errors import RequestError, TooLarge
from isocharge.common.structs import convert
from isocharge.serve.model.session import (
    CORRELATION,
    INPUT,
    as_float32,
    check_output_shapes,
    run,
    run_error,
    write_finite,
)
from isocharge.serve.network.model_store import LoadedVersion
from isocharge.serve.network.protocol.infer_body import InferBody, InputTensor, OutputTensor
from isocharge.serve.prediction.contact import Contacts

DATATYPES: dict[str, np.dtype[Any]] = {"FP32": np.dtype("<f4"), "FP64": np.dtype("<f8")}
"""Number types of charges. The protocol prescribes little-endian numbers."""

FLAGS = "flags"
"""Name of the output with the flags of each press, separated by commas. It is computed only on request."""

MAX_LENGTH_DIGITS = 12
"""Largest number of digits of the length of a JSON text in a header. No body is so long."""

Rows = np.ndarray[Any, Any]
"""Values of an output, shape (n, width): numbers, or texts for the output `flags`."""


class InferRequest(NamedTuple):
    """Charges for a model, and the outputs that the client requests.

    Attributes:
        id: Identifier that is repeated in the response; empty if the request has none.
        charge_pC: Charges, shape (n, electrodes), pC.
        outputs: Names of the requested outputs, in the order of the response.
        binary: Names of the outputs that are sent as binary tensors.
    """

    id: str
    charge_pC: Singles
    outputs: tuple[str, ...]
    binary: frozenset[str]


class InferAnswer(NamedTuple):
    """Outputs of a model for one request.

    Attributes:
        name: Name of the model.
        version: Version of the model.
        id: Identifier from the request.
        outputs: Outputs by name, each of shape (n, width).
        binary: Names of the outputs that are sent as binary tensors.
    """

    name: str
    version: str
    id: str
    outputs: dict[str, Rows]
    binary: frozenset[str]


def read_object(text: bytes) -> dict[str, Any]:
    """Parse a JSON object. An empty text is parsed as an empty object.

    Raises:
        RequestError: If the text is not a JSON object.
    """
    try:
        content = orjson.loads(text) if text else {}
    except orjson.JSONDecodeError as error:
        raise RequestError(f"expected a JSON object, got {len(text)} bytes that are not JSON: {error}") from error
    if not isinstance(content, dict):
        raise RequestError(f"expected a JSON object, got {content!r:.100}")
    return content


def read_infer(body: bytes, header_length: bytes | None, loaded: LoadedVersion, max_presses: int) -> InferRequest:
    """Read a request from the body of an HTTP request.

    Args:
        body: The body, not compressed.
        header_length: Value of the header Inference-Header-Content-Length; None if the request has no binary tensor.
        loaded: The model.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If the body is not a request for this model.
        ChargeError: If a charge is not finite.
        TooLarge: If there are more presses than `max_presses`.
    """
    if header_length is None:
        return parse_request(read_object(body), b"", loaded, max_presses)
    # The digits are tested first, because int() accepts signs, blanks and underscores, and is slow for a long text.
    is_short_number = header_length.isdigit() and len(header_length) <= MAX_LENGTH_DIGITS
    json_length = int(header_length) if is_short_number else None
    if json_length is None or json_length > len(body):
        raise RequestError(
            f"Inference-Header-Content-Length: expected a whole number up to {len(body)}, the bytes of the body, "
            f"got {header_length.decode('latin-1')!r:.50}"
        )
    content = read_object(body[:json_length])
    binary_tensors = memoryview(body)[json_length:]  # a view, because the bytes need not be copied
    return parse_request(content, binary_tensors, loaded, max_presses)


def parse_request(
    content: dict[str, Any], binary: bytes | memoryview, loaded: LoadedVersion, max_presses: int
) -> InferRequest:
    """Parse a request from a JSON object.

    Args:
        content: The object.
        binary: Bytes that follow the JSON. They are the charges if the input has the parameter `binary_data_size`.
        loaded: The model. If the request names no outputs, all outputs of the model are computed.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If the object is not a request for this model.
        ChargeError: If a charge is not finite.
        TooLarge: If there are more presses than `max_presses`.
    """
    body = convert(content, InferBody, where="", error=RequestError)  # the error message needs no file name
    default_is_binary = body.parameters.binary_data_output
    if body.outputs:
        names, binary_names = _requested_outputs(body.outputs, loaded, default_is_binary=default_is_binary)
    else:
        names = loaded.outputs
        binary_names = frozenset(names if default_is_binary else ())
    charges = _read_charges(body.inputs[0], binary, loaded.metadata.electrodes, max_presses)
    return InferRequest(body.id, charges, names, binary_names)


def _requested_outputs(
    outputs: list[OutputTensor], loaded: LoadedVersion, *, default_is_binary: bool
) -> tuple[tuple[str, ...], frozenset[str]]:
    """Return the names of the requested outputs, and the names of the outputs that are sent as binary tensors.

    Args:
        outputs: Outputs that the request names.
        loaded: The model.
        default_is_binary: Whether an output is sent as a binary tensor if the request does not state it.

    Raises:
        RequestError: If an output is named twice, or the model does not have it.
    """
    names = tuple(output.name for output in outputs)
    if len(set(names)) < len(names):
        raise RequestError("outputs: expected each name once")
    # The names have been checked when the request was parsed, and only this output is missing in some models.
    if CORRELATION in names and CORRELATION not in loaded.outputs:
        raise RequestError(
            f"outputs: expected one of {', '.join(loaded.outputs)}, got {CORRELATION!r}, which "
            f"{loaded.metadata.label} does not have"
        )
    binary_names: list[str] = []
    for output in outputs:
        stated_choice = output.parameters.binary_data
        is_binary = default_is_binary if stated_choice is None else stated_choice
        if is_binary:
            binary_names.append(output.name)
    return names, frozenset(binary_names)


def _read_charges(
    tensor: InputTensor, binary: bytes | memoryview, electrodes: tuple[str, ...], max_presses: int
) -> Singles:
    """Return the charges of an input tensor, shape (n, electrodes), pC.

    The charges are either values in the JSON text, or bytes that follow this text. The shape is checked before any
    memory of that size is used.

    Args:
        tensor: The input tensor.
        binary: Bytes that follow the JSON text; empty if there are none.
        electrodes: Electrodes of the model.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If the shape or the data are not valid.
        ChargeError: If a charge is not finite.
        TooLarge: If there are more presses than `max_presses`.
    """
    shape = tensor.shape
    _check_shape(shape, electrodes, max_presses)
    stated_size = tensor.parameters.binary_data_size  # number of bytes after the JSON text, as the request states it
    if stated_size is None and not binary:
        return _from_values(tensor.data, shape, electrodes)

    dtype = DATATYPES[tensor.datatype]
    press_count, electrode_count = shape
    expected_size = press_count * electrode_count * dtype.itemsize
    has_expected_size = stated_size == len(binary) == expected_size
    has_json_values = tensor.data is not None
    if not has_expected_size or has_json_values:
        raise RequestError(
            f"expected either `data` or {expected_size} bytes after the JSON, announced by `binary_data_size` of the "
            f"input and Inference-Header-Content-Length, got binary_data_size {stated_size!r:.50} and {len(binary)} "
            "bytes"
        )
    # The copy is aligned. The bytes after a JSON text may begin at any address.
    charges = np.frombuffer(binary, dtype).reshape(shape).copy()
    return as_float32(charges, electrodes)


def _check_shape(shape: list[int], electrodes: tuple[str, ...], max_presses: int) -> None:
    """Check the shape of the input tensor that a request states.

    Args:
        shape: The shape, which should be the number of presses and the number of electrodes.
        electrodes: Electrodes of the model.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If there is no press, or the number of columns is not the number of electrodes.
        TooLarge: If there are more presses than `max_presses`.
    """
    if len(shape) != 2 or shape[0] < 1 or shape[1] != len(electrodes):
        raise RequestError(
            f"input {INPUT!r}: expected the shape [n, {len(electrodes)}] with n > 0, "
            f"a column for each of {electrodes}, got {shape!r:.100}"
        )
    press_count, _ = shape
    if press_count > max_presses:
        raise TooLarge(f"input {INPUT!r}: expected at most {max_presses} presses in one request, got {press_count}")


def _from_values(values: Any, shape: list[int], electrodes: tuple[str, ...]) -> Singles:
    """Return the charges from a flat list of numbers, or from a list of rows.

    Args:
        values: Content of the key `data` of the request. Nothing has been checked yet.
        shape: Number of presses and number of electrodes.
        electrodes: Names of the electrodes, for error messages.

    Returns:
        Charges, shape (n, electrodes), pC.

    Raises:
        RequestError: If the values are not numbers, or do not have this shape.
        ChargeError: If a charge is not finite.
    """
    press_count, electrode_count = shape
    is_flat_list = type(values) is list and len(values) == press_count * electrode_count
    # For a few numbers, struct is several times faster than creating and testing arrays. However, struct converts True
    # to 1.0. A list that contains True or False, or the equal numbers 1 and 0, is therefore converted by `_from_array`.
    if is_flat_list and not (True in values or False in values):
        charges = np.empty(shape, np.float32)
        write_into_charges = partial(_packer(len(values)), charges.data, 0)  # writes at the offset 0
        if write_finite(write_into_charges, values):
            return charges
    # The other function is slower, but accepts rows, and raises the errors.
    return _from_array(values, shape, electrodes)


@lru_cache(64)
def _packer(count: int) -> Callable[..., None]:
    """Return a function that packs `count` float32 numbers into a buffer."""
    return struct.Struct(f"={count}f").pack_into


def _from_array(values: Any, shape: list[int], electrodes: tuple[str, ...]) -> Singles:
    """Return the charges from values of any kind, shape (n, electrodes), pC.

    Args:
        values: Content of the key `data` of the request.
        shape: Number of presses and number of electrodes.
        electrodes: Names of the electrodes, for error messages.

    Raises:
        RequestError: If the values are not numbers, or have neither this shape nor the shape of a flat list.
        ChargeError: If a charge is not finite.
    """
    numbers = _as_array(values)
    press_count, electrode_count = shape
    flat_shape = [press_count * electrode_count]
    is_numeric = numbers.dtype.kind in "fiu"  # floating-point numbers, and integers with and without sign
    has_shape = list(numbers.shape) in (shape, flat_shape)
    if not (is_numeric and has_shape):
        raise RequestError(
            f"input {INPUT!r}: expected `data`, numbers for the shape {shape}, flat or in rows, "
            f"got {numbers.dtype} of shape {list(numbers.shape)}"
        )
    return as_float32(numbers.reshape(shape), electrodes)


def _as_array(values: Any) -> np.ndarray[Any, Any]:
    """Convert a list, or a list of lists, to an array.

    If the values contain true or false, the array has the type object, because NumPy would convert these values to 1
    and 0. If the values do not form an array, the result is an array of None. The caller refuses both types.
    """
    dtype = object if _contains_booleans(values) else None  # None: NumPy chooses the type
    try:
        return np.asarray(values, dtype)
    except (ValueError, OverflowError):  # rows of different lengths, or an integer that is too large
        return np.array(None)


def _contains_booleans(values: Any) -> bool:
    """Return whether true or false is an element of a list, or of a list in a list of lists."""
    is_nested = isinstance(values, list) and bool(values) and isinstance(values[0], list)
    rows = values if is_nested else [values]
    return any(type(row) is list and any(type(value) is bool for value in row) for row in rows)


def write_answer(answer: InferAnswer) -> tuple[bytes, int | None]:
    """Return the body of the response to an inference.

    Args:
        answer: Outputs of the model, and the names of those that are sent as binary tensors.

    Returns:
        The body: JSON, which may be followed by binary tensors; and the length of the JSON in bytes if binary tensors
        follow, otherwise None.
    """
    content: dict[str, Any] = {"model_name": answer.name, "model_version": answer.version}
    if answer.id:  # empty if the request has no identifier
        content["id"] = answer.id
    binary_tensors = {name: binary_tensor(rows) for name, rows in answer.outputs.items() if name in answer.binary}
    content["outputs"] = [_json_tensor(name, rows, binary_tensors.get(name)) for name, rows in answer.outputs.items()]
    json_text = orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)
    if not binary_tensors:
        return json_text, None
    return b"".join([json_text, *binary_tensors.values()]), len(json_text)


def binary_tensor(rows: Rows) -> bytes:
    """Return an output as little-endian bytes.

    Numbers are float32. Each text is preceded by its length in bytes (u32).
    """
    if not rows.dtype.hasobject:
        return rows.astype("<f4", copy=False).tobytes()
    return b"".join(struct.pack("<I", len(text)) + text.encode() for text in rows.ravel().tolist())


def _json_tensor(name: str, rows: Rows, binary: bytes | None) -> dict[str, Any]:
    """Return an output as a JSON object.

    The object contains the values, or the size of the binary tensor with the values.

    Args:
        name: Name of the output.
        rows: Values of the output, shape (n, width). They are written row by row.
        binary: The binary tensor; None if the values are written as JSON.
    """
    is_text = name == FLAGS
    datatype = "BYTES" if is_text else "FP32"
    tensor = {"name": name, "datatype": datatype, "shape": rows.shape}
    if binary is not None:
        return tensor | {"parameters": {"binary_data_size": len(binary)}}
    values = rows.ravel()
    return tensor | {"data": values.tolist() if is_text else values}  # orjson writes arrays of numbers, not of texts


ResponseType = TypeVar("ResponseType")


def infer(loaded: LoadedVersion, charge_pC: Singles, names: tuple[str, ...]) -> tuple[dict[str, Rows], int, int]:
    """Run the model on the charges of presses. This function may be called from any thread.

    Args:
        loaded: The model.
        charge_pC: Charges, shape (n, electrodes), pC.
        names: Names of the requested outputs.

    Returns:
        Outputs by name, each of shape (n, width). Number of presses whose misfit was not computed, because it was not
        requested. Number of presses whose misfit is NaN or above the limit of the model.

    Raises:
        ModelError: If onnxruntime fails to run the graph.
    """
    if FLAGS in names:  # the flags are computed from all outputs of the graph, which do not include the flags
        outputs, unchecked, alarms = infer(loaded, charge_pC, loaded.outputs)
        outputs[FLAGS] = _flags(loaded, outputs)
        return {name: outputs[name] for name in names}, unchecked, alarms
    if len(charge_pC) == 1:
        return _infer_single_press(loaded, charge_pC[0], names)

    count = len(charge_pC)
    outputs = dict[str, Rows](run(loaded.model.session, charge_pC, names))
    check_output_shapes(outputs, count, loaded.metadata.label)
    if "misfit" not in outputs:
        return outputs, count, 0
    is_good = outputs["misfit"] <= loaded.validity.misfit_limit  # false for NaN
    return outputs, 0, count - int(np.count_nonzero(is_good))


def _infer_single_press(
    loaded: LoadedVersion, charge_pC: Singles, names: tuple[str, ...]
) -> tuple[dict[str, Rows], int, int]:
    """Run the model for one press in memory that is bound to its session, which is faster than `session.run`.

    Args:
        loaded: The model.
        charge_pC: Charges of the press, shape (electrodes,), pC.
        names: Names of the requested outputs.

    Returns:
        The outputs by name; 0, because the misfit is always computed; and 1 if the misfit is above the limit, else 0.
    """
    press = loaded.press()
    row = np.empty((1, press.size), np.float32)  # all outputs of the press, one after the other
    try:
        press.run_into(charge_pC, row[0])
    except Exception as error:  # onnxruntime's exceptions have no common base class of their own
        raise run_error(error) from error
    columns = press.columns
    outputs = {name: row[:, columns[name]] for name in names}
    misfit = row[:, columns["misfit"]].item()
    is_alarm = not misfit <= loaded.validity.misfit_limit  # also true for NaN
    return outputs, 0, int(is_alarm)


def _flags(loaded: LoadedVersion, outputs: dict[str, Rows]) -> Rows:
    """Return the flags of presses, separated by commas, shape (n, 1).

    Args:
        loaded: The model.
        outputs: Outputs of the model for these presses, each of shape (n, width).
    """
    correlations = np.zeros_like(outputs["contact"])  # the flags do not depend on the correlations
    # These are the attributes of Contacts in their order: three for the contact, three standard deviations, the misfit
    # and three correlations.
    parts = [outputs["contact"], outputs["contact_std"], outputs["misfit"], correlations]
    attributes = np.concatenate(parts, axis=1).T  # shape (10, n)
    contacts = Contacts(*attributes)
    texts = [",".join(flags) for flags in loaded.validity.batch_flags(contacts)]
    return np.array(texts, dtype=object)[:, np.newaxis]


def answer_inference(
    loaded: LoadedVersion, read: Callable[[], InferRequest], write: Callable[[InferAnswer], ResponseType]
) -> ResponseType:
    """Read a request, run the model, write the response, and count the request.

    Args:
        loaded: The model.
        read: Function that returns the request, or raises an error if the request is not valid.
        write: Function that converts the outputs to the response of the transport.

    Raises:
        IsochargeError: The errors of `read`, and ModelError if the model fails.
    """
    clock_ns = time.perf_counter_ns
    start_ns = clock_ns()
    try:
        request = read()
        read_end_ns = clock_ns()
        outputs, unchecked, alarms = infer(loaded, request.charge_pC, request.outputs)
        run_end_ns = clock_ns()
        response = write(InferAnswer(loaded.metadata.name, loaded.version, request.id, outputs, request.binary))
    except Exception:
        loaded.statistics.failed(clock_ns() - start_ns)
        raise
    stages_ns = (read_end_ns - start_ns, run_end_ns - read_end_ns, clock_ns() - run_end_ns)
    loaded.statistics.succeeded(len(request.charge_pC), stages_ns, unchecked, alarms)
    return response
