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

    def ModelReady(self, asked: Any) -> dict[str, Any]:
        try:
            return {"ready": bool(self._store.get(asked.name, asked.version))}
        except ModelNotFound:
            return {"ready": False}

    def ServerMetadata(self, _: Any) -> dict[str, Any]:
        return describe.server_metadata()

    def ModelMetadata(self, asked: Any) -> dict[str, Any]:
        return describe.model_metadata(self._store.get(asked.name, asked.version), self._store)

    def ModelConfig(self, asked: Any) -> dict[str, Any]:
        return {"config": describe.model_config(self._store.get(asked.name, asked.version), self._limits)}

    def ModelStatistics(self, asked: Any) -> dict[str, Any]:
        return describe.statistics_of(self._store, asked.name, asked.version)

    def RepositoryIndex(self, asked: Any) -> dict[str, Any]:
        return {"models": describe.repository_index(self._store, ready=asked.ready)}

    def RepositoryModelLoad(self, asked: Any) -> dict[str, Any]:
        if asked.parameters:
            raise RequestError(describe.NO_LOAD_PARAMETERS)
        self._store.load(asked.model_name)
        return {}

    def RepositoryModelUnload(self, asked: Any) -> dict[str, Any]:
        self._store.unload(asked.model_name)
        return {}

    def ModelInfer(self, asked: Any) -> Any:
        served = self._store.get(asked.model_name, asked.model_version)
        read = partial(read_infer, asked, served.metadata.electrodes, self._limits.batch)
        return answer_inference(served, read, lambda answer: write_answer(answer, METHODS["ModelInfer"][1]()))

    def ModelStreamInfer(self, asked: Any) -> dict[str, Any]:
        """One answer for one request of a stream; an error is an answer and ends nothing."""
        try:
            return {"infer_response": self.ModelInfer(asked)}
        except Exception as error:
            return {"error_message": client_message(error)}


def handlers(service: Service, token: Token | None) -> grpc.GenericRpcHandler:
    """The service as grpcio takes it."""
    methods = {name: _method(name, getattr(service, name), token) for name in METHODS}
    return grpc.method_handlers_generic_handler(SERVICE, methods)


def _method(name: str, answer: Callable[[Any], Any], token: Token | None) -> grpc.RpcMethodHandler:
    request, response = METHODS[name]
    secret = None if name in OPEN else token
    codec = {"request_deserializer": request.FromString, "response_serializer": response.SerializeToString}

    def one(asked: Any, context: grpc.ServicerContext) -> Any:
        try:
            _check(secret, context)
            return _message(answer(asked), response)
        except Exception as error:  # the one place where an error becomes an answer
            return context.abort(grpc.StatusCode[grpc_status(error)], client_message(error))

    def many(asked: Iterator[Any], context: grpc.ServicerContext) -> Iterator[Any]:
        yield from (one(each, context) for each in asked)

    if name == "ModelStreamInfer":
        return grpc.stream_stream_rpc_method_handler(many, **codec)
    return grpc.unary_unary_rpc_method_handler(one, **codec)


def _check(token: Token | None, context: grpc.ServicerContext) -> None:
    if token is not None:
        sent = dict(context.invocation_metadata()).get("authorization", "")
        token.check(sent.encode() if isinstance(sent, str) else sent)


def _message(fields: Any, response: type[Any]) -> Any:
    """The answer's message, from its fields or as it is."""
    if isinstance(fields, response):
        return fields
    parts = {name: value for name, value in fields.items() if hasattr(value, "DESCRIPTOR")}
    plain = {name: value for name, value in fields.items() if name not in parts}
    return ParseDict(plain, response(**parts))
