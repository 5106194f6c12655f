"""The protocol's messages as classes, built from the compiled `inference.proto`, and its tensors as values and back.

They live in a separate pool, so that a program may use this server and another implementation of the same protocol,
whose messages have the same names, side by side.
"""

from importlib.resources import files
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from isocharge.common.errors import RequestError
from isocharge.serve.network.protocol.request import InferAnswer, InferRequest, request_of

SERVICE = "inference.GRPCInferenceService"


def _load() -> Any:
    """The service's descriptor."""
    compiled = files("isocharge.serve.network.grpc").joinpath("inference.binpb").read_bytes()
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(compiled).file:
        pool.Add(file)
    return pool.FindServiceByName(SERVICE)


METHODS: dict[str, tuple[type[Any], type[Any]]] = {
    method.name: (GetMessageClass(method.input_type), GetMessageClass(method.output_type)) for method in _load().methods
}
"""Method name to the classes of its request and its answer."""


CONTENTS = {"FP32": "fp32_contents", "FP64": "fp64_contents"}
"""Which field of a tensor's contents has its numbers."""


def read_infer(message: Any, electrodes: tuple[str, ...], batch: int) -> InferRequest:
    """The request in a ModelInferRequest. Raw numbers are answered with raw numbers, typed ones with typed ones.

    Raises:
        RequestError, ChargeError, TooLarge: If it is not one for a model with these electrodes.
    """
    raw = message.raw_input_contents
    if len(raw) > 1:
        raise RequestError(f"expected one input tensor, got {len(raw)} raw contents")
    content = {
        "id": message.id,
        "inputs": [_input(tensor, raw) for tensor in message.inputs],
        "outputs": [{"name": output.name, "parameters": _unsupported(output)} for output in message.outputs],
        "parameters": {"binary_data_output": bool(raw)},
    }
    return request_of(content, raw[0] if raw else b"", electrodes, batch)


def _input(tensor: Any, raw: Any) -> dict[str, Any]:
    """A tensor as JSON would have it."""
    parameters: dict[str, Any] = _unsupported(tensor)
    content = {"name": tensor.name, "datatype": tensor.datatype, "shape": list(tensor.shape), "parameters": parameters}
    if raw:
        parameters["binary_data_size"] = len(raw[0])
    if tensor.HasField("contents") or not raw:
        content["data"] = list(getattr(tensor.contents, CONTENTS.get(tensor.datatype, "fp32_contents")))
    return content


def _unsupported(tensor: Any) -> dict[str, bool]:
    """The parameters of a tensor that change what a request means and that this server does not know."""
    return {name: True for name in ("shared_memory_region", "classification") if name in tensor.parameters}


def write_answer(answer: InferAnswer, message: Any) -> Any:
    """Fill a ModelInferResponse."""
    message.model_name, message.model_version, message.id = answer.name, answer.version, answer.id
    for name, rows in answer.outputs.items():
        tensor = message.outputs.add(name=name, datatype="FP32", shape=rows.shape)
        if name in answer.binary:
            message.raw_output_contents.append(np.asarray(rows, dtype="<f4").tobytes())
        else:
            tensor.contents.fp32_contents.extend(rows.ravel().tolist())
    return message
