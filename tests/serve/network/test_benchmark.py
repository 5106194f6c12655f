"""The HTTP benchmark's rivals: started from a relative folder, left out with a reason where they cannot be had."""

import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def bench_http(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return __import__("bench_http")


def test_the_interpreter_of_a_rival_is_found_from_any_folder(bench_http, tmp_path, monkeypatch):
    """MLServer runs in a folder of its own, where a relative path leads nowhere."""
    monkeypatch.chdir(tmp_path)
    environment = tmp_path / "build" / "mlserver"
    environment.mkdir(parents=True)
    (environment / "done").touch()
    assert bench_http.python_of("mlserver", Path("build")) == environment / "bin" / "python"


def test_a_rival_that_cannot_be_installed_is_left_out(bench_http, tmp_path, monkeypatch, capsys):
    failing = tmp_path / "python"
    failing.write_text("#!/bin/sh\necho no such package >&2\nexit 1\n")
    failing.chmod(0o755)
    monkeypatch.setattr(bench_http.venv, "create", lambda folder, **_: _environment(folder, failing))
    monkeypatch.setattr(bench_http, "running", lambda *_, **__: ExitStack())
    with ExitStack() as stack:
        contenders = bench_http.start(stack, "three-25um-biaxial", tmp_path / "environments")
    assert set(contenders) == {"isocharge", "isocharge, Unix socket", "bare route"}
    err = capsys.readouterr().err
    assert "left out: FastAPI: pip cannot install fastapi" in err
    assert "left out: MLServer tuned: pip cannot install mlserver onnxruntime: no such package" in err


def test_a_server_that_ends_is_said_with_its_words(bench_http):
    command = [sys.executable, "-c", "raise SystemExit('no model here')"]
    with pytest.raises(bench_http.NotStarted, match="no model here"), bench_http.running(command, ("127.0.0.1", 1)):
        pass


def _environment(folder, python):
    (folder / "bin").mkdir(parents=True)
    (folder / "bin" / "python").symlink_to(python)
