"""The reference of all modules can be built: names in docstrings lead somewhere, examples are code."""

import importlib.util
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_docstrings_are_ready_for_the_reference():
    """The check with which `make docs` begins; building the pages takes `make test-all`."""
    path = ROOT / ".ci" / "docs" / "reference.py"
    spec = importlib.util.spec_from_file_location("reference", path)
    builder = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(builder)
    names = builder.modules()
    assert {"isocharge.simulate.solver.newton", "isocharge.serve.frames.binary", "isocharge.cli.main"} <= set(names)
    builder.check_docstrings(names)
