"""`isocharge serve http` as a user meets it: addresses on stdout, words on stderr, clear refusals, a clean end."""

import json
import signal
import socket
from unittest.mock import Mock

import pytest
import tritonclient.grpc

from infer_requests import BODY, INFER
from isocharge.cli.serve.http import _load_all
from isocharge.common.errors import ModelError
from isocharge.serve.network.address import Address
from one_request import send


@pytest.fixture
def start(models, start_command):
    def start(*words, folder=models):
        return start_command("serve", "http", "--models", folder, *words)

    return start


def test_sighup_loads_all_models_again(start, film, tmp_path):
    """A version that cannot be loaded is reported, and the other models are still loaded."""
    film.write(tmp_path)
    process = start("--port", 0, folder=tmp_path)
    url = process.stdout.readline().strip()
    film.write(tmp_path, version=2)
    film.write(tmp_path, name="other")
    (film.write(tmp_path, name="broken") / "golden.json").unlink()
    process.send_signal(signal.SIGHUP)
    start_line, refusal, load_line = [process.stderr.readline() for _ in range(3)]
    assert start_line == "serving linear/1; Ctrl-C stops\n"
    assert refusal.startswith(f"refused: {tmp_path}/broken/1/golden.json: cannot be read")
    assert load_line == "serving linear/1, linear/2, other/1; Ctrl-C stops\n"
    assert json.loads(send(url, "POST", INFER, BODY)[2])["model_version"] == "2"


def test_sighup_reports_a_folder_of_models_that_cannot_be_listed(caplog):
    _load_all(Mock(load_all=Mock(side_effect=ModelError("models: cannot be listed"))))
    assert caplog.messages == ["models: cannot be listed"]


def test_server_answers_until_sigint(start):
    """It also ends at SIGTERM, as another test shows."""
    process = start("--port", 0, "--grpc-port", 0)
    url, grpc_url = process.stdout.readline().strip(), process.stdout.readline().strip()
    assert send(url, "POST", INFER, BODY)[0] == 200
    client = tritonclient.grpc.InferenceServerClient(grpc_url.removeprefix("grpc://"))
    assert client.is_model_ready("linear")
    client.close()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (0, "", "serving linear/1; Ctrl-C stops\n")


def test_another_server_can_listen_on_the_port_of_a_killed_server(start):
    """A connection was open when the server was killed."""
    process = start("--port", 0)
    port = int(process.stdout.readline().rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port)) as held:
        held.sendall(b"GET /v2 HTTP/1.1\r\n\r\n")
        assert held.recv(12) == b"HTTP/1.1 200"
        process.kill()
        process.wait()
        Address(port=port).listen().close()


def test_http_command_refuses_wrong_options_and_models(refused, film, models, tmp_path, monkeypatch):
    (tmp_path / "empty").mkdir()
    (film.write(tmp_path / "damaged") / "golden.json").unlink()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for words, code, message in [
            (("--port", port), 1, f"ListenError: cannot listen on 127.0.0.1:{port}: "),
            (("--port", 0, "--grpc-port", port), 1, f"ListenError: cannot listen on 127.0.0.1:{port} for gRPC"),
            (("--host", "0.0.0.0"), 2, "InputError: 0.0.0.0 lets other machines in: give --token TOKEN"),
            (("--tls-key", "x"), 2, "InputError: --tls-key: expected --tls-cert too"),
            (("--tls-cert", __file__), 2, f"InputError: {__file__}: not a certificate"),
            (("--models", tmp_path / "empty"), 2, "ModelError: no model can be served: expected models"),
            (
                ("--models", tmp_path / "damaged"),
                2,
                f"ModelError: no model can be served: {tmp_path}/damaged/linear/1/golden.json: ",
            ),
        ]:
            refused("serve", "http", "--models", models, *words, message=message, code=code)
    monkeypatch.setenv("ISOCHARGE_TOKEN", "")  # whoever sets it means to have one
    refused("serve", "http", "--models", models, "--port", 0, message="token: expected printable ASCII")


def test_full_log_pipe_delays_no_request_and_sigterm_ends_the_server(start, film, tmp_path):
    """The pipe of stderr takes some 64 KiB; then lines wait, and are not waited for. Each line is JSON."""
    film.write(tmp_path)
    (film.write(tmp_path, version=2) / "golden.json").unlink()
    process = start("--port", 0, "--log", "json", folder=tmp_path)
    url = process.stdout.readline().strip()
    assert {send(url, "POST", INFER, BODY)[0] for _ in range(500)} == {200}
    assert b"isocharge_log_lines_lost 0.0" in send(url, "GET", "/metrics")[2]  # 10,000 may wait
    process.terminate()
    refused, serving, *requests = map(json.loads, process.communicate(timeout=20)[1].splitlines())
    assert (refused["level"], refused["message"][:9]) == ("warning", "refused: ")
    assert (serving["level"], serving["message"]) == ("info", "serving linear/1; Ctrl-C stops")
    assert (process.returncode, len(requests)) == (0, 501)


def test_each_log_line_that_cannot_be_written_counts_as_lost(start):
    """A full disk may have space again, so the server tries to write each line."""
    process = start("--port", 0, "--log", "json")
    url = process.stdout.readline().strip()
    process.stderr.close()
    for _ in range(50):
        metrics = send(url, "GET", "/metrics")[2]
    assert float(metrics.split()[-1]) > 2  # the last metric is isocharge_log_lines_lost
