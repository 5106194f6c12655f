"""Starts MLServer on a folder of models as it stands: its settings are written elsewhere.

    python serve/deploy/mlserver/start.py models --port 8080

Runs in an environment of its own: pip install mlserver onnxruntime. Ends with the server, and ends it.
"""

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent

RUNTIME = "isocharge_runtime.OnnxRuntime"


def server_settings(host: str, port: int) -> dict[str, object]:
    """Settings of the server: no worker processes, no metrics, no access log. A network of this size needs none."""
    with socket.socket() as probe:  # gRPC cannot be switched off
        probe.bind((host, 0))
        grpc_port = probe.getsockname()[1]
    return {
        "host": host,
        "http_port": port,
        "grpc_port": grpc_port,
        "metrics_endpoint": None,
        "parallel_workers": 0,
        "debug": False,
        "use_structured_logging": False,
        "logging_settings": None,
    }


def model_settings(version: Path) -> dict[str, object]:
    """Settings of one version of a model."""
    parameters = {"uri": str(version.resolve() / "model.onnx"), "version": version.name}
    return {"name": version.parent.name, "implementation": RUNTIME, "parameters": parameters}


def write_settings(folder: Path, models: Path, host: str, port: int) -> Path:
    """A folder with settings for every model, the highest version of each."""
    (folder / "settings.json").write_text(json.dumps(server_settings(host, port)))
    for model in sorted(path for path in models.iterdir() if path.is_dir()):
        numbers = [int(path.name) for path in model.iterdir() if path.name.isdigit()]
        (folder / model.name).mkdir()
        settings = model_settings(model / str(max(numbers)))
        (folder / model.name / "model-settings.json").write_text(json.dumps(settings))
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, help="folder of models: NAME/VERSION/model.onnx")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8080, help="of HTTP")
    asked = parser.parse_args()
    program = Path(sys.executable).with_name("mlserver")
    with tempfile.TemporaryDirectory(prefix="mlserver-") as name:
        folder = write_settings(Path(name), asked.models, asked.host, asked.port)
        environment = os.environ | {"PYTHONPATH": str(HERE.resolve())}
        server = subprocess.Popen([program, "start", folder], cwd=folder, env=environment)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda number, _: server.send_signal(number))
        code = server.wait()
    sys.exit(code)


if __name__ == "__main__":
    main()
