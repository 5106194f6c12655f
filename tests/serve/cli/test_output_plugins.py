"""A small package that adds an output is installed and used by the command line."""

import base64
import hashlib
import json
import subprocess
import sys
import textwrap
import zipfile

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


def build_wheel(folder, entry_point):
    """Write a wheel of the small package above."""
    about = "isocharge_count-1.0.dist-info"
    files = {
        "isocharge_count.py": PLUGIN,
        f"{about}/METADATA": "Metadata-Version: 2.1\nName: isocharge-count\nVersion: 1.0\n",
        f"{about}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{about}/entry_points.txt": f"[isocharge.outputs]\ncount = {entry_point}\n",
    }
    rows = []
    for name, content in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(content.encode()).digest()).rstrip(b"=").decode()
        rows.append(f"{name},sha256={digest},{len(content.encode())}")
    files[f"{about}/RECORD"] = "\n".join([*rows, f"{about}/RECORD,,"]) + "\n"
    wheel = folder / "isocharge_count-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return wheel


@pytest.fixture
def installed(tmp_path):
    """Install the package into a folder, and return the folder."""

    def install(entry_point):
        target = tmp_path / "site"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target"]
        subprocess.run([*command, target, build_wheel(tmp_path, entry_point)], check=True, timeout=120)
        return target

    return install


def test_installed_package_adds_an_output(installed, recorded, models, tmp_path, monkeypatch):
    recording, printed = recorded
    monkeypatch.syspath_prepend(installed("isocharge_count:COUNT"))
    code = textwrap.dedent(f"""
        import sys
        sys.path.insert(0, {str(tmp_path / "site")!r})
        from isocharge.cli.main import main
        sys.argv = ["isocharge", "serve", "replay", {str(recording)!r}, "--models", {str(models)!r},
                    "--output", {str(tmp_path / "touch.count")!r}]
        main()
    """)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    contacts = sum(json.loads(line)["contact"] for line in printed.splitlines())
    assert int((tmp_path / "touch.count").read_text()) == contacts > 0


@pytest.mark.parametrize(
    ("entry_point", "reason"),
    [("isocharge_count:ABSENT", "cannot be loaded"), ("isocharge_count:CountOutput", "expected an OutputKind")],
)
def test_broken_package_is_named(installed, monkeypatch, entry_point, reason):
    monkeypatch.syspath_prepend(installed(entry_point))
    with pytest.raises(InputError, match=rf"output count \({entry_point}\): {reason}"):
        output_kind("touch.count")
