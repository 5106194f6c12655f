"""Code fingerprint: it depends on every source file and on the versions of the numerical libraries."""

import shutil
from importlib import metadata

import pytest

from isocharge.simulate.execution import code_version


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A copy of the sources of the simulator, which a test may change."""
    copy = tmp_path / "simulate"
    shutil.copytree(code_version.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(code_version, "PACKAGE", copy)
    return copy


def fingerprint() -> str:
    return code_version.code_fingerprint.__wrapped__()


@pytest.mark.parametrize("library", ["numpy", "scipy", "shapely"])
def test_fingerprint_contains_the_version_of_the_library(library):
    assert f", {library} {metadata.version(library)}" in fingerprint()


@pytest.mark.usefixtures("package")
def test_fingerprint_of_a_copy_is_the_same():
    assert fingerprint() == code_version.code_fingerprint()


@pytest.mark.parametrize("name", ["solver/newton.py", "sensors/three-25um-biaxial.toml"])
def test_fingerprint_changes_with_any_source_file(package, name):
    before = fingerprint()
    path = package / name
    path.write_text(path.read_text("utf-8") + "\n# changed\n", "utf-8")
    assert fingerprint() != before
