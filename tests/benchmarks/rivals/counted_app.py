"""Our server with a switch: POST /counting/on and /counting/off, for what the counters of `/metrics` cost a request.

    python counted_app.py PORT MODEL.onnx

Off leaves what the statistics of Triton's protocol need: presses, requests, times of the stages.
"""

import sys
import time
from pathlib import Path

from isocharge.serve.network.address import Address
from isocharge.serve.network.http import App, HttpServer
from isocharge.serve.network.http.app import OPEN
from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol import Handler, infer
from isocharge.serve.network.protocol.response import json_response
from isocharge.serve.network.statistics import Statistics


def answer_uncounted(self, method, path, headers, body, _client=None):
    assert self._token is None or path in OPEN  # this server has no token; the look costs what it costs ours
    return self.handler.answer(method, path, headers, body)


def succeeded_without(self, presses, stages_ns, *_, **__):
    spent = self.stages_ns
    with self._lock:
        self.presses += presses
        self.answered += 1
        spent[0] += stages_ns[0]
        spent[1] += stages_ns[1]
        spent[2] += stages_ns[2]
        self.last_ms = time.time_ns() // 1_000_000


def infer_unchecked(loaded, request):
    """One press, without a look at its misfit."""
    row = infer._one_press(loaded.press(), request.charge_pC[0])
    outputs = {name: row[:, infer.COLUMNS[name]] for name in request.outputs}
    return infer.InferAnswer(loaded.metadata.name, loaded.version, request.id, outputs, request.binary, 0, 0)


ON = App.answer, Statistics.succeeded, infer.infer
OFF = answer_uncounted, succeeded_without, infer_unchecked


def switch(to):
    App.answer, Statistics.succeeded, infer.infer = to
    return json_response({})


if __name__ == "__main__":
    handler = Handler(open_model_store(Path(sys.argv[2]).parents[2]))
    handler._fixed |= {
        "/counting/on": ("POST", lambda _: switch(ON)),
        "/counting/off": ("POST", lambda _: switch(OFF)),
    }
    HttpServer(App(handler), Address(port=int(sys.argv[1])), limits=handler.limits).run()
