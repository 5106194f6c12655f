"""The methods of `inference.GRPCInferenceService`, on the models of the HTTP handler.

What a client sends is a stream to grpcio also where it is one message: so the token is checked, and the bounds hold,
before a message comes, and whether one comes at all. A client may open calls and say nothing: when all places are
taken, the call that has waited longest for its client gives its place to the new one.
"""

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import grpc
import grpc.aio
from google.protobuf.json_format import ParseDict
from google.protobuf.message import DecodeError, Message

from isocharge.common.errors import RequestError, TooMany
from isocharge.serve.network.grpc.messages import METHODS, SERVICE, read_infer, write_answer
from isocharge.serve.network.protocol import Handler, describe
from isocharge.serve.network.protocol.infer import answer_inference
from isocharge.serve.network.protocol.response import client_message, statuses
from isocharge.serve.network.traffic import Exchange

OPEN = ("ServerLive", "ServerReady")
"""Methods that need no token."""

BLOCKING = ("RepositoryModelLoad", "RepositoryModelUnload")
"""Methods that may take longer than others should wait: they are answered in other threads."""

STREAM = "ModelStreamInfer"
"""The method of many messages."""


@dataclass
class _Call:
    """What is known of a call for counters and log: the model that was asked, and the sizes of its messages."""

    model: str | None = None
    bytes_in: int = 0
    bytes_out: int = 0


class Service:
    """Answers calls from the models of a handler, within its limits."""

    def __init__(self, handler: Handler) -> None:
        """No call is open yet."""
        self._limits, self._traffic, self._token = handler.limits, handler.traffic, handler.token
        self._store = store = handler.store
        self._open = 0
        self._waiting: dict[asyncio.Timeout, None] = {}  # in the order in which they began to wait
        self._traffic.open["grpc"] = lambda: self._open
        self._answers: dict[str, Callable[[Any], Any]] = {
            "ServerLive": lambda _: {"live": True},
            "ServerReady": lambda _: {"ready": bool(store.all())},
            "ModelReady": lambda request: {"ready": store.label(request.name, request.version) is not None},
            "ServerMetadata": lambda _: describe.server_metadata(),
            "ModelMetadata": lambda request: describe.model_metadata(store.get(request.name, request.version), store),
            "ModelConfig": self._config,
            "ModelStatistics": lambda request: describe.statistics_of(store, request.name, request.version),
            "RepositoryIndex": lambda request: {"models": describe.repository_index(store, ready=request.ready)},
            "RepositoryModelLoad": self._load,
            "RepositoryModelUnload": lambda request: store.unload(request.model_name),
            "ModelInfer": self._infer,
            STREAM: self._infer_in_stream,
        }

    def handlers(self) -> grpc.GenericRpcHandler:
        """The service as grpcio takes it."""
        methods = {name: grpc.stream_unary_rpc_method_handler(partial(self._handle, name)) for name in METHODS}
        methods[STREAM] = grpc.stream_stream_rpc_method_handler(partial(self._handle, STREAM))
        return grpc.method_handlers_generic_handler(SERVICE, methods)

    async def _handle(self, name: str, _: object, context: grpc.aio.ServicerContext) -> Any:
        call, began, status, error_kind = _Call(), time.perf_counter_ns(), "CANCELLED", None
        try:
            with self._place():
                if self._token is not None and name not in OPEN:
                    self._token.check(_authorization(context))
                answered = await (self._converse(context, call) if name == STREAM else self._once(name, context, call))
            status = "OK"
            return answered
        except TimeoutError as error:
            status, error_kind = "DEADLINE_EXCEEDED", type(error).__name__
            message = "the call waited too long for its client, or others needed its place"
        except Exception as error:  # the one place where an error becomes an answer
            status, error_kind, message = statuses(error)[1], type(error).__name__, client_message(error)
        finally:  # a client that went away cancels the call
            ns, sizes = time.perf_counter_ns() - began, (call.bytes_in, call.bytes_out)
            peer = context.peer() if self._traffic.log else None
            self._traffic.note(Exchange("grpc", name, status, call.model, error_kind, ns, *sizes, peer))
        return await context.abort(grpc.StatusCode[status], message)

    async def _once(self, name: str, context: grpc.aio.ServicerContext, call: _Call) -> bytes:
        """Answer the one message of a call."""
        data = await self._next(context, self._limits.header_seconds)
        if data is grpc.aio.EOF:
            raise RequestError(f"{name}: expected a message, got none")
        if name in BLOCKING:
            return await asyncio.to_thread(self._answer, name, data, call)
        return self._answer(name, data, call)

    async def _converse(self, context: grpc.aio.ServicerContext, call: _Call) -> None:
        """Answer each message of a stream."""
        seconds = self._limits.header_seconds
        while (data := await self._next(context, seconds)) is not grpc.aio.EOF:
            async with asyncio.timeout(self._limits.body_seconds):
                await context.write(self._answer(STREAM, data, call))
            seconds = self._limits.idle_seconds

    def _answer(self, name: str, data: bytes, call: _Call) -> bytes:
        request_type, response_type = METHODS[name]
        call.bytes_in += len(data)
        try:
            request = request_type.FromString(data)
        except DecodeError as error:
            expected = request_type.DESCRIPTOR.name
            raise RequestError(f"expected a {expected}, got {len(data)} bytes of another kind") from error
        call.model = self._store.label(
            getattr(request, "model_name", "") or getattr(request, "name", ""),
            getattr(request, "model_version", "") or getattr(request, "version", ""),
        )
        fields = self._answers[name](request)
        answer = fields if isinstance(fields, Message) else ParseDict(fields or {}, response_type())
        message: bytes = answer.SerializeToString()
        call.bytes_out += len(message)
        return message

    def _config(self, request: Any) -> dict[str, Any]:
        return {"config": describe.model_config(self._store.get(request.name, request.version), self._limits)}

    def _load(self, request: Any) -> None:
        if request.parameters:
            raise RequestError(describe.NO_LOAD_PARAMETERS)
        self._store.load(request.model_name)

    def _infer(self, request: Any) -> Any:
        loaded = self._store.get(request.model_name, request.model_version)
        read = partial(read_infer, request, loaded.metadata.electrodes, self._limits.batch)
        return answer_inference(loaded, read, lambda answer: write_answer(answer, METHODS["ModelInfer"][1]()))

    def _infer_in_stream(self, request: Any) -> Any:
        """One answer for one request of a stream; an error is an answer too, and the stream goes on."""
        status, response = "OK", METHODS[STREAM][1]
        try:
            answer = response(infer_response=self._infer(request))
        except Exception as error:
            status, answer = statuses(error)[1], response(error_message=client_message(error))
        self._traffic.count("grpc", f"{STREAM} message", status)
        return answer

    @contextmanager
    def _place(self) -> Iterator[None]:
        """A place for a call; if there is none, the one that has waited longest for its client ends.

        Raises:
            TooMany: If none waits.
        """
        if self._open >= self._limits.connections:
            if not self._waiting:
                raise TooMany(f"all {self._limits.connections} calls are taken; try again later")
            oldest = next(iter(self._waiting))
            del self._waiting[oldest]
            oldest.reschedule(asyncio.get_running_loop().time())
        self._open += 1
        try:
            yield
        finally:
            self._open -= 1

    async def _next(self, context: grpc.aio.ServicerContext, seconds: float) -> Any:
        """The next message of a call, or grpc.aio.EOF.

        Raises:
            TimeoutError: If it takes longer, or the place is needed.
        """
        async with asyncio.timeout(seconds) as timeout:
            self._waiting[timeout] = None
            try:
                return await context.read()
            finally:
                self._waiting.pop(timeout, None)


def _authorization(context: grpc.aio.ServicerContext) -> bytes:
    """The value of the metadata `authorization`, empty if there is none."""
    sent = dict(context.invocation_metadata() or ()).get("authorization", "")
    return sent.encode() if isinstance(sent, str) else bytes(sent)
