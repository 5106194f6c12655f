"""gRPC service: numbers that are not raw contents, token, TLS, limits, silent clients, and the compiled messages."""

import asyncio
import itertools
import json
import re
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from threading import Event
from unittest.mock import AsyncMock, Mock

import grpc
import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from isocharge.serve.model.session import OUTPUTS
from isocharge.serve.network.address import ServerLimits, Tls
from isocharge.serve.network.browser_check import AccessCheck
from isocharge.serve.network.grpc import server
from isocharge.serve.network.grpc.service import METHODS, SERVICE, Service
from isocharge.serve.network.metrics import RequestLog, Traffic
from isocharge.serve.network.protocol.handler import Handler
from serve.network.http.test_server import wait_until

PROTO = Path(__file__).parents[4] / "serve/isocharge/serve/network/grpc/inference.proto"


@pytest.fixture
def serve(store, start_grpc):
    """Return a function that starts a server with given limits, and returns a function that opens channels to it."""
    with ExitStack() as stack:

        def start(token=None, **limits):
            handler = Handler(store, ServerLimits(**limits), access=AccessCheck(token=token))
            url = stack.enter_context(start_grpc(handler)).removeprefix("grpc://")
            # Each channel has its own connection.
            own = ("grpc.use_local_subchannel_pool", 1)
            return lambda *options: stack.enter_context(grpc.insecure_channel(url, [own, *options]))

        yield start


def call(channel, name, /, metadata=None, **fields):
    """Call a method with the fields of its request, and return the response."""
    request, response = METHODS[name]
    method = channel.unary_unary(
        f"/{SERVICE}/{name}",
        request_serializer=request.SerializeToString,
        response_deserializer=response.FromString,
    )
    return method(request(**fields), metadata=metadata, timeout=60)


def tensor(charges, datatype="FP32", **fields):
    """Return the fields of an input tensor with charges."""
    contents = {"FP32": "fp32_contents", "FP64": "fp64_contents"}[datatype]
    values = {"contents": {contents: np.ravel(charges).tolist()}}
    return {"name": "charge_pC", "datatype": datatype, "shape": list(np.shape(charges)), **values, **fields}


@pytest.mark.parametrize("datatype", ["FP32", "FP64"])
def test_charges_as_fp32_contents(serve, film, predictor, datatype):
    answer = call(serve()(), "ModelInfer", model_name="linear", id="7", inputs=[tensor(film.golden_pC(), datatype)])
    assert (answer.id, list(answer.raw_output_contents)) == ("7", [])
    assert [output.name for output in answer.outputs] == [*OUTPUTS]
    contact = answer.outputs[0]
    rows = np.float32(contact.contents.fp32_contents).reshape(contact.shape)
    np.testing.assert_array_equal(rows.T, predictor.predict_batch(film.golden_pC())[:3])


@pytest.mark.parametrize(
    ("fields", "status", "message"),
    [
        *(
            (
                {"inputs": [tensor([[1.0] * 3], contents=contents)], "raw_input_contents": raw},
                "INVALID_ARGUMENT",
                message,
            )
            for contents, raw, message in [
                ({"fp64_contents": [1.0] * 3}, [], "expected 3 numbers .* and 0 bytes"),
                ({"fp32_contents": [1.0] * 3}, [bytes(12)], r"of the shape \(3,\) and 12 bytes"),
                ({}, [bytes(4), bytes(8)], "one input tensor, got 2"),
                ({}, [bytes(11)], "expected 3 numbers .* and 11 bytes"),
            ]
        ),
        ({"inputs": [tensor([[1.0] * 3], shape=[5000, 3])]}, "RESOURCE_EXHAUSTED", "at most 4096 presses"),
        ({"model_name": "cubic"}, "NOT_FOUND", "'cubic' is not found; serving: linear/1, linear/2"),
    ],
)
def test_bad_requests_are_refused_with_the_reason(serve, fields, status, message):
    with pytest.raises(grpc.RpcError, match=message) as caught:
        call(serve()(), "ModelInfer", **{"model_name": "linear", **fields})
    assert caught.value.code() is grpc.StatusCode[status]
    assert not re.search("body|header|JSON|binary_data_size|`data`", caught.value.details())  # words of HTTP


def test_message_above_the_size_limit_is_refused(serve):
    with pytest.raises(grpc.RpcError) as caught:
        call(serve(body_bytes=1000)(), "ModelInfer", model_name="linear", raw_input_contents=[bytes(2000)])
    assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED


def test_calls_need_the_token(serve, silent_call):
    """The token is in the metadata, so that a call is refused before its first message."""
    channel = serve(token="open sesame")()
    ask = partial(call, channel)
    assert ask("ServerLive").live
    assert ask("ServerReady").ready
    assert ask("ModelMetadata", metadata=[("authorization", "Bearer open sesame")], name="linear").name == "linear"
    with pytest.raises(grpc.RpcError, match="this server's token"):
        ask("ServerMetadata", metadata=[("authorization", "Bearer sesame")])
    for name in ("ModelInfer", "ModelStreamInfer"):
        assert refusal(silent_call(channel, name)) == "UNAUTHENTICATED"


def test_server_with_tls(handler, start_grpc, authority, tls_files):
    trusted = grpc.ssl_channel_credentials(authority.cert_pem.bytes())
    with (
        start_grpc(handler, tls=Tls(tls_files / "both.pem", tls_files / "both.pem")) as url,
        grpc.secure_channel(url.removeprefix("grpcs://"), trusted) as channel,
    ):
        assert call(channel, "ServerLive").live


def test_compiled_protocol_file_equals_the_source(tmp_path):
    """Only the descriptors are compared, because compilers differ in details."""
    compiled = tmp_path / "new.binpb"
    options = [f"-I{PROTO.parent}", f"--descriptor_set_out={compiled}"]
    subprocess.run([sys.executable, "-m", "grpc_tools.protoc", *options, PROTO.name], check=True)
    stored_set = FileDescriptorSet.FromString(PROTO.with_suffix(".binpb").read_bytes())
    assert stored_set == FileDescriptorSet.FromString(compiled.read_bytes())


@pytest.fixture
def silent_call():
    """Return a function that opens a call, sends some messages, and then nothing until the test ends."""
    test_ended = Event()

    def wait_for_end():
        test_ended.wait()
        yield from ()

    def open_call(channel, name, messages=()):
        method = channel.stream_stream(
            f"/{SERVICE}/{name}",
            request_serializer=lambda message: message if isinstance(message, bytes) else message.SerializeToString(),
            response_deserializer=METHODS[name][1].FromString,
        )
        return method(itertools.chain(messages, wait_for_end()))

    yield open_call
    test_ended.set()


def is_served(channel):
    """Return whether the server answers a call."""
    return call(channel, "ServerMetadata").name == "isocharge"


def refusal(call):
    """Return the name of the status with which the server ends a call."""
    with pytest.raises(grpc.RpcError) as caught:
        next(call)
    return caught.value.code().name


@pytest.mark.parametrize(("name", "messages"), [("ModelInfer", 0), ("ModelStreamInfer", 0), ("ModelStreamInfer", 1)])
def test_silent_calls_are_closed(serve, silent_call, name, messages):
    """The limit is `header_seconds` before the first message, and `idle_seconds` after it."""
    connect = serve(header_seconds=0.3, idle_seconds=0.3)
    call = silent_call(connect(), name, [METHODS[name][0]()] * messages)
    for _ in range(messages):
        assert "is not found" in next(call).error_message
    assert refusal(call) == "DEADLINE_EXCEEDED"


def test_stop_ends_a_stream_that_waits_for_its_next_message(store, start_grpc, silent_call):
    """Calls whose response is being computed would have 10 s."""
    server = start_grpc(Handler(store))
    with grpc.insecure_channel(server.__enter__().removeprefix("grpc://")) as channel:
        call = silent_call(channel, "ModelStreamInfer", [METHODS["ModelStreamInfer"][0]()])
        next(call)
        start_s = time.monotonic()
        server.__exit__(None, None, None)
        assert time.monotonic() - start_s < 5.0
        assert call.code().name in ("DEADLINE_EXCEEDED", "OK")  # OK if the server did not wait yet


def test_stop_answers_a_message_that_is_being_received(store):
    context = Mock(write=AsyncMock())
    service = Service(Handler(store))

    async def receive():
        service.end_streams()
        await asyncio.sleep(0.01)
        return b""

    context.read = receive
    asyncio.run(service.handle("ServerReady", None, context))
    context.write.assert_called_once_with(b"\x08\x01")


def test_silent_connection_is_closed(store, start_grpc):
    """The limit is `header_seconds`, not the default of gRPC, which is two minutes."""
    with start_grpc(Handler(store, ServerLimits(header_seconds=0.1))) as url:
        host, port = url.removeprefix("grpc://").split(":")
        with socket.create_connection((host, int(port)), timeout=6.0) as silent:
            while silent.recv(1000):
                pass


def test_keepalive_pings_do_not_close_a_connection(serve, silent_call, monkeypatch):
    """By default, gRPC closes a connection after three pings within five minutes, or two hours without a call."""
    monkeypatch.setattr(server, "MIN_PING_MS", 500)
    connect = serve()
    pings = [
        ("grpc.keepalive_time_ms", 1000),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.max_pings_without_data", 0),
    ]
    idle_channel = connect(*pings)
    assert is_served(idle_channel)
    states = []
    idle_channel.subscribe(states.append)
    call = silent_call(connect(*pings), "ModelStreamInfer", [METHODS["ModelStreamInfer"][0]()])
    next(call)
    time.sleep(4.0)
    assert not call.done()
    assert states == [grpc.ChannelConnectivity.READY]


def test_end_of_a_connection_is_not_logged_as_an_error(store, caplog):
    """If a client ends a call whose responses it does not read, the pending response cannot be sent."""
    context = Mock(read=AsyncMock(return_value=b""), write=AsyncMock(side_effect=grpc.aio.InternalError))
    context.invocation_metadata.return_value = ()
    context.peer.return_value = "ipv4:127.0.0.1:50000"
    lines = []
    traffic = Traffic(RequestLog(lines.append))
    service = Service(Handler(store, None, traffic))
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(service.handle("ModelStreamInfer", None, context))
    labels = {"transport": "grpc", "route": "ModelStreamInfer", "status": "CANCELLED"}
    assert traffic.registry.get_sample_value("isocharge_requests_total", labels) == 1
    assert not caplog.records
    assert 0.0 < json.loads(lines[0])["duration_us"] < 1e6


def test_new_call_replaces_the_call_that_waits_longest(serve, silent_call):
    connect = serve(connections=5)
    silent_channel = connect()
    busy_channel = connect()
    silent_calls = [silent_call(silent_channel, "ModelStreamInfer") for _ in range(5)]
    time.sleep(0.3)
    assert all(is_served(busy_channel) for _ in range(3))
    wait_until(lambda: any(call.done() for call in silent_calls))  # the end reaches the client a moment later
    assert {refusal(call) for call in silent_calls if call.done()} == {"DEADLINE_EXCEEDED"}
    assert not all(call.done() for call in silent_calls)


def test_bytes_that_are_no_message_are_refused(serve, silent_call):
    """The status states a mistake of the client, not of the server."""
    channel = serve()()
    for name in ("ModelInfer", "ModelStreamInfer"):
        assert refusal(silent_call(channel, name, [b"\xff\xff\xff"])) == "INVALID_ARGUMENT"


def test_call_without_a_message_is_refused(serve):
    """Otherwise, its status would be OK although it has no response."""
    method = serve()().stream_stream(f"/{SERVICE}/ServerLive")
    assert refusal(method(iter(()))) == "INVALID_ARGUMENT"
