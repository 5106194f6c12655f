"""The body of an inference request: JSON, followed by binary tensors if the headers say where the JSON ends."""

from typing import Any

import orjson

from isocharge.arrays import Singles
from isocharge.errors import RequestError
from isocharge.serve.network.protocol.infer import InferRequest
from isocharge.serve.network.protocol.tensors import (
    Head,
    charges_from_bytes,
    charges_from_values,
    check_head,
    check_outputs,
)

NOT_HERE = ("shared_memory_region", "classification")
"""Parameters of Triton that change what a request means and that this server does not know."""

ALL = check_outputs(())

ALL_BINARY, NONE = frozenset(ALL), frozenset[str]()


def read_object(text: bytes | memoryview) -> dict[str, Any]:
    """A JSON object; nothing at all is an empty one.

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
    # isdigit first: int() takes signs, blanks and underscores, and a long text long.
    if not header.isdigit() or len(header) > 12 or int(header) > size:
        raise RequestError(
            f"Inference-Header-Content-Length: expected a whole number up to {size}, the bytes of the body, "
            f"got {header.decode('latin-1')!r:.50}"
        )
    return int(header)


def read_infer(body: bytes, header_length: bytes | None, electrodes: tuple[str, ...], batch: int) -> InferRequest:
    """The request in a body.

    Args:
        body: Not compressed.
        header_length: Value of Inference-Header-Content-Length, None without binary data.
        electrodes: Of the model.
        batch: Presses that one request may have.

    Raises:
        RequestError, ChargeError, TooLarge: If it is not a request for a model with these electrodes.
    """
    end = len(body) if header_length is None else _length(header_length, len(body))
    content = read_object(body if header_length is None else body[:end])
    asked = content.get("id", "")
    if not isinstance(asked, str):
        raise RequestError(f"id: expected a text, got {asked!r:.100}")
    all_binary = _flag(content, "binary_data_output", default=False)
    outputs, binary = _outputs(_list(content, "outputs"), all_binary)
    charges = _charges(_list(content, "inputs"), memoryview(body)[end:], electrodes, batch)
    return InferRequest(asked, charges, outputs, binary)


def _charges(inputs: list[Any], binary: memoryview, electrodes: tuple[str, ...], batch: int) -> Singles:
    if len(inputs) != 1 or not isinstance(inputs[0], dict):
        raise RequestError(f"expected `inputs`, a list with one tensor, got {inputs!r:.100}")
    tensor = inputs[0]
    head = check_head(tensor.get("name"), tensor.get("datatype"), tensor.get("shape"), electrodes, batch)
    size = _parameters(tensor).get("binary_data_size")
    if size is None and not binary:
        return charges_from_values(tensor.get("data"), head, electrodes)
    return charges_from_bytes(_binary(size, tensor, binary, head), head, electrodes)


def _binary(size: Any, tensor: dict[str, Any], binary: memoryview, head: Head) -> memoryview:
    """The bytes of the one input; there must be as many as announced, and no `data` beside them."""
    if type(size) is not int or size != len(binary) or "data" in tensor:
        raise RequestError(
            f"expected either `data` or {head.nbytes} bytes after the JSON, announced by `binary_data_size` of the "
            f"input and Inference-Header-Content-Length, got binary_data_size {size!r:.50} and {len(binary)} bytes"
        )
    return binary


def _outputs(asked: list[Any], all_binary: bool) -> tuple[tuple[str, ...], frozenset[str]]:
    if not asked:
        return ALL, ALL_BINARY if all_binary else NONE
    if not all(isinstance(output, dict) for output in asked):
        raise RequestError(f"expected `outputs`, a list of objects with a name, got {asked!r:.100}")
    names = check_outputs([output.get("name") for output in asked])
    binary = (output["name"] for output in asked if _flag(output, "binary_data", default=all_binary))
    return names, frozenset(binary)


def _list(content: dict[str, Any], key: str) -> list[Any]:
    value = content.get(key, [])
    if not isinstance(value, list):
        raise RequestError(f"{key}: expected a list, got {value!r:.100}")
    return value


def _parameters(holder: dict[str, Any]) -> dict[str, Any]:
    """The parameters of a request or tensor; those that nobody here knows mean nothing, as with Triton."""
    parameters = holder.get("parameters")
    if parameters is None:
        return {}
    if not isinstance(parameters, dict):
        raise RequestError(f"parameters: expected an object, got {parameters!r:.100}")
    for name in NOT_HERE:
        if parameters.get(name):
            raise RequestError(f"parameters: {name!r} is not supported by this server")
    return parameters


def _flag(holder: dict[str, Any], name: str, *, default: bool) -> bool:
    """A yes or no among the parameters of a request or tensor."""
    value = _parameters(holder).get(name, default)
    if not isinstance(value, bool):
        raise RequestError(f"the parameter {name!r}: expected true or false, got {value!r:.100}")
    return value
