"""Files of a version of a model that are changed together with `golden.json`, which contains their checksums."""

import json
from contextlib import contextmanager

from isocharge.common.files import sha256_of
from isocharge.serve.model.charge_file import FILE


@contextmanager
def golden_json(folder):
    """Change the content of `golden.json` of a version folder in a block."""
    path = folder / "golden.json"
    content = json.loads(path.read_text("utf-8"))
    yield content
    path.write_text(json.dumps(content), "utf-8")


def golden_fault(change):
    """Return a function that changes the content of `golden.json` of a version folder."""

    def spoil(folder):
        with golden_json(folder) as content:
            change(content)

    return spoil


def put_graph(folder, data):
    """Replace the graph of a version, and its checksum."""
    (folder / "model.onnx").write_bytes(data)
    with golden_json(folder) as content:
        content["sha256"] = sha256_of(data)


def put_charge_map(folder, data):
    """Write the charge map of a version, and its checksum, as `write_model` does."""
    (folder / FILE).write_bytes(data)
    with golden_json(folder) as content:
        content["files"] = {FILE: sha256_of(data)}
