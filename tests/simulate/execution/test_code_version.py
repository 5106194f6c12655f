"""The fingerprint sees every file that results depend on."""

import shutil

import pytest

from isocharge.simulate.execution import code_version


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A copy of the simulator's sources, which may be changed."""
    copy = tmp_path / "simulate"
    shutil.copytree(code_version.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(code_version, "PACKAGE", copy)
    return copy


def fingerprint() -> str:
    return code_version.code_fingerprint.__wrapped__()


@pytest.mark.usefixtures("package")
def test_fingerprint_of_a_copy_is_the_same():
    assert fingerprint() == code_version.code_fingerprint()


@pytest.mark.parametrize("name", ["solver/newton.py", "sensors/three-25um-biaxial.toml"])
def test_fingerprint_changes_with_any_file(package, name):
    before = fingerprint()
    path = package / name
    path.write_text(path.read_text("utf-8") + "\n# changed\n", "utf-8")
    assert fingerprint() != before
