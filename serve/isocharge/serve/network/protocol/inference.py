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
from isocharge.common.defaults import MAX_BATCH
from isocharge.common.errors import RequestError
from isocharge.common.structs import parse_json
from isocharge.serve.model.contact import Contacts, as_float32
from isocharge.serve.model.session import COLUMNS, INPUT, OUTPUTS
from isocharge.serve.network.model_store import LoadedVersion

Json = dict[str, Any]
"""JSON object."""

Parameters = Json | None
"""Parameters of a request, of an input or of an output. Unknown parameters are ignored, as in Triton."""


class InputTensor(Struct, frozen=True):
    """Input tensor with the charges, pC."""

    name: Literal["charge_pC"]
    datatype: Literal["FP32", "FP64"]
    shape: list[int]
    data: Annotated[list[float | list[float]], Meta(description="numbers, flat or in rows")] | None = None
    parameters: Parameters = None


class OutputTensor(Struct, frozen=True):
    """Output that the client requests."""

    name: Literal["contact", "contact_std", "contact_correlation", "misfit", "flags"]
    parameters: Parameters = None


class InferBody(Struct, frozen=True):
    """Body of a request for an inference."""

    inputs: Annotated[list[InputTensor], Meta(min_length=1, max_length=1, description="a list with one tensor")]
    id: str | None = None
    outputs: Annotated[list[OutputTensor], Meta(max_length=5, description="a list of at most 5 outputs")] | None = None
    parameters: Parameters = None


class RepositoryBody(Struct, frozen=True):
    """Body of a request for the index of the repository, or for loading a model."""

    ready: bool | None = None
    parameters: Parameters = None


DATATYPES = {"FP32": "<f4", "FP64": "<f8"}
"""NumPy type of the charges by the name of the number type. The protocol prescribes little-endian numbers."""

FLAGS = "flags"
"""Name of the output that contains the flags of each press, separated by commas.

This output is only computed if the client requests it.
"""

MODEL_OUTPUTS = [OutputTensor(name) for name in OUTPUTS]  # type: ignore[arg-type]
"""Outputs that are computed for a request that lists no outputs."""


def read_infer(body: bytes, header_length: bytes) -> tuple[InferBody, bytes]:
    """Read a request for an inference from the body of an HTTP request.

    Args:
        body: The body, after it was decompressed.
        header_length: Value of the header Inference-Header-Content-Length, which is the length of the JSON text, bytes.

    Returns:
        The content of the JSON text, and the bytes that follow the text.

    Raises:
        RequestError: If the body is not a request for an inference.
    """
    # The characters are checked before the conversion, because int() also accepts signs, blanks and underscores, and is
    # slow for long texts.
    if not header_length.isdigit() or len(header_length) > len(str(len(body))):
        raise RequestError(
            f"Inference-Header-Content-Length: expected a whole number up to {len(body)}, the bytes of the body, "
            f"got {header_length.decode('latin-1')!r:.50}"
        )
    json_length = int(header_length)
    return parse_json(body[:json_length], "", RequestError, InferBody), body[json_length:]


def _read_charges(tensor: InputTensor, binary: bytes, electrodes: tuple[str, ...]) -> Singles:
    """Return the charges of an input tensor, shape (n, electrodes), pC.

    Args:
        tensor: Input tensor of the request.
        binary: Binary tensor with the charges. It is empty if the input tensor itself contains the charges.
        electrodes: Names of the electrodes of the model, in the order of the charges.

    Raises:
        RequestError: If the shape or the data are not valid, or if there are too many presses.
        ChargeError: If a charge is not finite.
    """
    shape = tensor.shape
    if len(shape) != 2 or shape[0] < 1 or shape[1] != len(electrodes):
        raise RequestError(
            f"input {INPUT!r}: expected the shape [n, {len(electrodes)}] with n > 0, "
            f"a column for each of {electrodes}, got {shape!r:.100}"
        )
    if shape[0] > MAX_BATCH:  # the HTTP status 413 means that the content is too large
        raise RequestError(f"input {INPUT!r}: expected at most {MAX_BATCH} presses in one request, got {shape[0]}", 413)

    number_count = math.prod(shape)
    dtype = np.dtype(DATATYPES[tensor.datatype])
    try:
        charges = np.frombuffer(binary, dtype) if tensor.data is None else np.asarray(tensor.data, np.float64)
    except ValueError:  # an incomplete number, or rows of different lengths
        charges = np.empty(0)  # an empty array is refused below, because its shape is not accepted
    is_sent_twice = binary and tensor.data is not None  # as a binary tensor that is not empty, and as a list
    accepted_shapes = (tuple(shape), (number_count,))  # in rows or flat
    if is_sent_twice or charges.shape not in accepted_shapes:
        raise RequestError(
            f"input {INPUT!r}: expected {number_count} numbers for the shape {shape}, flat or in rows of equal length, "
            f"or {number_count} binary numbers of {dtype.itemsize} bytes each, got an array of the shape "
            f"{charges.shape} and {len(binary)} bytes"
        )
    return as_float32(charges.reshape(shape), electrodes)


def infer(loaded: LoadedVersion, body: InferBody, binary: bytes) -> tuple[Json, list[bytes]]:
    """Run a model on the presses of a request, and count the presses.

    Args:
        loaded: Version of the model that is run.
        body: Content of the request. If the content lists no outputs, the outputs of the model are returned.
        binary: Binary tensor with the charges, which is empty if the content contains the charges.

    Returns:
        The content of the response, in the form of the JSON object of an HTTP response, and the binary tensors of the
        response. The values of each output are either in a binary tensor or under the key `data`. The key `data`
        contains an array of numbers or, for the output `flags`, a list of texts.

    Raises:
        IsochargeError: If the request does not fit the model, or if the model fails.
    """
    charge_pC = _read_charges(body.inputs[0], binary, loaded.metadata.electrodes)
    contacts = loaded.predict_rows(charge_pC)
    misfits = contacts[:, COLUMNS["misfit"]]
    alarm_count = np.count_nonzero(~(misfits <= loaded.validity.misfit_limit))  # a NaN also counts as an alarm
    loaded.statistics.presses.inc(len(charge_pC))
    loaded.statistics.alarms.inc(float(alarm_count))

    content: Json = {"model_name": loaded.metadata.name, "model_version": loaded.version}
    if body.id:
        content["id"] = body.id
    content["outputs"] = []
    binary_tensors = []
    is_binary_by_default = (body.parameters or {}).get("binary_data_output")  # None, if not stated, means False
    for output in body.outputs or MODEL_OUTPUTS:
        name = output.name
        column_count = OUTPUTS.get(name, 1)  # `OUTPUTS` does not contain the output `flags`, which has one column
        tensor: Json = {"name": name, "datatype": "FP32", "shape": [len(charge_pC), column_count]}
        if name == FLAGS:
            flags_of_presses = loaded.validity.batch_flags(Contacts(*contacts.T))
            tensor["datatype"] = "BYTES"
            tensor["data"] = [",".join(flags) for flags in flags_of_presses]
        else:
            tensor["data"] = contacts[:, COLUMNS[name]].ravel()
        if (output.parameters or {}).get("binary_data", is_binary_by_default):
            # Move the values from the key `data` of the tensor into bytes, and state their size in the tensor.
            binary_tensors.append(_take_binary_tensor(tensor))
        content["outputs"].append(tensor)
    return content, binary_tensors


def _take_binary_tensor(tensor: Json) -> bytes:
    """Remove the values of an output from its JSON object, add their size, and return the values as a binary tensor.

    In a binary tensor, numbers are little-endian float32. Each text is preceded by its length in bytes, a 32-bit
    unsigned integer.
    """
    values = tensor.pop("data")
    if tensor["datatype"] == "BYTES":
        data = b"".join(struct.pack("<I", len(text)) + text.encode() for text in values)
    else:
        data = values.astype("<f4", copy=False).tobytes()
    tensor["parameters"] = {"binary_data_size": len(data)}
    return data
