"""The files of the page: small, whole, and of one mind with the server about what goes over the wire."""

import json
import re
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from isocharge.common.deflection_field import points_mm, read_deflection_field
from isocharge.serve.viewer.messages import samples_message
from isocharge.serve.viewer.samples import SampleFormat

VIEWER = Path(str(files("isocharge.serve.viewer")))
FILES = [path for folder in ("page", "fields") for path in (VIEWER / folder).rglob("*") if path.is_file()]
OWN = [path for path in FILES if "vendor" not in path.parts and path.suffix in (".js", ".html", ".css")]


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.name)
def test_nothing_is_fetched_from_elsewhere(path):
    text = path.read_text("utf-8").replace("http://www.w3.org", "")
    assert not re.search(r"https?://|//[a-z]+\.[a-z]|@import|url\([\"']", text)


def node(script):
    if shutil.which("node") is None:
        pytest.skip("needs Node.js, which reads the page's modules as a browser does")
    done = subprocess.run(["node", "--input-type=module", "-e", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_page_reads_what_the_server_writes(record):
    form = SampleFormat(("A", "B", "C"))
    changes = {
        "charge_pC": {"A": 1.5, "B": None, "C": -3.0},
        "y_mm": 2.5,
        "flags": ("gap", "misfit"),
        "latency_us": 9.0,
    }
    data = form.pack(record(**changes)) + form.pack(record(contact=False, x_mm=None, flags=()))
    message = samples_message(77, 123.5, np.frombuffer(data, form.dtype), 4, begin_anew=True)
    got = node(
        f"""import {{ decode }} from "{(VIEWER / "page/decode.js").as_uri()}";
        const bytes = Uint8Array.from([{",".join(map(str, message))}]);
        console.log(JSON.stringify([decode(bytes.buffer, 3), decode(bytes.buffer.slice(0, 90), 3),
          decode(new ArrayBuffer(3), 3), decode(bytes.buffer, 6)]));"""
    )
    whole, *broken = got
    assert broken == [None, None, None]
    assert (whole["number"], whole["sent_s"], whole["missed"], whole["beginsAnew"]) == (77, 123.5, 4, True)
    first, second = whole["samples"]
    assert first["charges"] == [1.5, None, -3.0]
    assert (first["contact"], first["y"], first["t"], first["latency"]) == (True, 2.5, 1763600000.1234567, 9.0)
    assert (second["contact"], second["x"], second["bits"]) == (False, None, 0)
    assert bin(first["bits"]).count("1") == 2


def test_the_page_interpolates_the_deflection():
    """At the nodes of the table the page gives its numbers, turned and mirrored with the press."""
    path = next((VIEWER / "fields").glob("*.json"))
    field = read_deflection_field(path)
    column, ring, angle, turn = 2, 9, 5, 0.7
    distance = field.distance_mm[column]
    at = points_mm(field.film["radius_mm"], field.probe_radius_mm, distance, np.array(field.rings), 13)[ring, angle]
    for mirrored in (at, at.conjugate()):
        place = mirrored * np.exp(1j * turn)
        press = distance * np.exp(1j * turn)
        got = node(
            f"""import {{ readFileSync }} from "node:fs";
            import {{ Deflection }} from "{(VIEWER / "page/deflection.js").as_uri()}";
            const field = new Deflection(JSON.parse(readFileSync("{path}", "utf8")));
            field.press({press.real}, {press.imag}, {field.force_N[1]});
            const node = field.node({ring}, {angle if mirrored is at else 24 - angle});
            const at = field.at({place.real}, {place.imag}), flat = (field.press(0, 0, 0), field.at(1, 1));
            console.log(JSON.stringify([...node, at, flat]));"""
        )
        w = field.deflection_mm[1, column, ring, angle]
        assert got == pytest.approx([place.real, place.imag, w, w, 0.0], abs=2e-3)
