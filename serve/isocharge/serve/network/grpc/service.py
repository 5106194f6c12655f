"""The gRPC server: `inference.GRPCInferenceService` on the models, limits, token and certificate of the HTTP server.

It has an event loop of its own. An open call costs no thread, so that no number of clients that open calls and wait can
hold up the others. What a client sends is a stream to grpcio also where it is one message: so the token is checked, and
the bounds hold, before a message comes, and whether one comes at all. A client may open calls and say nothing: when all
places are taken, the call that has waited longest for its client gives its place to the new one.

The messages are built from the compiled `inference.proto`. They live in a separate pool, so that a program may use this
server and another implementation of the same protocol, whose messages have the same names, side by side.
"""

import asyncio
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from threading import Thread
from typing import Any

import grpc
import grpc.aio
import uvloop
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.json_format import ParseDict
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from isocharge.common.errors import ListenError, RequestError, TooMany
from isocharge.serve.network.address import ServerLimits, Tls
from isocharge.serve.network.model_store import LoadedVersion
from isocharge.serve.network.protocol import Handler, describe
from isocharge.serve.network.protocol.inference import (
    FLAGS,
    InferAnswer,
    InferRequest,
    answer_inference,
    packed,
    request_of,
)
from isocharge.serve.network.protocol.response import client_message, statuses
from isocharge.serve.network.traffic import Exchange

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


def read_infer(message: Any, loaded: LoadedVersion, batch: int) -> InferRequest:
    """The request in a ModelInferRequest. Raw numbers are answered with raw numbers, typed ones with typed ones.

    Raises:
        RequestError, ChargeError, TooLarge: If it is not one for this model.
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
    return request_of(content, raw[0] if raw else b"", loaded, batch)


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
        tensor = message.outputs.add(name=name, datatype="BYTES" if name == FLAGS else "FP32", shape=rows.shape)
        if name in answer.binary:
            message.raw_output_contents.append(packed(rows))
        elif name == FLAGS:
            tensor.contents.bytes_contents.extend(text.encode() for text in rows[:, 0].tolist())
        else:
            tensor.contents.fp32_contents.extend(rows.ravel().tolist())
    return message


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
            "ServerReady": lambda _: {"ready": bool(store.loaded_versions())},
            "ModelReady": lambda request: {"ready": store.label(request.name, request.version) is not None},
            "ServerMetadata": lambda _: describe.server_metadata(),
            "ModelMetadata": lambda request: describe.model_metadata(store.get(request.name, request.version), store),
            "ModelConfig": lambda request: {
                "config": describe.model_config(store.get(request.name, request.version), self._limits)
            },
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

    def _load(self, request: Any) -> None:
        if request.parameters:
            raise RequestError(describe.NO_LOAD_PARAMETERS)
        self._store.load(request.model_name)

    def _infer(self, request: Any) -> Any:
        loaded = self._store.get(request.model_name, request.model_version)
        read = partial(read_infer, request, loaded, self._limits.batch)
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


GRACE_SECONDS = 10
"""Time that requests which have begun get when the server stops, s."""

STREAMS = 100
"""Calls of one connection at a time, as HTTP/2 advises at least; a client's further calls wait on its side."""


@contextmanager
def grpc_server(handler: Handler, host: str, port: int, tls: Tls | None = None) -> Iterator[str]:
    """Serve for as long as the block lasts.

    Args:
        handler: Handler of the HTTP server; its models, limits and token are used. Clients send the token as metadata
            `authorization`.
        host, port: Where to listen; port 0 takes a free one.
        tls: Certificate and key; without them the connection is plain.

    Yields:
        The address, `grpc://host:port` or `grpcs://host:port`.

    Raises:
        ListenError: If the address is taken or impossible.
        InputError: If a TLS file cannot be used.
    """
    with _event_loop() as loop:

        def run(coroutine: Coroutine[Any, Any, Any]) -> Any:
            return asyncio.run_coroutine_threadsafe(coroutine, loop).result()

        place = f"[{host}]" if ":" in host else host
        server, listening = run(_start(handler, f"{place}:{port}", tls))
        try:
            yield f"{'grpcs' if tls else 'grpc'}://{place}:{listening}"
        finally:
            run(server.stop(GRACE_SECONDS))


@contextmanager
def _event_loop() -> Iterator[asyncio.AbstractEventLoop]:
    """An event loop that runs in its own thread."""
    loop = uvloop.new_event_loop()
    thread = Thread(target=loop.run_forever, name="grpc")
    thread.start()
    try:
        yield loop
    finally:
        asyncio.run_coroutine_threadsafe(loop.shutdown_default_executor(), loop).result()
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


async def _start(handler: Handler, place: str, tls: Tls | None) -> tuple[grpc.aio.Server, int]:
    """A server that answers, and the port that it listens on."""
    limits = handler.limits
    server = grpc.aio.server(options=_options(limits), maximum_concurrent_rpcs=2 * limits.connections)
    server.add_generic_rpc_handlers((Service(handler).handlers(),))
    listening = _listen(server, place, tls)
    await server.start()
    return server, listening


def _options(limits: ServerLimits) -> list[tuple[str, int]]:
    return [
        ("grpc.max_receive_message_length", limits.body_bytes),
        ("grpc.max_metadata_size", limits.header_bytes),
        ("grpc.absolute_max_metadata_size", limits.header_bytes),
        ("grpc.max_concurrent_streams", STREAMS),
        ("grpc.max_allowed_incoming_connections", limits.connections),
        ("grpc.server_handshake_timeout_ms", round(1e3 * limits.header_seconds)),
        ("grpc.max_connection_idle_ms", round(1e3 * limits.idle_seconds)),
        ("grpc.so_reuseport", 0),
    ]


def _listen(server: grpc.aio.Server, place: str, tls: Tls | None) -> int:
    """The port that the server listens on."""
    try:
        if tls is None:
            return int(server.add_insecure_port(place))
        return int(server.add_secure_port(place, grpc.ssl_server_credentials([tls.key_and_certificate()])))
    except RuntimeError as error:
        raise ListenError(
            f"cannot listen on {place} for gRPC: {error}; choose another --grpc-port or --host"
        ) from error
