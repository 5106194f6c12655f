"""The size of the source stays below the limits in pyproject.toml."""

import runpy
import tomllib

from kept import ROOT


def test_source_is_not_larger_than_the_limits_in_pyproject():
    """Raise a limit in a commit whose message states what the user gets for the additional code."""
    limits = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["isocharge"]["size"]
    script = runpy.run_path(str(ROOT / ".ci" / "size.py"))
    total = script["total_size"](script["measure_packages"]())
    exceeded = {name: (total[name], limit) for name, limit in limits.items() if total[name] > limit}
    assert not exceeded, "larger than the limit (size, limit); 'make size' prints the size of each package"
    assert set(limits) == {"modules", "nodes", "constants"}
