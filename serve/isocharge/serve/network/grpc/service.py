"""The methods of `inference.GRPCInferenceService`, on the models of the HTTP handler."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import grpc
from google.protobuf.json_format import ParseDict

from isocharge.errors import ModelNotFound, RequestError
from isocharge.serve.network.grpc.messages import METHODS, SERVICE
from isocharge.serve.network.grpc.tensors import read_infer, write_answer
from isocharge.serve.network.protocol import Handler, describe
from isocharge.serve.network.protocol.infer import answer_inference
from isocharge.serve.network.protocol.status import client_message, grpc_status
from isocharge.serve.network.token import Token

OPEN = ("ServerLive", "ServerReady")
"""Methods that need no token."""


class Service:
    """One method for each of the protocol's: a request message in, the fields of the answer out."""

    def __init__(self, handler: Handler) -> None:
        """Answer from the handler's models, within its limits."""
        self._store, self._limits = handler.store, handler.limits

    def ServerLive(self, _: Any) -> dict[str, Any]:
        return {"live": True}

    def ServerReady(self, _: Any) -> dict[str, Any]:
        return {"ready": bool(self._store.all())}

    def ModelReady(self, request: Any) -> dict[str, Any]:
        try:
            return {"ready": bool(self._store.get(request.name, request.version))}
        except ModelNotFound:
            return {"ready": False}

    def ServerMetadata(self, _: Any) -> dict[str, Any]:
        return describe.server_metadata()

    def ModelMetadata(self, request: Any) -> dict[str, Any]:
        return describe.model_metadata(self._store.get(request.name, request.version), self._store)

    def ModelConfig(self, request: Any) -> dict[str, Any]:
        return {"config": describe.model_config(self._store.get(request.name, request.version), self._limits)}

    def ModelStatistics(self, request: Any) -> dict[str, Any]:
        return describe.statistics_of(self._store, request.name, request.version)

    def RepositoryIndex(self, request: Any) -> dict[str, Any]:
        return {"models": describe.repository_index(self._store, ready=request.ready)}

    def RepositoryModelLoad(self, request: Any) -> dict[str, Any]:
        if request.parameters:
            raise RequestError(describe.NO_LOAD_PARAMETERS)
        self._store.load(request.model_name)
        return {}

    def RepositoryModelUnload(self, request: Any) -> dict[str, Any]:
        self._store.unload(request.model_name)
        return {}

    def ModelInfer(self, request: Any) -> Any:
        loaded = self._store.get(request.model_name, request.model_version)
        read = partial(read_infer, request, loaded.metadata.electrodes, self._limits.batch)
        return answer_inference(loaded, read, lambda answer: write_answer(answer, METHODS["ModelInfer"][1]()))

    def ModelStreamInfer(self, request: Any) -> dict[str, Any]:
        """One answer for one request of a stream; an error is an answer too, and the stream goes on."""
        try:
            return {"infer_response": self.ModelInfer(request)}
        except Exception as error:
            return {"error_message": client_message(error)}


def handlers(service: Service, token: Token | None) -> grpc.GenericRpcHandler:
    """The service as grpcio takes it."""
    methods = {name: _method(name, getattr(service, name), token) for name in METHODS}
    return grpc.method_handlers_generic_handler(SERVICE, methods)


def _method(name: str, answer: Callable[[Any], Any], token: Token | None) -> grpc.RpcMethodHandler:
    request_type, response_type = METHODS[name]
    secret = None if name in OPEN else token
    codec = {"request_deserializer": request_type.FromString, "response_serializer": response_type.SerializeToString}

    def answer_one(request: Any, context: grpc.ServicerContext) -> Any:
        try:
            _check(secret, context)
            return _message(answer(request), response_type)
        except Exception as error:  # the one place where an error becomes an answer
            return context.abort(grpc.StatusCode[grpc_status(error)], client_message(error))

    def answer_each(requests: Iterator[Any], context: grpc.ServicerContext) -> Iterator[Any]:
        yield from (answer_one(request, context) for request in requests)

    if name == "ModelStreamInfer":
        return grpc.stream_stream_rpc_method_handler(answer_each, **codec)
    return grpc.unary_unary_rpc_method_handler(answer_one, **codec)


def _check(token: Token | None, context: grpc.ServicerContext) -> None:
    if token is not None:
        sent = dict(context.invocation_metadata()).get("authorization", "")
        token.check(sent.encode() if isinstance(sent, str) else sent)


def _message(fields: Any, response: type[Any]) -> Any:
    """The message of an answer, from its fields; a message stays as it is."""
    if isinstance(fields, response):
        return fields
    parts = {name: value for name, value in fields.items() if hasattr(value, "DESCRIPTOR")}
    plain = {name: value for name, value in fields.items() if name not in parts}
    return ParseDict(plain, response(**parts))
