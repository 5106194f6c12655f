"""Serving stays light: what it must not pull in, and what the command line must not pull in before it runs."""

import subprocess
import sys

import pytest


def imported(statement):
    """Top-level modules after a statement in a fresh interpreter."""
    code = f"import sys; {statement}; print(*{{name.partition('.')[0] for name in sys.modules}})"
    return set(subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split())


def test_serve_needs_no_heavy_package():
    heavy = {"torch", "onnx", "scipy", "sklearn", "matplotlib", "typer", "rich"}
    assert not imported("import isocharge.serve") & heavy


@pytest.mark.parametrize("package", ["simulate", "train", "cli"])
def test_serve_imports_no_other_stage(package):
    code = f"import sys, isocharge.serve; assert 'isocharge.{package}' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_commands_import_nothing_before_they_run():
    assert not imported("import isocharge.cli.serve.predict") & {"numpy", "onnxruntime", "serial", "scipy"}
