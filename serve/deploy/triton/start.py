"""Starts the Triton of the wheel `nvidia-pytriton` on a folder of models, with the backend `onnxruntime` beside.

    python serve/deploy/triton/start.py models --port 8000

Runs in an environment of its own: pip install nvidia-pytriton onnxruntime. The process becomes the server.
"""

import argparse
import importlib.util
import os
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent


def backends(pytriton: Path) -> Path:
    """A folder of backends in this environment: that of the wheel for Python, with the stub for this one, and ours."""
    folder = Path(sys.prefix) / "triton-backends"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(pytriton / "tritonserver/backends/python", folder / "python")  # Triton follows no link out of it
    stub = pytriton / "tritonserver/python_backend_stubs" / "{}.{}".format(*sys.version_info)
    shutil.copy2(stub / "triton_python_backend_stub", folder / "python")
    shutil.copytree(HERE / "onnxruntime", folder / "onnxruntime")
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, help="folder of models: NAME/config.pbtxt, NAME/VERSION/model.onnx")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8000, help="of HTTP")
    parser.add_argument("--grpc-port", type=int, help="of gRPC (default: no gRPC)")
    asked = parser.parse_args()
    package = importlib.util.find_spec("pytriton")
    if package is None or package.origin is None:
        sys.exit("this needs pytriton: pip install nvidia-pytriton onnxruntime, in an environment of its own")
    pytriton = Path(package.origin).parent
    words = [
        str(pytriton / "tritonserver/bin/tritonserver"),
        f"--model-repository={asked.models.resolve()}",
        f"--backend-directory={backends(pytriton)}",
        f"--http-address={asked.host}",
        f"--http-port={asked.port}",
        "--allow-metrics=false",
        *(["--allow-grpc=false"] if asked.grpc_port is None else []),
        *([] if asked.grpc_port is None else [f"--grpc-address={asked.host}", f"--grpc-port={asked.grpc_port}"]),
    ]
    paths = {
        "LD_LIBRARY_PATH": pytriton.parent / "nvidia_pytriton.libs",
        "PATH": Path(sys.executable).parent,  # the stub takes its Python from here
        "PYTHONPATH": pytriton.parent,
    }
    environment = {
        name: f"{path}:{os.environ[name]}" if os.environ.get(name) else f"{path}" for name, path in paths.items()
    }
    os.execve(words[0], words, os.environ | environment)


if __name__ == "__main__":
    main()
