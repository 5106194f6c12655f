"""Messages of `inference.GRPCInferenceService`, and functions that convert them to requests and answers.

The message classes are built from the compiled `inference.proto` in a separate descriptor pool. A program may therefore
also use another implementation of the protocol, although its messages have the same names.
"""

from importlib.resources import files
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from isocharge.common.errors import RequestError
from isocharge.serve.network.model_store import LoadedVersion
from isocharge.serve.network.protocol.inference import (
    FLAGS,
    InferAnswer,
    InferRequest,
    binary_tensor,
    parse_request,
)

SERVICE = "inference.GRPCInferenceService"
"""Full name of the service."""


def _service_descriptor() -> Any:
    """Return the descriptor of the service from the compiled protocol file."""
    compiled = files("isocharge.serve.network.grpc").joinpath("inference.binpb").read_bytes()
    pool = DescriptorPool()
    descriptor_set = FileDescriptorSet.FromString(compiled)
    for file_descriptor in descriptor_set.file:
        pool.Add(file_descriptor)
    return pool.FindServiceByName(SERVICE)


METHODS: dict[str, tuple[type[Any], type[Any]]] = {
    method.name: (GetMessageClass(method.input_type), GetMessageClass(method.output_type))
    for method in _service_descriptor().methods
}
"""Classes of the request and of the response of each method, by its name."""

CONTENT_FIELDS = {"FP32": "fp32_contents", "FP64": "fp64_contents"}
"""Field of a tensor's contents that holds the numbers, by number type."""


def read_request(message: Any, loaded: LoadedVersion, max_presses: int) -> InferRequest:
    """Parse a ModelInferRequest, and return the charges and the requested outputs.

    The message is converted to the JSON object of the HTTP protocol, and then parsed as such. If the charges of the
    request are raw contents, the outputs of the response are raw contents, too.

    Args:
        message: The message of gRPC.
        loaded: The model.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If the message is not a request for this model.
        ChargeError: If a charge is not finite.
        TooLarge: If there are more presses than `max_presses`.
    """
    raw_contents = message.raw_input_contents
    if len(raw_contents) > 1:
        raise RequestError(f"expected one input tensor, got {len(raw_contents)} raw contents")
    raw_charges = raw_contents[0] if raw_contents else None
    json_object = {
        "id": message.id,
        "inputs": [_input_object(tensor, raw_charges) for tensor in message.inputs],
        "outputs": [{"name": output.name, "parameters": _unsupported_parameters(output)} for output in message.outputs],
        "parameters": {"binary_data_output": raw_charges is not None},
    }
    return parse_request(json_object, raw_charges or b"", loaded, max_presses)


def _input_object(tensor: Any, raw_charges: bytes | None) -> dict[str, Any]:
    """Return an input tensor as the JSON object of the HTTP protocol.

    Args:
        tensor: Message with the name, the number type and the shape of the tensor, and possibly its numbers.
        raw_charges: Raw content of the request, which follows the JSON text in the HTTP protocol; None if the request
            has none.
    """
    parameters: dict[str, Any] = _unsupported_parameters(tensor)
    json_object = {
        "name": tensor.name,
        "datatype": tensor.datatype,
        "shape": list(tensor.shape),
        "parameters": parameters,
    }
    if raw_charges is not None:
        parameters["binary_data_size"] = len(raw_charges)
    # A tensor with both numbers and raw content gets both keys, and is refused when the object is parsed.
    if tensor.HasField("contents") or raw_charges is None:
        field = CONTENT_FIELDS.get(tensor.datatype, "fp32_contents")  # an unknown number type is refused then, too
        json_object["data"] = list(getattr(tensor.contents, field))
    return json_object


def _unsupported_parameters(tensor: Any) -> dict[str, bool]:
    """Return the parameters of a tensor that this server must refuse, because they change the meaning of a request."""
    return {name: True for name in ("shared_memory_region", "classification") if name in tensor.parameters}


def write_response(answer: InferAnswer) -> Any:
    """Return the outputs of a model as a ModelInferResponse.

    The values of an output are raw contents if the request asks for a binary tensor, and otherwise a list of texts or
    numbers.
    """
    _, response_type = METHODS["ModelInfer"]
    message = response_type()
    message.model_name = answer.name
    message.model_version = answer.version
    message.id = answer.id
    for name, rows in answer.outputs.items():
        is_text = name == FLAGS
        datatype = "BYTES" if is_text else "FP32"
        tensor = message.outputs.add(name=name, datatype=datatype, shape=rows.shape)
        if name in answer.binary:
            message.raw_output_contents.append(binary_tensor(rows))
        elif is_text:
            texts = rows[:, 0].tolist()  # this output has one column
            tensor.contents.bytes_contents.extend(text.encode() for text in texts)
        else:
            tensor.contents.fp32_contents.extend(rows.ravel().tolist())
    return message
