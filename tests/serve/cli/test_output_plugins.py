"""A small package that adds an output is found on the path of Python, as `importlib.metadata` defines it."""

import json
import re

import pytest

from isocharge.common.errors import InputError
from isocharge.serve.outputs.targets import output_kind

PLUGIN = '''
"""An output that counts the records of each touch."""
from pathlib import Path
from isocharge.serve.outputs.output import OutputKind


class CountOutput:
    def __init__(self, path):
        self.path, self.count = path, 0

    def write(self, record):
        self.count += record.contact

    def close(self):
        self.path.write_text(str(self.count))


COUNT = OutputKind(
    form="FILE.count",
    accepts=lambda target: target.endswith(".count"),
    open=lambda target, context: CountOutput(Path(target)),
)
'''


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Return a function that makes the package importable, with the metadata that pip would write."""

    def install_entry_point(entry_point):
        folder = tmp_path / "site" / "isocharge_count-1.0.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: isocharge-count\nVersion: 1.0\n")
        (folder / "entry_points.txt").write_text(f"[isocharge.outputs]\ncount = {entry_point}\n")
        (tmp_path / "site" / "isocharge_count.py").write_text(PLUGIN)
        monkeypatch.syspath_prepend(tmp_path / "site")

    return install_entry_point


def test_installed_package_adds_an_output(install, recorded, models, tmp_path, command):
    recording, printed = recorded
    install("isocharge_count:COUNT")
    target = tmp_path / "touch.count"
    code, out, err = command("serve", "replay", recording, "--models", models, "--output", target)
    assert (code, out) == (0, ""), err
    contacts = sum(json.loads(line)["contact"] for line in printed.splitlines())
    assert int(target.read_text()) == contacts > 0


@pytest.mark.parametrize(
    ("entry_point", "reason"),
    [("isocharge_count:ABSENT", "no attribute 'ABSENT'"), ("isocharge_count:CountOutput", "no attribute 'accepts'")],
)
def test_broken_package_is_named(install, entry_point, reason):
    install(entry_point)
    with pytest.raises(InputError, match=rf"output count \({re.escape(entry_point)}\): .* 'touch\.count' .*{reason}"):
        output_kind("touch.count")
