"""Inference of the Open Inference Protocol.

An inference has three steps: the server reads the request, runs the model, and writes the response. The body of a
request or of a response is a JSON text, which may be followed by binary tensors. If binary tensors follow, an HTTP
header contains the length of the JSON text. The gRPC service converts its messages to the same types.

Some clients send `null` for every field that is not given. All optional fields therefore accept `null`.
"""

import math
import struct
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct

from isocharge.common.arrays import Singles
from isocharge.common.errors import RequestError, TooLarge
from isocharge.common.structs import parse_json
from isocharge.serve.model.contact import Contacts, as_float32
from isocharge.serve.model.session import COLUMNS, INPUT, OUTPUTS, run
from isocharge.serve.network.model_store import LoadedVersion

Unsupported = Annotated[None, Meta(description="nothing, as this server does not support it")]


class Parameters(Struct, frozen=True):
    """Parameters of a request, of an input or of an output. Unknown parameters are ignored, as in Triton."""

    binary_data: bool | None = None
    binary_data_output: bool | None = None
    binary_data_size: int | None = None
    shared_memory_region: Unsupported = None
    classification: Unsupported = None


NO_PARAMETERS = Parameters()
"""Parameters of a request, of an input or of an output that contains none."""


class InputTensor(Struct, frozen=True):
    """Input tensor with the charges, pC."""

    name: Literal["charge_pC"]
    datatype: Literal["FP32", "FP64"]
    shape: list[int]
    data: Annotated[list[float | list[float]], Meta(description="numbers, flat or in rows")] | None = None
    parameters: Parameters | None = None


class OutputTensor(Struct, frozen=True):
    """Output that the client requests."""

    name: Literal["contact", "contact_std", "contact_correlation", "misfit", "flags"]
    parameters: Parameters | None = None


class InferBody(Struct, frozen=True):
    """Body of a request for an inference."""

    inputs: Annotated[list[InputTensor], Meta(min_length=1, max_length=1, description="a list with one tensor")]
    id: str | None = None
    outputs: list[OutputTensor] | None = None
    parameters: Parameters | None = None


class IndexBody(Struct, frozen=True):
    """Body of a request for the index of the repository."""

    ready: bool | None = None


DATATYPES: dict[str, np.dtype[Any]] = {"FP32": np.dtype("<f4"), "FP64": np.dtype("<f8")}
"""NumPy type of the charges by the name of the number type. The protocol prescribes little-endian numbers."""

FLAGS = "flags"
"""Name of the output that contains the flags of each press, separated by commas.

This output is only computed if the client requests it.
"""

Rows = np.ndarray[Any, Any]
"""Values of an output, shape (n, width). They are texts for the output `flags`, and numbers for all other outputs."""


def read_infer(body: bytes, header_length: bytes | None) -> tuple[InferBody, bytes]:
    """Read a request for an inference from the body of an HTTP request.

    Args:
        body: The body, after it was decompressed.
        header_length: Value of the header Inference-Header-Content-Length, which is the length of the JSON text, bytes.
            None if the request has no such header, because no binary tensor follows.

    Returns:
        The content of the JSON text, and the bytes that follow the text.

    Raises:
        RequestError: If the body is not a request for an inference.
    """
    json_length = len(body)
    if header_length is not None:
        # The characters are checked before the conversion, because int() also accepts signs, blanks and underscores,
        # and is slow for long texts.
        is_short_number = header_length.isdigit() and len(header_length) <= len(str(len(body)))
        if not is_short_number or int(header_length) > len(body):
            raise RequestError(
                f"Inference-Header-Content-Length: expected a whole number up to {len(body)}, the bytes of the body, "
                f"got {header_length.decode('latin-1')!r:.50}"
            )
        json_length = int(header_length)
    content = parse_json(body[:json_length], "", RequestError, InferBody)
    binary = body[json_length:]
    stated_size = (content.inputs[0].parameters or NO_PARAMETERS).binary_data_size or 0
    if stated_size != len(binary):
        raise RequestError(
            f"inputs[0].parameters.binary_data_size: expected {len(binary)}, the bytes after the JSON text of "
            f"Inference-Header-Content-Length bytes, got {stated_size!r:.50}"
        )
    return content, binary


def _requested_outputs(body: InferBody) -> dict[str, bool]:
    """Return whether each requested output is sent as a binary tensor, by the name of the output.

    The outputs are in the order of the response. If a request contains no names of outputs, all outputs of the model
    are returned.

    Args:
        body: Content of the request.

    Raises:
        RequestError: If an output is requested twice.
    """
    default_is_binary = bool((body.parameters or NO_PARAMETERS).binary_data_output)
    if not body.outputs:
        return dict.fromkeys(OUTPUTS, default_is_binary)
    outputs: dict[str, bool] = {}
    for output in body.outputs:
        stated_choice = (output.parameters or NO_PARAMETERS).binary_data
        outputs[output.name] = default_is_binary if stated_choice is None else stated_choice
    if len(outputs) < len(body.outputs):
        raise RequestError("outputs: expected each name once")
    return outputs


def _read_charges(tensor: InputTensor, binary: bytes, electrodes: tuple[str, ...], max_presses: int) -> Singles:
    """Return the charges of an input tensor, shape (n, electrodes), pC.

    Args:
        tensor: Input tensor of the request.
        binary: Binary tensor with the charges. It is empty if the input tensor itself contains the charges.
        electrodes: Names of the electrodes of the model, in the order of the charges.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If the shape or the data are not valid.
        ChargeError: If a charge is not finite.
        TooLarge: If the request contains more than `max_presses` presses.
    """
    shape = tensor.shape
    if len(shape) != 2 or shape[0] < 1 or shape[1] != len(electrodes):
        raise RequestError(
            f"input {INPUT!r}: expected the shape [n, {len(electrodes)}] with n > 0, "
            f"a column for each of {electrodes}, got {shape!r:.100}"
        )
    if shape[0] > max_presses:
        raise TooLarge(f"input {INPUT!r}: expected at most {max_presses} presses in one request, got {shape[0]}")

    dtype = DATATYPES[tensor.datatype]
    count = math.prod(shape)
    # Too many numbers are refused, and the message shows the first of them. The other numbers need not be converted.
    data = tensor.data and tensor.data[: count + 100]
    try:
        charges = np.frombuffer(binary, dtype) if binary else np.asarray(data, np.float64)
    except (TypeError, ValueError):  # an incomplete number, no numbers, or rows of different lengths
        charges = np.empty(0)
    is_sent_twice = binary and data is not None
    if is_sent_twice or charges.shape not in (tuple(shape), (count,)):
        raise RequestError(
            f"input {INPUT!r}: expected {count} numbers for the shape {shape}, flat or in rows, or {count} binary "
            f"numbers of {dtype.itemsize} bytes each, got {data!r:.100} and {len(binary)} bytes"
        )
    return as_float32(charges.reshape(shape), electrodes)


def _flags(loaded: LoadedVersion, outputs: dict[str, Rows]) -> Rows:
    """Return the flags of each press as one text with commas between the flags, shape (n, 1).

    Args:
        loaded: Version of the model that was run.
        outputs: Outputs of the model for the presses by name, each of shape (n, width).
    """
    contacts = Contacts(*np.concatenate([outputs[name] for name in COLUMNS], axis=1).T)
    texts = [",".join(flags) for flags in loaded.validity.batch_flags(contacts)]
    return np.array(texts, dtype=object)[:, np.newaxis]


def infer(
    loaded: LoadedVersion, max_presses: int, body: InferBody, binary: bytes
) -> tuple[dict[str, Any], list[bytes]]:
    """Run a model on the presses of a request, and count the presses.

    Args:
        loaded: Version of the model that is run.
        max_presses: Largest number of presses in one request.
        body: Content of the request.
        binary: Binary tensor with the charges, which is empty if the content contains the charges.

    Returns:
        The content of the response, and its binary tensors. The content is the JSON object that an HTTP response
        contains. Its numbers are arrays, and its texts are lists.

    Raises:
        IsochargeError: If the request does not fit the model, or if the model fails.
    """
    requested_outputs = _requested_outputs(body)
    charge_pC = _read_charges(body.inputs[0], binary, loaded.metadata.electrodes, max_presses)
    outputs = dict[str, Rows](run(loaded.session, charge_pC))
    if FLAGS in requested_outputs:
        outputs[FLAGS] = _flags(loaded, outputs)
    content: dict[str, Any] = {"model_name": loaded.metadata.name, "model_version": loaded.version}
    if body.id:
        content["id"] = body.id
    binary_tensors: list[bytes] = []
    content["outputs"] = [
        _output_tensor(name, outputs[name], binary_tensors if is_binary else None)
        for name, is_binary in requested_outputs.items()
    ]
    loaded.statistics.presses.inc(len(charge_pC))
    alarm_count = np.count_nonzero(~(outputs["misfit"] <= loaded.validity.misfit_limit))  # also NaN
    loaded.statistics.alarms.inc(float(alarm_count))
    return content, binary_tensors


def _output_tensor(name: str, rows: Rows, binary_tensors: list[bytes] | None) -> dict[str, Any]:
    """Return the JSON object that describes an output in the response.

    In a binary tensor, numbers are little-endian float32. Each text is preceded by its length in bytes, a 32-bit
    unsigned integer.

    Args:
        name: Name of the output.
        rows: Values of the output.
        binary_tensors: List to which the values are appended as a binary tensor. None if the object itself contains the
            values.
    """
    is_text = name == FLAGS
    values = rows.ravel()
    tensor: dict[str, Any] = {"name": name, "datatype": "BYTES" if is_text else "FP32", "shape": rows.shape}
    if binary_tensors is None:
        tensor["data"] = values.tolist() if is_text else values  # orjson writes arrays of numbers only
        return tensor
    if is_text:
        data = b"".join(struct.pack("<I", len(text)) + text.encode() for text in values)
    else:
        data = values.astype("<f4", copy=False).tobytes()
    binary_tensors.append(data)
    tensor["parameters"] = {"binary_data_size": len(data)}
    return tensor
