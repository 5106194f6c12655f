"""The methods of `inference.GRPCInferenceService`, on the models of the HTTP handler."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import grpc
import grpc.aio
from google.protobuf.json_format import ParseDict
from google.protobuf.message import DecodeError

from isocharge.common.errors import ModelNotFound, RequestError
from isocharge.serve.network.credentials import Token
from isocharge.serve.network.grpc.messages import METHODS, SERVICE, read_infer, write_answer
from isocharge.serve.network.grpc.open_calls import OpenCalls
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.protocol import Handler, describe
from isocharge.serve.network.protocol.infer import answer_inference
from isocharge.serve.network.protocol.response import client_message, grpc_status
from isocharge.serve.network.traffic import Exchange

OPEN = ("ServerLive", "ServerReady")
"""Methods that need no token."""

BLOCKING = ("RepositoryModelLoad", "RepositoryModelUnload")
"""Methods that may take longer than others should wait: they are answered in other threads."""

STREAM = "ModelStreamInfer"
"""The method of many messages."""

STREAM_MESSAGE = f"{STREAM} message"
"""What one of its messages is counted as."""


class Service:
    """One method for each of the protocol's: a request message in, the fields of the answer out."""

    def __init__(self, handler: Handler) -> None:
        """Answer from the handler's models, within its limits."""
        self._store, self._limits, self.traffic = handler.store, handler.limits, handler.traffic

    def model_label(self, request: Any) -> str | None:
        """`name/version` of the model that a request names, None if it names none or it does not serve."""
        name = getattr(request, "model_name", "") or getattr(request, "name", "")
        version = getattr(request, "model_version", "") or getattr(request, "version", "")
        return self._store.label(name, version)

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
        response = METHODS["ModelInfer"][1]
        return answer_inference(loaded, read, lambda answer: write_answer(answer, response()), over_grpc=True)

    def ModelStreamInfer(self, request: Any) -> dict[str, Any]:
        """One answer for one request of a stream; an error is an answer too, and the stream goes on."""
        try:
            answer = {"infer_response": self.ModelInfer(request)}
        except Exception as error:
            self.traffic.count("grpc", STREAM_MESSAGE, grpc_status(error))
            return {"error_message": client_message(error)}
        self.traffic.count("grpc", STREAM_MESSAGE, "OK")
        return answer


@dataclass
class _Call:
    """What is known of a call for counters and log: the model that was asked, and the sizes of its messages."""

    model: str | None = None
    bytes_in: int = 0
    bytes_out: int = 0


def handlers(service: Service, limits: ServerLimits, token: Token | None) -> grpc.GenericRpcHandler:
    """The service as grpcio takes it.

    What a client sends is a stream to grpcio also where it is one message, which comes as the same bytes: so the token
    is checked, and the bounds hold, before a message comes, and whether one comes at all.
    """
    calls = OpenCalls(limits.connections)
    service.traffic.open["grpc"] = lambda: len(calls)
    return grpc.method_handlers_generic_handler(
        SERVICE, {name: _method(name, service, calls, limits, token) for name in METHODS}
    )


def _method(
    name: str, service: Service, calls: OpenCalls, limits: ServerLimits, token: Token | None
) -> grpc.RpcMethodHandler:
    (request_type, response_type), answer = METHODS[name], getattr(service, name)

    def answer_bytes(data: bytes, call: _Call) -> bytes:
        call.bytes_in += len(data)
        request = _read(request_type, data)
        call.model = service.model_label(request)
        message: bytes = _message(answer(request), response_type).SerializeToString()
        call.bytes_out += len(message)
        return message

    async def answer_one(context: grpc.aio.ServicerContext, call: _Call) -> bytes:
        data = await _next(context, calls, limits.header_seconds)
        if data is grpc.aio.EOF:
            raise RequestError(f"{name}: expected a message, got none")
        return await asyncio.to_thread(answer_bytes, data, call) if name in BLOCKING else answer_bytes(data, call)

    async def answer_each(context: grpc.aio.ServicerContext, call: _Call) -> None:
        seconds = limits.header_seconds
        while (data := await _next(context, calls, seconds)) is not grpc.aio.EOF:
            async with asyncio.timeout(limits.body_seconds):
                await context.write(answer_bytes(data, call))
            seconds = limits.idle_seconds

    converse: Callable[[grpc.aio.ServicerContext, _Call], Awaitable[Any]]
    converse = answer_each if name == STREAM else answer_one

    async def handle(_: object, context: grpc.aio.ServicerContext) -> Any:
        call, began, status, error_kind = _Call(), time.perf_counter_ns(), "CANCELLED", None
        try:
            with calls.one_more():
                if token is not None and name not in OPEN:
                    token.check(_authorization(context))
                answered = await converse(context, call)
            status = "OK"
            return answered
        except TimeoutError as error:
            status, error_kind = "DEADLINE_EXCEEDED", type(error).__name__
            message = "the call waited too long for its client, or others needed its place"
        except Exception as error:  # the one place where an error becomes an answer
            status, error_kind, message = grpc_status(error), type(error).__name__, client_message(error)
        finally:  # a client that went away cancels the call
            ns, sizes = time.perf_counter_ns() - began, (call.bytes_in, call.bytes_out)
            peer = context.peer() if service.traffic.log else None
            service.traffic.note(Exchange("grpc", name, status, call.model, error_kind, ns, *sizes, peer))
        return await context.abort(grpc.StatusCode[status], message)

    if name == STREAM:
        return grpc.stream_stream_rpc_method_handler(handle)
    return grpc.stream_unary_rpc_method_handler(handle)


async def _next(context: grpc.aio.ServicerContext, calls: OpenCalls, seconds: float) -> Any:
    """The next message of a call, or grpc.aio.EOF."""
    async with calls.waiting(seconds):
        return await context.read()


def _read(request_type: type[Any], data: bytes) -> Any:
    try:
        return request_type.FromString(data)
    except DecodeError as error:
        raise RequestError(
            f"expected a {request_type.DESCRIPTOR.name}, got {len(data)} bytes of another kind"
        ) from error


def _authorization(context: grpc.aio.ServicerContext) -> bytes:
    """The value of the metadata `authorization`, empty if there is none."""
    sent = dict(context.invocation_metadata() or ()).get("authorization", "")
    return sent.encode() if isinstance(sent, str) else bytes(sent)


def _message(fields: Any, response: type[Any]) -> Any:
    """The message of an answer, from its fields; a message stays as it is."""
    if isinstance(fields, response):
        return fields
    parts = {name: value for name, value in fields.items() if hasattr(value, "DESCRIPTOR")}
    plain = {name: value for name, value in fields.items() if name not in parts}
    return ParseDict(plain, response(**parts))
