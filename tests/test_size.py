"""The size of the source stays below the limits in pyproject.toml."""

import importlib.util
import tomllib

import pytest

from kept import ROOT


@pytest.fixture(scope="module")
def size_script():
    """The script that `make size` runs."""
    spec = importlib.util.spec_from_file_location("size", ROOT / ".ci" / "size.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_source_is_not_larger_than_the_limits_in_pyproject(size_script):
    """Raise a limit in a commit whose message states what the user gets for the additional code."""
    limits = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["isocharge"]["size"]
    total = size_script.total_size(size_script.measure_packages())
    exceeded = {name: (total[name], limit) for name, limit in limits.items() if total[name] > limit}
    assert not exceeded, "larger than the limit (size, limit); 'make size' prints the size of each package"
    assert set(limits) == {"modules", "nodes", "constants"}


def test_docstrings_comments_and_line_breaks_do_not_change_the_size(size_script, tmp_path):
    plain = tmp_path / "plain.py"
    plain.write_text("LIMIT = 2 * 3.0\nNAME = 'x'\ndef double(x): return 2 * x\n")
    documented = tmp_path / "documented.py"
    documented.write_text(
        '"""A module."""\nLIMIT = 2 * 3.0\n"""A limit."""\n\nNAME = "x"  # a name\n\n\n'
        'def double(x):\n    """Double."""\n    return 2 * x\n'
    )
    assert size_script.measure_module(plain) == size_script.measure_module(documented)
    assert size_script.measure_module(plain)["constants"] == 1
