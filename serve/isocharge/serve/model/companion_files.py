"""Companion files of a model, such as `charges.npz`, which belong to one `model.onnx` and are in its folder.

The file `golden.json` contains the checksum of each companion file. A companion file of another model would have the
right format but give wrong contacts. A companion file is therefore refused if its checksum differs from the checksum in
`golden.json`, or if `golden.json` does not list the file. Earlier versions of isocharge wrote no checksums of companion
files. The companion files of models from these versions are read without a comparison, and a warning is logged.
"""

import logging
from pathlib import Path

from isocharge.common.errors import ModelError
from isocharge.common.files import read_needed, sha256_of
from isocharge.serve.model.golden import read_golden

log = logging.getLogger(__name__)


def read_companion_file(version_folder: Path, name: str, advice: str) -> bytes:
    """Read a companion file from the folder of a `model.onnx`, and compare it with its checksum in `golden.json`.

    Models that were written by earlier versions have no checksums of companion files. The companion files of such
    models are read without a comparison, and a warning is logged.

    Args:
        version_folder: Folder of the model, which contains `model.onnx`.
        name: Name of the companion file.
        advice: What the user can do if the file cannot be read, for the error message.

    Returns:
        The bytes of the file.

    Raises:
        ModelError: If the file cannot be read, if its checksum differs from the checksum in `golden.json`, or if
            `golden.json` is damaged or does not list the file.
    """
    path = version_folder / name
    data = read_needed(path, ModelError, advice)
    golden_path = version_folder / "golden.json"
    checksums = None  # stays None if a model of an earlier version has no checksums of companion files
    if golden_path.exists():
        checksums = read_golden(golden_path).companion_sha256
    if checksums is None:
        log.warning("%s: golden.json holds no checksum of this file; whether it fits model.onnx is not verified", path)
        return data
    # If `golden.json` does not list the file, the comparison with this text fails, and the message contains the text.
    expected_sha256 = checksums.get(name, "no such file")
    actual_sha256 = sha256_of(data)
    if actual_sha256 != expected_sha256:
        raise ModelError(
            f"{path}: expected sha256 {expected_sha256:.12} (golden.json), got {actual_sha256:.12}; the file is "
            f"damaged or belongs to another model: copy the whole folder of the model again, or {advice}"
        )
    return data
