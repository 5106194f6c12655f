"""The ASGI application in a program of Starlette, as a user mounts it."""

import asyncio
import json
from functools import partial
from unittest.mock import AsyncMock

import numpy as np
import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Mount, Route

from infer_requests import BODY, INFER
from isocharge.serve import asgi_app
from isocharge.serve.network.address import ServerLimits
from isocharge.serve.network.metrics import Traffic
from one_request import send


@pytest.fixture
def ask(models, start_http):
    """Return a function that sends a request to a program that mounts the models under `/touch`."""
    program = Starlette(
        routes=[
            Route("/", lambda _: PlainTextResponse("the program")),
            Mount("/touch", asgi_app(str(models), token="sesame")),
        ]
    )
    program.limits = ServerLimits()
    program.traffic = Traffic()
    return partial(send, start_http(program).url)


def test_asgi_app_mounted_in_starlette_answers_under_its_path_and_checks_token_size_and_origin(ask, predictor):
    status, _, content = ask("GET", "/")
    assert (status, content) == (200, b"the program")
    bearer = {"Authorization": "Bearer sesame"}
    status, _, content = ask("POST", "/touch" + INFER, BODY, **bearer)
    assert status == 200
    contact = np.float32(json.loads(content)["outputs"][0]["data"])
    np.testing.assert_array_equal(contact, np.float32(predictor.predict([100.0, 200.0, 300.0])[:3]))
    assert ask("GET", "/touch/v2/health/ready")[0] == 200
    assert ask("GET", "/touch/nope", **bearer)[0] == 404
    status, headers, _ = ask("GET", "/touch/v2")
    assert (status, headers["www-authenticate"]) == (401, "Bearer")
    assert ask("GET", "/touch/v2", Origin="http://evil.example", **bearer)[0] == 403
    assert ask("POST", "/touch" + INFER, bytes((1 << 20) + 1), **bearer)[0] == 413


@pytest.mark.parametrize(
    ("scope", "received", "sent"),
    [
        (
            {"type": "http", "method": "GET", "path": "/v2/health/live", "headers": []},  # without the optional client
            ["http.request"],
            ["http.response.start", "http.response.body"],
        ),
        ({"type": "websocket"}, ["websocket.connect"], ["websocket.close"]),
        (
            {"type": "lifespan"},
            ["lifespan.startup", "lifespan.shutdown"],
            ["lifespan.startup.complete", "lifespan.shutdown.complete"],
        ),
    ],
)
def test_asgi_app_answers_each_kind_of_scope(models, scope, received, sent):
    receive = AsyncMock(side_effect=[{"type": name} for name in received])
    send_event = AsyncMock()
    asyncio.run(asgi_app(str(models))(scope, receive, send_event))
    assert [call.args[0]["type"] for call in send_event.call_args_list] == sent
