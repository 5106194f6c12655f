"""Inference of the Open Inference Protocol.

An inference has three steps: the server reads the request, runs the model, and writes the response. The body of a
request or of a response is a JSON text, which may be followed by binary tensors. If binary tensors follow, an HTTP
header contains the length of the JSON text. The gRPC service converts its messages to JSON objects of the same form,
and passes these objects to `parse_request`.
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
from isocharge.serve.network.protocol.infer_body import InferBody, InputTensor, OutputTensor, Parameters
from isocharge.serve.prediction.contact import Contacts

DATATYPES: dict[str, np.dtype[Any]] = {"FP32": np.dtype("<f4"), "FP64": np.dtype("<f8")}
"""NumPy type of the charges by the name of the number type. The protocol prescribes little-endian numbers."""

FLAGS = "flags"
"""Name of the output that contains the flags of each press, separated by commas.

This output is only computed if the client requests it.
"""

MAX_LENGTH_DIGITS = 12
"""Largest number of digits in a header that states the length of a JSON text. Every accepted body is much shorter."""

Rows = np.ndarray[Any, Any]
"""Values of an output, shape (n, width). They are texts for the output `flags`, and numbers for all other outputs."""


class InferRequest(NamedTuple):
    """Request for an inference, which contains charges and the names of the requested outputs.

    Attributes:
        id: Identifier that is repeated in the response. It is empty if the request has no identifier.
        charge_pC: Charges, shape (n, electrodes), pC.
        outputs: Names of the requested outputs, in the order in which the response contains them.
        binary: Names of the outputs that are sent as binary tensors.
    """

    id: str
    charge_pC: Singles
    outputs: tuple[str, ...]
    binary: frozenset[str]


class InferAnswer(NamedTuple):
    """Answer to a request for an inference, which contains the outputs of the model.

    Attributes:
        name: Name of the model.
        version: Version of the model.
        id: Identifier of the request. It is empty if the request has no identifier.
        outputs: Values of each output by its name, each of shape (n, width).
        binary: Names of the outputs that are sent as binary tensors.
    """

    name: str
    version: str
    id: str
    outputs: dict[str, Rows]
    binary: frozenset[str]


def read_object(text: bytes) -> dict[str, Any]:
    """Parse the text of a JSON object. The result for an empty text is an empty object.

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
    """Read a request for an inference from the body of an HTTP request.

    Args:
        body: The body, after it was decompressed.
        header_length: Value of the header Inference-Header-Content-Length, which is the length of the JSON text, bytes.
            None if the request has no such header, because no binary tensor follows.
        loaded: Version of the model that is requested.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If the body is not a request for this model.
        ChargeError: If a charge is not finite.
        TooLarge: If the request contains more than `max_presses` presses.
    """
    if header_length is None:
        return parse_request(read_object(body), b"", loaded, max_presses)
    # The characters are checked before the conversion, because int() also accepts signs, blanks and underscores, and is
    # slow for long texts.
    is_short_number = header_length.isdigit() and len(header_length) <= MAX_LENGTH_DIGITS
    json_length = int(header_length) if is_short_number else None
    if json_length is None or json_length > len(body):
        raise RequestError(
            f"Inference-Header-Content-Length: expected a whole number up to {len(body)}, the bytes of the body, "
            f"got {header_length.decode('latin-1')!r:.50}"
        )
    content = read_object(body[:json_length])
    binary_tensors = memoryview(body)[json_length:]  # a view, so that the bytes are not copied
    return parse_request(content, binary_tensors, loaded, max_presses)


def parse_request(
    content: dict[str, Any], binary: bytes | memoryview, loaded: LoadedVersion, max_presses: int
) -> InferRequest:
    """Convert the JSON object in a request for an inference to an `InferRequest`.

    Args:
        content: The JSON object.
        binary: Bytes that follow the JSON text. If the input has the parameter `binary_data_size`, these bytes are the
            charges.
        loaded: Version of the model that is requested. If the request contains no names of outputs, all outputs of the
            model are computed.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If the JSON object is not a request for this model.
        ChargeError: If a charge is not finite.
        TooLarge: If the request contains more than `max_presses` presses.
    """
    body = convert(content, InferBody, where="", error_class=RequestError)  # `where` is empty, because there is no file
    default_is_binary = bool((body.parameters or Parameters()).binary_data_output)
    if body.outputs:
        names, binary_names = _requested_outputs(body.outputs, loaded, default_is_binary=default_is_binary)
    else:
        names = loaded.outputs
        binary_names = frozenset(names if default_is_binary else ())
    charges = _read_charges(body.inputs[0], binary, loaded.metadata.electrodes, max_presses)
    return InferRequest(body.id or "", charges, names, binary_names)


def _requested_outputs(
    outputs: list[OutputTensor], loaded: LoadedVersion, *, default_is_binary: bool
) -> tuple[tuple[str, ...], frozenset[str]]:
    """Return the names of the requested outputs, and the names of the outputs that are sent as binary tensors.

    Args:
        outputs: Outputs that the request contains.
        loaded: Version of the model that is requested.
        default_is_binary: Whether an output is sent as a binary tensor if the request contains no choice for this
            output.

    Raises:
        RequestError: If the request contains an output twice, or an output that the model does not have.
    """
    names = tuple(output.name for output in outputs)
    has_duplicate_names = len(set(names)) < len(names)
    if has_duplicate_names:
        raise RequestError("outputs: expected each name once")
    # Unknown names were refused when the request was parsed. Every model has all known outputs, except that older
    # models do not compute the correlations.
    if CORRELATION in names and CORRELATION not in loaded.outputs:
        raise RequestError(
            f"outputs: expected one of {', '.join(loaded.outputs)}, got {CORRELATION!r}, which "
            f"{loaded.metadata.label} does not have"
        )
    binary_names: list[str] = []
    for output in outputs:
        stated_choice = (output.parameters or Parameters()).binary_data
        is_binary = default_is_binary if stated_choice is None else stated_choice
        if is_binary:
            binary_names.append(output.name)
    return names, frozenset(binary_names)


def _read_charges(
    tensor: InputTensor, binary: bytes | memoryview, electrodes: tuple[str, ...], max_presses: int
) -> Singles:
    """Return the charges of an input tensor, shape (n, electrodes), pC.

    The charges are either numbers in the JSON text, or bytes that follow the JSON text. The shape is checked before an
    array of this shape is created.

    Args:
        tensor: Input tensor of the request.
        binary: Bytes that follow the JSON text. It is empty if no bytes follow.
        electrodes: Names of the electrodes of the model, in the order of the charges.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If the shape or the data are not valid.
        ChargeError: If a charge is not finite.
        TooLarge: If the request contains more than `max_presses` presses.
    """
    shape = tensor.shape
    _check_shape(shape, electrodes, max_presses)
    # number of bytes after the JSON text, as the request states it
    stated_size = (tensor.parameters or Parameters()).binary_data_size
    if stated_size is None and not binary:  # the charges are numbers in the JSON text
        return _from_values(tensor.data, shape, electrodes)

    # The charges are bytes after the JSON text. Their number must be equal to the stated size and to the size that
    # follows from the shape.
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
    # The numbers are copied so that they are aligned in memory. The bytes after a JSON text may begin at any address.
    charges = np.frombuffer(binary, dtype).reshape(shape).copy()
    return as_float32(charges, electrodes)


def _check_shape(shape: list[int], electrodes: tuple[str, ...], max_presses: int) -> None:
    """Check the shape that a request states for its input tensor.

    Args:
        shape: The shape. It must consist of the number of presses and the number of electrodes.
        electrodes: Names of the electrodes of the model, in the order of the charges.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If the number of presses is not positive, or if the number of electrodes is wrong.
        TooLarge: If the request contains more than `max_presses` presses.
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
    """Convert a flat list of numbers, or a list of rows, to charges.

    Args:
        values: Value of the key `data` of the request, which may have any type.
        shape: Number of presses, and number of electrodes.
        electrodes: Names of the electrodes, for error messages.

    Returns:
        Charges, shape (n, electrodes), pC.

    Raises:
        RequestError: If the values are not numbers, or if their number or arrangement does not agree with the shape.
        ChargeError: If a charge is not finite.
    """
    press_count, electrode_count = shape
    is_flat_list = type(values) is list and len(values) == press_count * electrode_count
    # Try the fast conversion by the module `struct`, which is several times faster than `_from_array` for few numbers.
    # Lists with True or False are excluded, because `struct` would accept these values as numbers. The test with `in`
    # also excludes lists with the numbers 1 and 0, because Python treats them as equal to True and False.
    may_contain_booleans = is_flat_list and (True in values or False in values)
    if is_flat_list and not may_contain_booleans:
        charges = np.empty(shape, np.float32)
        write_into_charges = partial(_packer(len(values)), charges.data, 0)  # writes to the array, from its beginning
        if write_finite(write_into_charges, values):  # false if a value is not a finite number
            return charges

    # The slow conversion also accepts rows, and raises an error if the values are not valid.
    return _from_array(values, shape, electrodes)


@lru_cache(64)
def _packer(count: int) -> Callable[..., None]:
    """Return a function that writes `count` numbers as float32 to a buffer."""
    return struct.Struct(f"={count}f").pack_into


def _from_array(values: Any, shape: list[int], electrodes: tuple[str, ...]) -> Singles:
    """Convert values to charges. If the values have a wrong type or shape, raise an error.

    Args:
        values: Value of the key `data` of the request, which may have any type.
        shape: Number of presses, and number of electrodes.
        electrodes: Names of the electrodes, for error messages.

    Returns:
        Charges, shape (n, electrodes), pC.

    Raises:
        RequestError: If the values are not numbers, or if they are neither rows of this shape nor a flat list.
        ChargeError: If a charge is not finite.
    """
    numbers = _as_array(values)
    press_count, electrode_count = shape
    flat_shape = [press_count * electrode_count]
    is_numeric = numbers.dtype.kind in "fiu"  # floating-point numbers, and integers with and without sign
    has_valid_shape = list(numbers.shape) in (shape, flat_shape)
    if not (is_numeric and has_valid_shape):
        raise RequestError(
            f"input {INPUT!r}: expected `data`, numbers for the shape {shape}, flat or in rows, "
            f"got {numbers.dtype} of shape {list(numbers.shape)}"
        )
    return as_float32(numbers.reshape(shape), electrodes)


def _as_array(values: Any) -> np.ndarray[Any, Any]:
    """Convert a list, or a list of lists, to an array.

    If the values contain true or false, the array has the type object, because NumPy would otherwise convert true and
    false to 1 and 0. If the values cannot be converted, the result is an array that contains only None. This array has
    the type object, too. The caller refuses every array of the type object.
    """
    dtype = object if _contains_booleans(values) else None  # with None, NumPy chooses the type
    try:
        return np.asarray(values, dtype)
    except (ValueError, OverflowError):  # rows of different lengths, or an integer that is too large
        return np.array(None)


def _contains_booleans(values: Any) -> bool:
    """Return whether a list, or a list of lists, contains true or false."""
    # Only the first element is examined, because a mixture of lists and other values is refused in any case.
    is_nested = isinstance(values, list) and bool(values) and isinstance(values[0], list)
    rows = values if is_nested else [values]
    return any(type(row) is list and any(type(value) is bool for value in row) for row in rows)


def write_answer(answer: InferAnswer) -> tuple[bytes, int | None]:
    """Return the body of the HTTP response to an inference.

    Args:
        answer: Outputs of the model, and the names of the outputs that are sent as binary tensors.

    Returns:
        Two values. The first value is the body, which is a JSON text that may be followed by binary tensors. The second
        value is the length of the JSON text, bytes, or None if no binary tensors follow.
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
    """Convert the values of an output to a little-endian binary tensor.

    Numbers are written as float32. Each text is preceded by its length in bytes, which is written as a 32-bit unsigned
    integer.
    """
    if not rows.dtype.hasobject:  # the values are numbers
        return rows.astype("<f4", copy=False).tobytes()
    return b"".join(struct.pack("<I", len(text)) + text.encode() for text in rows.ravel().tolist())


def _json_tensor(name: str, rows: Rows, binary: bytes | None) -> dict[str, Any]:
    """Return the JSON object that describes an output.

    The object contains either the values, or the size of the binary tensor that contains the values.

    Args:
        name: Name of the output.
        rows: Values of the output, shape (n, width). They are written row by row.
        binary: Binary tensor with the values, or None if the values are written as JSON.
    """
    is_text = name == FLAGS
    datatype = "BYTES" if is_text else "FP32"
    tensor = {"name": name, "datatype": datatype, "shape": rows.shape}
    if binary is not None:
        return tensor | {"parameters": {"binary_data_size": len(binary)}}
    values = rows.ravel()
    # orjson can write arrays of numbers, but not arrays of texts.
    return tensor | {"data": values.tolist() if is_text else values}


ResponseType = TypeVar("ResponseType")


class Inference(NamedTuple):
    """Outputs of a model for the presses of a request, and numbers of presses for the statistics.

    Attributes:
        outputs: Values of each requested output by its name, each of shape (n, width).
        unchecked: Number of presses whose misfit was not computed, because it was not requested.
        alarms: Number of presses whose misfit is NaN or exceeds the limit of the model.
    """

    outputs: dict[str, Rows]
    unchecked: int
    alarms: int


def infer(loaded: LoadedVersion, charge_pC: Singles, names: tuple[str, ...]) -> Inference:
    """Run a model on the charges of presses. Any thread may call this function.

    Args:
        loaded: Version of the model that is run.
        charge_pC: Charges, shape (n, electrodes), pC.
        names: Names of the requested outputs.

    Raises:
        ModelError: If onnxruntime fails to run the graph.
    """
    # The graph does not compute the flags. The flags are computed from all outputs of the graph, which the following
    # call requests.
    if FLAGS in names:
        outputs, unchecked, alarms = infer(loaded, charge_pC, loaded.outputs)
        outputs[FLAGS] = _flags(loaded, outputs)
        requested_outputs = {name: outputs[name] for name in names}
        return Inference(requested_outputs, unchecked, alarms)

    press_count = len(charge_pC)
    if press_count == 1:  # a single press is computed in a faster way
        return _infer_single_press(loaded, charge_pC[0], names)
    outputs = dict[str, Rows](run(loaded.model.session, charge_pC, names))
    check_output_shapes(outputs, press_count, loaded.metadata.label)
    if "misfit" not in outputs:
        return Inference(outputs, unchecked=press_count, alarms=0)
    is_good = outputs["misfit"] <= loaded.validity.misfit_limit  # false if the misfit is NaN
    alarms = press_count - int(np.count_nonzero(is_good))
    return Inference(outputs, unchecked=0, alarms=alarms)


def _infer_single_press(loaded: LoadedVersion, charge_pC: Singles, names: tuple[str, ...]) -> Inference:
    """Run a model on the charges of one press.

    The session of the model uses memory that is allocated once and reused. Reusing the memory is faster than calling
    `session.run`. The misfit is always computed, even if it is not requested.

    Args:
        loaded: Version of the model that is run.
        charge_pC: Charges of the press, shape (electrodes,), pC.
        names: Names of the requested outputs.
    """
    press = loaded.press_of_thread()
    row = np.empty((1, press.size), np.float32)  # all outputs of the press, one after the other
    try:
        press.run_into(charge_pC, row[0])
    except Exception as error:  # the exceptions of onnxruntime have no common base class other than Exception
        raise run_error(error) from error
    columns = press.columns  # columns of the row that belong to each output, by the name of the output
    outputs = {name: row[:, columns[name]] for name in names}
    misfit = row[:, columns["misfit"]].item()
    is_alarm = not misfit <= loaded.validity.misfit_limit  # also true if the misfit is NaN
    return Inference(outputs, unchecked=0, alarms=int(is_alarm))


def _flags(loaded: LoadedVersion, outputs: dict[str, Rows]) -> Rows:
    """Return the flags of each press as one text with commas between the flags, shape (n, 1).

    Args:
        loaded: Version of the model that was run.
        outputs: Outputs of the model for the presses by name, each of shape (n, width).
    """
    correlations = np.zeros_like(outputs["contact"])  # the flags do not depend on the correlations
    # `Contacts` has ten attributes, which are arrays of the shape (n,): three values of the contact, three standard
    # deviations, the misfit and three correlations. The columns of the four outputs have the same order.
    outputs_in_order = [outputs["contact"], outputs["contact_std"], outputs["misfit"], correlations]
    columns = np.concatenate(outputs_in_order, axis=1).T  # shape (10, n)
    contacts = Contacts(*columns)
    texts = [",".join(flags) for flags in loaded.validity.batch_flags(contacts)]
    return np.array(texts, dtype=object)[:, np.newaxis]


def answer_inference(
    loaded: LoadedVersion, read: Callable[[], InferRequest], write: Callable[[InferAnswer], ResponseType]
) -> ResponseType:
    """Read a request, run the model, and return the response. The request is counted with the duration of each step.

    Args:
        loaded: Version of the model that is run.
        read: Function that returns the request, or raises an error if the request is not valid.
        write: Function that converts the outputs to the response.

    Raises:
        IsochargeError: If `read` raises this error, or if the model fails.
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
        loaded.statistics.count_refused(clock_ns() - start_ns)
        raise
    stages_ns = (read_end_ns - start_ns, run_end_ns - read_end_ns, clock_ns() - run_end_ns)
    loaded.statistics.count_answered(len(request.charge_pC), stages_ns, unchecked, alarms)
    return response
