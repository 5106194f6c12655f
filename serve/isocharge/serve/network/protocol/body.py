"""The bodies of an inference request and its answer: JSON, then binary tensors if a header says where the JSON ends."""

from typing import Any

import orjson

from isocharge.common.arrays import Singles
from isocharge.common.errors import RequestError
from isocharge.serve.network.protocol.infer import InferAnswer, InferRequest
from isocharge.serve.network.protocol.tensors import charges_of, flag, outputs_of


def read_object(text: bytes | memoryview) -> dict[str, Any]:
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


def _length(header: bytes, size: int) -> int:
    # isdigit first: int() accepts signs, blanks and underscores, and takes long for a long text.
    if not header.isdigit() or len(header) > 12 or int(header) > size:
        raise RequestError(
            f"Inference-Header-Content-Length: expected a whole number up to {size}, the bytes of the body, "
            f"got {header.decode('latin-1')!r:.50}"
        )
    return int(header)


def read_infer(body: bytes, header_length: bytes | None, electrodes: tuple[str, ...], batch: int) -> InferRequest:
    """The request in a body.

    Args:
        body: The body, not compressed.
        header_length: Value of Inference-Header-Content-Length, None without binary data.
        electrodes: Names of the model's electrodes.
        batch: Presses that one request may have.

    Raises:
        RequestError, ChargeError, TooLarge: If it is not a request for a model with these electrodes.
    """
    end = len(body) if header_length is None else _length(header_length, len(body))
    content = read_object(body if header_length is None else body[:end])
    identifier = content.get("id", "")
    if not isinstance(identifier, str):
        raise RequestError(f"id: expected a text, got {identifier!r:.100}")
    all_binary = flag(content, "binary_data_output", default=False)
    outputs, binary = outputs_of(_list(content, "outputs"), all_binary=all_binary)
    inputs = _list(content, "inputs")
    if len(inputs) != 1 or not isinstance(inputs[0], dict):
        raise RequestError(f"expected `inputs`, a list with one tensor, got {inputs!r:.100}")
    charges = charges_of(inputs[0], memoryview(body)[end:], electrodes, batch)
    return InferRequest(identifier, charges, outputs, binary)


def _list(content: dict[str, Any], key: str) -> list[Any]:
    value = content.get(key, [])
    if not isinstance(value, list):
        raise RequestError(f"{key}: expected a list, got {value!r:.100}")
    return value


def write_answer(answer: InferAnswer) -> tuple[bytes, int | None]:
    """Put an answer into bytes.

    Args:
        answer: Outputs of the model, and which of them to send in binary.

    Returns:
        The body, and where its JSON ends if binary tensors follow.
    """
    content: dict[str, Any] = {"model_name": answer.name, "model_version": answer.version}
    if answer.id:
        content["id"] = answer.id
    content["outputs"] = [_tensor(name, rows, name in answer.binary) for name, rows in answer.outputs.items()]
    text = orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)
    if not answer.binary:
        return text, None
    parts = [rows.astype("<f4", copy=False).tobytes() for name, rows in answer.outputs.items() if name in answer.binary]
    return b"".join([text, *parts]), len(text)


def _tensor(name: str, rows: Singles, in_binary: bool) -> dict[str, Any]:
    """One tensor, its numbers flat and row by row, or only their number of bytes."""
    if in_binary:
        size = {"binary_data_size": rows.nbytes}
        return {"name": name, "datatype": "FP32", "shape": rows.shape, "parameters": size}
    return {"name": name, "datatype": "FP32", "shape": rows.shape, "data": rows.ravel()}
