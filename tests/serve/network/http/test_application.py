"""The ASGI application in a program of Starlette, as a user mounts it."""

import http.client
import json
from threading import Thread

import numpy as np
import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Mount, Route

from infer_requests import BODY, INFER
from isocharge.serve import asgi_app
from isocharge.serve.network.address import Address
from isocharge.serve.network.http import HttpServer


@pytest.fixture
def ask(models):
    """Return a function that sends a request to a program that mounts the models under `/touch`."""
    program = Starlette(
        routes=[
            Route("/", lambda _: PlainTextResponse("the program")),
            Mount("/touch", asgi_app(models, token="sesame")),
        ]
    )
    server = HttpServer(program, Address())
    thread = Thread(target=server.run)
    thread.start()

    def ask(method, path, body=None, **headers):
        client = http.client.HTTPConnection(server.url.removeprefix("http://"), timeout=20)
        client.request(method, path, body, headers)
        answer = client.getresponse()
        content = answer.read()
        client.close()
        return answer.status, content

    yield ask
    server.stop()
    thread.join(20)
    server.close()


def test_asgi_app_mounted_in_starlette_answers_under_its_path(ask, predictor):
    assert ask("GET", "/") == (200, b"the program")
    bearer = {"Authorization": "Bearer sesame"}
    status, content = ask("POST", "/touch" + INFER, BODY, **bearer)
    assert status == 200
    contact = np.float32(json.loads(content)["outputs"][0]["data"])
    np.testing.assert_array_equal(contact, np.float32(predictor.predict([100.0, 200.0, 300.0])[:3]))
    assert ask("GET", "/touch/nope", **bearer)[0] == 404
    assert ask("GET", "/touch/v2/health/ready")[0] == 200


def test_mounted_asgi_app_checks_token_size_and_origin(ask):
    bearer = {"Authorization": "Bearer sesame"}
    assert ask("GET", "/touch/v2")[0] == 401
    assert ask("GET", "/touch/v2", Origin="http://evil.example", **bearer)[0] == 403
    assert ask("POST", "/touch" + INFER, bytes((1 << 20) + 1), **bearer)[0] == 413
