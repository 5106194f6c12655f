"""One inference for every transport: a request as charges, the model's outputs, the answer as bytes.

An answer is JSON, then binary tensors if a header says so. gRPC's messages say the same in other words: they are read
by `request_of`, too.
"""

import struct
import time
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
import orjson
from msgspec import Meta, Struct

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
from isocharge.serve.prediction.contact import Contacts

DATATYPES: dict[str, np.dtype[Any]] = {"FP32": np.dtype("<f4"), "FP64": np.dtype("<f8")}
"""Number types of charges, little-endian as the protocol has them."""

FLAGS = "flags"
"""The output that only requests get that name it: the flags of each press, words with commas between them."""

Rows = np.ndarray[Any, Any]
"""Of an output: numbers, or of `flags` texts, shape (n, width)."""

Unsupported = Annotated[None, Meta(description="nothing, as this server does not support it")]


class Parameters(Struct, frozen=True):
    """Parameters of a request, an input or an output; unknown ones are ignored, as Triton does."""

    binary_data: bool | None = None
    binary_data_output: bool = False
    binary_data_size: int | None = None
    shared_memory_region: Unsupported = None
    classification: Unsupported = None


class InputTensor(Struct, frozen=True):
    """Charges, pC; the numbers are looked at when the shape is known."""

    name: Literal["charge_pC"]
    datatype: Literal["FP32", "FP64"]
    shape: list[int]
    data: Annotated[Any, Meta(extra_json_schema={"type": "array", "description": "numbers, flat or in rows"})] = None
    parameters: Parameters = Parameters()


class OutputTensor(Struct, frozen=True):
    """An output that is asked for."""

    name: Literal["contact", "contact_std", "contact_correlation", "misfit", "flags"]
    parameters: Parameters = Parameters()


class InferBody(Struct, frozen=True):
    """What a request says."""

    inputs: Annotated[list[InputTensor], Meta(min_length=1, max_length=1, description="a list with one tensor")]
    id: str = ""
    outputs: list[OutputTensor] = []
    parameters: Parameters = Parameters()


class InferRequest(NamedTuple):
    """Charges for a model, and which of its outputs to answer with.

    Attributes:
        id: Echoed in the answer; empty if the request has none.
        charge_pC: Shape (n, electrodes), pC.
        outputs: Names, in the order of the answer.
        binary: Names of the outputs that are sent in binary.
    """

    id: str
    charge_pC: Singles
    outputs: tuple[str, ...]
    binary: frozenset[str]


class InferAnswer(NamedTuple):
    """Outputs of a model for one request.

    Attributes:
        name, version: The model that answered.
        id, binary: As in the request.
        outputs: By name, shape (n, width).
    """

    name: str
    version: str
    id: str
    outputs: dict[str, Rows]
    binary: frozenset[str]


def read_object(text: bytes) -> dict[str, Any]:
    """A JSON object; no text at all counts as an empty one.

    Raises:
        RequestError: If it is anything else.
    """
    try:
        content = orjson.loads(text) if text else {}
    except orjson.JSONDecodeError as error:
        raise RequestError(f"expected a JSON object, got {len(text)} bytes that are not JSON: {error}") from error
    if not isinstance(content, dict):
        raise RequestError(f"expected a JSON object, got {content!r:.100}")
    return content


def read_infer(body: bytes, header_length: bytes | None, loaded: LoadedVersion, batch: int) -> InferRequest:
    """The request in a body.

    Args:
        body: The body, not compressed.
        header_length: Value of Inference-Header-Content-Length, None without binary data.
        loaded, batch: As in `request_of`.

    Raises:
        RequestError, ChargeError, TooLarge: As `request_of`.
    """
    if header_length is None:
        return request_of(read_object(body), b"", loaded, batch)
    # isdigit first: int() accepts signs, blanks and underscores, and takes long for a long text.
    if not header_length.isdigit() or len(header_length) > 12 or int(header_length) > len(body):
        raise RequestError(
            f"Inference-Header-Content-Length: expected a whole number up to {len(body)}, the bytes of the body, "
            f"got {header_length.decode('latin-1')!r:.50}"
        )
    end = int(header_length)
    return request_of(read_object(body[:end]), memoryview(body)[end:], loaded, batch)


def request_of(content: dict[str, Any], binary: bytes | memoryview, loaded: LoadedVersion, batch: int) -> InferRequest:
    """The request that a JSON object makes.

    Args:
        content: The object as it came.
        binary: The bytes after the JSON; the numbers of the input, if it announces them.
        loaded: The model; a request that names no outputs gets all that it has.
        batch: Presses that one request may have.

    Raises:
        RequestError: If it is not one for this model.
        ChargeError: If a charge is not finite.
        TooLarge: If there are more presses than `batch`.
    """
    body = convert(content, InferBody, "", RequestError)
    by_default, names = body.parameters.binary_data_output, loaded.outputs
    in_binary = frozenset(names if by_default else ())
    if body.outputs:
        wanted = {output.name: output.parameters.binary_data for output in body.outputs}
        if len(wanted) < len(body.outputs):
            raise RequestError("outputs: expected each name once")
        if CORRELATION in wanted and CORRELATION not in names:
            label = loaded.metadata.label
            raise RequestError(
                f"outputs: expected one of {', '.join(names)}, got {CORRELATION!r}, which {label} has not"
            )
        names = tuple(wanted)
        in_binary = frozenset(name for name, flag in wanted.items() if (by_default if flag is None else flag))
    return InferRequest(body.id, _charges(body.inputs[0], binary, loaded.metadata.electrodes, batch), names, in_binary)


def _charges(tensor: InputTensor, binary: bytes | memoryview, electrodes: tuple[str, ...], batch: int) -> Singles:
    """Charges, shape (n, electrodes), pC; nothing of that size is touched before the shape is checked."""
    shape, dtype, size = tensor.shape, DATATYPES[tensor.datatype], tensor.parameters.binary_data_size
    if len(shape) != 2 or shape[0] < 1 or shape[1] != len(electrodes):
        raise RequestError(
            f"input {INPUT!r}: expected the shape [n, {len(electrodes)}] with n > 0, "
            f"a column for each of {electrodes}, got {shape!r:.100}"
        )
    if shape[0] > batch:
        raise TooLarge(f"input {INPUT!r}: expected at most {batch} presses in one request, got {shape[0]}")
    if size is None and not binary:
        return _from_values(tensor.data, shape, electrodes)
    expected = shape[0] * shape[1] * dtype.itemsize
    if not size == len(binary) == expected or tensor.data is not None:
        raise RequestError(
            f"expected either `data` or {expected} bytes after the JSON, announced by `binary_data_size` of the "
            f"input and Inference-Header-Content-Length, got binary_data_size {size!r:.50} and {len(binary)} bytes"
        )
    # A copy: what follows a JSON text may lie at any address, and a runtime expects numbers at even ones.
    return as_float32(np.frombuffer(binary, dtype).reshape(shape).copy(), electrodes)


def _from_values(values: Any, shape: list[int], electrodes: tuple[str, ...]) -> Singles:
    """Charges from a list of numbers, flat or nested as the shape."""
    rows, columns = shape
    # struct is several times faster than making and testing arrays, for a few numbers; it takes True as 1.0, so a list
    # that holds one or the other is looked at below.
    if type(values) is list and len(values) == rows * columns and not (True in values or False in values):
        charges = np.empty(shape, np.float32)
        if write_finite(partial(_packer(len(values)), charges.data, 0), values):
            return charges
    return _examined(values, shape, electrodes)


@lru_cache(64)
def _packer(count: int) -> Callable[..., None]:
    """Packs this many float32 numbers into a buffer."""
    return struct.Struct(f"={count}f").pack_into


def _examined(values: Any, shape: list[int], electrodes: tuple[str, ...]) -> Singles:
    """Charges from values that may be rows of numbers; the error says what is wrong with others."""
    numbers = _as_array(values)
    if numbers.dtype.kind not in "fiu" or list(numbers.shape) not in (shape, [shape[0] * shape[1]]):
        raise RequestError(
            f"input {INPUT!r}: expected `data`, numbers for the shape {shape}, flat or in rows, "
            f"got {numbers.dtype} of shape {list(numbers.shape)}"
        )
    return as_float32(numbers.reshape(shape), electrodes)


def _as_array(values: Any) -> np.ndarray[Any, Any]:
    """An array of a list, or of lists in a list; true and false, which arrays take for 1 and 0, stay what they are."""
    try:
        rows = values if isinstance(values, list) and values and isinstance(values[0], list) else [values]
        has_flags = any(type(row) is list and any(type(value) is bool for value in row) for row in rows)
        return np.asarray(values, object if has_flags else None)
    except (ValueError, OverflowError):
        return np.array(None)


def write_answer(answer: InferAnswer) -> tuple[bytes, int | None]:
    """Put an answer into bytes: the body, and where its JSON ends if binary tensors follow."""
    content: dict[str, Any] = {"model_name": answer.name, "model_version": answer.version}
    if answer.id:
        content["id"] = answer.id
    parts = {name: packed(rows) for name, rows in answer.outputs.items() if name in answer.binary}
    content["outputs"] = [_tensor(name, rows, parts.get(name)) for name, rows in answer.outputs.items()]
    text = orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)
    if not parts:
        return text, None
    return b"".join([text, *parts.values()]), len(text)


def packed(rows: Rows) -> bytes:
    """Numbers as they lie in memory, texts each behind its length (u32), little-endian."""
    if not rows.dtype.hasobject:
        return rows.astype("<f4", copy=False).tobytes()
    return b"".join(struct.pack("<I", len(text)) + text.encode() for text in rows.ravel().tolist())


def _tensor(name: str, rows: Rows, binary: bytes | None) -> dict[str, Any]:
    """One tensor: its numbers or texts, flat and row by row, or how many bytes of them follow the JSON."""
    is_text = name == FLAGS
    tensor = {"name": name, "datatype": "BYTES" if is_text else "FP32", "shape": rows.shape}
    if binary is not None:
        return tensor | {"parameters": {"binary_data_size": len(binary)}}
    return tensor | {"data": rows.ravel().tolist() if is_text else rows.ravel()}


Written = TypeVar("Written")


def infer(loaded: LoadedVersion, charge_pC: Singles, names: tuple[str, ...]) -> tuple[dict[str, Rows], int, int]:
    """Run the model; may be called from any thread.

    Returns:
        Outputs by name, shape (n, width); how many presses were not checked for their misfit, as nobody asked for it;
        and how many have one above the limit of the model, or none that is a number.

    Raises:
        ModelError: If its graph fails.
    """
    if FLAGS in names:
        outputs, unchecked, alarms = infer(loaded, charge_pC, loaded.outputs)
        outputs[FLAGS] = _flags(loaded, outputs)
        return {name: outputs[name] for name in names}, unchecked, alarms
    if len(charge_pC) == 1:
        row, columns = _one_press(loaded, charge_pC[0])
        misfit = row[:, columns["misfit"]]
        return (
            {name: row[:, columns[name]] for name in names},
            0,
            int(not misfit.item() <= loaded.validity.misfit_limit),
        )
    outputs = dict[str, Rows](run(loaded.model.session, charge_pC, names))
    check_output_shapes(outputs, len(charge_pC), loaded.metadata.label)
    if "misfit" not in outputs:
        return outputs, len(charge_pC), 0
    return outputs, 0, len(charge_pC) - int(np.count_nonzero(outputs["misfit"] <= loaded.validity.misfit_limit))


def _flags(loaded: LoadedVersion, outputs: dict[str, Rows]) -> Rows:
    """The flags of presses, shape (n, 1)."""
    known = [outputs[name] for name in ("contact", "contact_std", "misfit")]
    columns = np.concatenate([*known, np.zeros_like(outputs["contact"])], axis=1).T  # correlations decide no flag
    words = [",".join(flags) for flags in loaded.validity.batch_flags(Contacts(*columns))]
    return np.array(words, dtype=object)[:, np.newaxis]


def _one_press(loaded: LoadedVersion, charge_pC: Singles) -> tuple[Singles, dict[str, slice]]:
    """All outputs in a row, shape (1, n), and where they lie; from bound memory, which is faster than a plain run."""
    press = loaded.press()
    row = np.empty((1, press.size), np.float32)
    try:
        press.run_into(charge_pC, row[0])
    except Exception as error:  # onnxruntime's exceptions have no common base of their own
        raise run_error(error) from error
    return row, press.columns


def answer_inference(
    loaded: LoadedVersion, read: Callable[[], InferRequest], write: Callable[[InferAnswer], Written]
) -> Written:
    """Read a request, run the model, write the answer, and count it.

    Args:
        loaded: The model.
        read: Returns the request, or raises what is wrong with it.
        write: Turns the answer into what the transport sends.

    Raises:
        Whatever `read` raises.
    """
    clock = time.perf_counter_ns
    began = clock()
    try:
        request = read()
        was_read = clock()
        outputs, unchecked, alarms = infer(loaded, request.charge_pC, request.outputs)
        ran = clock()
        written = write(InferAnswer(loaded.metadata.name, loaded.version, request.id, outputs, request.binary))
    except Exception:
        loaded.statistics.failed(clock() - began)
        raise
    stages_ns = was_read - began, ran - was_read, clock() - ran
    loaded.statistics.succeeded(len(request.charge_pC), stages_ns, unchecked, alarms)
    return written
