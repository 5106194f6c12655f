"""A small package that adds an output is found on the path of Python, as `importlib.metadata` defines it."""

import json

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


def test_installed_package_adds_an_output(recorded, models, tmp_path, command, monkeypatch):
    """The package has the metadata that pip would write."""
    folder = tmp_path / "site" / "isocharge_count-1.0.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: isocharge-count\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[isocharge.outputs]\ncount = isocharge_count:COUNT\n")
    (tmp_path / "site" / "isocharge_count.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path / "site")
    recording, printed = recorded
    target = tmp_path / "touch.count"
    code, out, err = command("serve", "replay", recording, "--models", models, "--output", target)
    assert (code, out) == (0, ""), err
    contacts = sum(json.loads(line)["contact"] for line in printed.splitlines())
    assert int(target.read_text()) == contacts > 0
