"""Start Triton from the wheel `nvidia-pytriton` for a folder of models, with the backend `onnxruntime` of this folder.

    python serve/deploy/triton/start.py models --port 8000

The script needs an environment of its own, in which `pip install nvidia-pytriton onnxruntime` has been run. The process
of the script becomes the server.
"""

import argparse
import importlib.util
import os
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent


def create_backends_folder(pytriton: Path) -> Path:
    """Create a folder with the two backends that Triton needs, and return the path of this folder.

    An older folder is replaced. The folder contains the Python backend of the wheel, and the backend `onnxruntime` that
    is beside this script. The Python backend includes a stub program, which runs the backend in the Python version of
    this environment.

    Args:
        pytriton: Folder of the installed package `pytriton`.
    """
    python_version = f"{sys.version_info.major}.{sys.version_info.minor}"
    stub = pytriton / "tritonserver/python_backend_stubs" / python_version / "triton_python_backend_stub"
    if not stub.is_file():
        sys.exit(f"{stub}: missing; this version of pytriton does not support Python {python_version}, use another one")
    folder = Path(sys.prefix) / "triton-backends"
    shutil.rmtree(folder, ignore_errors=True)
    # The files are copied, because Triton does not follow symbolic links.
    shutil.copytree(pytriton / "tritonserver/backends/python", folder / "python")
    shutil.copy2(stub, folder / "python")
    shutil.copytree(HERE / "onnxruntime", folder / "onnxruntime")
    return folder


def server_command(pytriton: Path, options: argparse.Namespace) -> list[str]:
    """Create the folder of backends, and return the command that starts Triton with these backends.

    Args:
        pytriton: Folder of the installed package `pytriton`.
        options: Options of the command line: `models`, `host`, `port` and `grpc_port`. `grpc_port` is None for no gRPC.
    """
    backends_folder = create_backends_folder(pytriton)
    command = [
        str(pytriton / "tritonserver/bin/tritonserver"),
        f"--model-repository={options.models.resolve()}",
        f"--backend-directory={backends_folder}",
        f"--http-address={options.host}",
        f"--http-port={options.port}",
        "--allow-metrics=false",
    ]
    if options.grpc_port is None:
        command.append("--allow-grpc=false")
    else:
        command += [f"--grpc-address={options.host}", f"--grpc-port={options.grpc_port}"]
    return command


def server_environment(pytriton: Path) -> dict[str, str]:
    """Return the environment variables of this process, with the folders of Triton at the front of the search paths.

    Args:
        pytriton: Folder of the installed package `pytriton`.
    """
    first_folders = {
        "LD_LIBRARY_PATH": pytriton.parent / "nvidia_pytriton.libs",
        "PATH": Path(sys.executable).parent,  # the stub of the Python backend starts the Python that it finds here
        "PYTHONPATH": pytriton.parent,
    }
    environment = dict(os.environ)
    for name, first_folder in first_folders.items():
        present_folders = os.environ.get(name)  # separated by colons
        environment[name] = f"{first_folder}:{present_folders}" if present_folders else str(first_folder)
    return environment


def main() -> None:
    """Parse the command line, and replace this process by the Triton server."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, help="folder of models: NAME/config.pbtxt, NAME/VERSION/model.onnx")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8000, help="port of HTTP")
    parser.add_argument("--grpc-port", type=int, help="port of gRPC (default: no gRPC)")
    options = parser.parse_args()

    package = importlib.util.find_spec("pytriton")
    if package is None or package.origin is None:
        sys.exit("this needs pytriton: pip install nvidia-pytriton onnxruntime, in an environment of its own")
    pytriton = Path(package.origin).parent  # the origin is the file __init__.py in the folder of the package
    command = server_command(pytriton, options)
    os.execve(command[0], command, server_environment(pytriton))


if __name__ == "__main__":
    main()
