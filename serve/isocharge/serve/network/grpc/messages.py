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

from isocharge.common.arrays import Singles
from isocharge.common.errors import RequestError
from isocharge.serve.network.protocol.infer import InferAnswer, InferRequest
from isocharge.serve.network.protocol.tensors import (
    UNSUPPORTED,
    charges_from_bytes,
    charges_from_values,
    check_head,
    check_outputs,
)

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
    for holder in (*message.inputs, *message.outputs):
        for name in UNSUPPORTED:
            if name in holder.parameters:
                raise RequestError(f"the parameters of {holder.name[:100]!r}: {name!r} is not supported by this server")
    outputs = check_outputs([output.name for output in message.outputs])
    charges = _charges(message, electrodes, batch)
    return InferRequest(message.id, charges, outputs, frozenset(outputs if message.raw_input_contents else ()))


def _charges(message: Any, electrodes: tuple[str, ...], batch: int) -> Singles:
    raw = message.raw_input_contents
    if len(message.inputs) != 1 or len(raw) > 1:
        raise RequestError(f"expected one input tensor, got {len(message.inputs)} and {len(raw)} raw contents")
    (tensor,) = message.inputs
    head = check_head(tensor.name, tensor.datatype, list(tensor.shape), electrodes, batch)
    fields = {field.name for field, _ in tensor.contents.ListFields()}
    if fields - (set() if raw else {CONTENTS[tensor.datatype]}):
        raise RequestError(f"expected {CONTENTS[tensor.datatype]} or raw_input_contents, got {sorted(fields)}")
    if raw:
        return charges_from_bytes(raw[0], head, electrodes)
    return charges_from_values(list(getattr(tensor.contents, CONTENTS[tensor.datatype])), head, electrodes)


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
