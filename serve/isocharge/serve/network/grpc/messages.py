"""Message classes of the gRPC service, and functions that read requests and write responses.

The service is called `inference.GRPCInferenceService`. The message classes are created from the compiled file
`inference.proto` in a separate descriptor pool. A program can therefore also import another implementation of the
protocol, although the messages of both implementations have the same names.
"""

from importlib.resources import files
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from isocharge.common.errors import RequestError
from isocharge.common.structs import convert
from isocharge.serve.network.model_store import LoadedVersion
from isocharge.serve.network.protocol.inference import (
    FLAGS,
    InferBody,
    InferRequest,
    Rows,
    binary_tensor,
    check_request,
)

SERVICE = "inference.GRPCInferenceService"
"""Full name of the gRPC service."""


def _service_descriptor() -> Any:
    """Read the compiled protocol file, and return the descriptor of the service."""
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
"""Class of the request and class of the response, by the name of the method."""

CONTENT_FIELDS = {"FP32": "fp32_contents", "FP64": "fp64_contents"}
"""Field of the contents of a tensor that contains the numbers, by the type of the numbers."""


def read_request(message: Any, loaded: LoadedVersion, max_presses: int) -> InferRequest:
    """Read a ModelInferRequest, and return the charges and the requested outputs.

    The message is first converted to the JSON object that the equivalent HTTP request would contain, and is then
    checked like this object. If the charges are sent as raw contents, so are the outputs of the response.

    Args:
        message: The ModelInferRequest.
        loaded: Version of the model that is requested.
        max_presses: Largest number of presses in one request.

    Raises:
        RequestError: If the message is not a request for this model.
        ChargeError: If a charge is not finite.
        TooLarge: If the request contains more than `max_presses` presses.
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
    return check_request(convert(json_object, InferBody, "", RequestError), raw_charges or b"", loaded, max_presses)


def _input_object(tensor: Any, raw_charges: bytes | None) -> dict[str, Any]:
    """Convert an input tensor to the JSON object that describes the tensor in an HTTP request.

    Args:
        tensor: Message that contains the name, the number type and the shape of the tensor. It may also contain the
            numbers.
        raw_charges: Raw content of the request with the charges, or None if the request has no raw content. In an HTTP
            request, these bytes would follow the JSON text.
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
    # If the request contains both numbers and raw content, the object contains both. The function `check_request` then
    # refuses the object. It also refuses an unknown number type.
    if tensor.HasField("contents") or raw_charges is None:
        field = CONTENT_FIELDS.get(tensor.datatype, "fp32_contents")
        json_object["data"] = list(getattr(tensor.contents, field))
    return json_object


def _unsupported_parameters(tensor: Any) -> dict[str, bool]:
    """Return the unsupported parameters of a tensor, each with the value True.

    The server must refuse unsupported parameters, because they change the meaning of a request.
    """
    return {name: True for name in ("shared_memory_region", "classification") if name in tensor.parameters}


def write_response(loaded: LoadedVersion, request: InferRequest, outputs: dict[str, Rows]) -> Any:
    """Convert the outputs of a model to a ModelInferResponse.

    If an output was requested as a binary tensor, its values are sent as raw contents. The values of every other output
    are sent as a list of texts or numbers.

    Args:
        loaded: Version of the model that was run.
        request: The request, which states which outputs are sent as binary tensors.
        outputs: Values of the requested outputs by their names, each of shape (n, width).
    """
    tensors: list[dict[str, Any]] = []
    raw_contents: list[bytes] = []
    for name, rows in outputs.items():
        is_text = name == FLAGS
        tensor: dict[str, Any] = {"name": name, "datatype": "BYTES" if is_text else "FP32", "shape": rows.shape}
        if request.outputs[name]:
            raw_contents.append(binary_tensor(rows))
        elif is_text:
            tensor["contents"] = {"bytes_contents": [text.encode() for text in rows.ravel().tolist()]}
        else:
            tensor["contents"] = {"fp32_contents": rows.ravel().tolist()}
        tensors.append(tensor)
    _, response_type = METHODS["ModelInfer"]
    return response_type(
        model_name=loaded.metadata.name,
        model_version=loaded.version,
        id=request.id,
        outputs=tensors,
        raw_output_contents=raw_contents,
    )
