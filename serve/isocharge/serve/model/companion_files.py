"""Companion files, such as `charges.npz`, which belong to one `model.onnx` and are in the same folder.

`golden.json` contains the checksum of each companion file. A companion file of another model has the right format, but
would give wrong contacts. A file whose checksum differs or is missing is therefore refused. Models that were written
before companion files had checksums are still read, with a warning in the log.
"""

import logging
from pathlib import Path

from isocharge.common.errors import ModelError
from isocharge.common.files import read_needed, sha256_of
from isocharge.serve.model.golden import read_golden

log = logging.getLogger(__name__)


def read_companion_file(version_folder: Path, name: str, advice: str) -> bytes:
    """Read a companion file from the folder of a `model.onnx`, and compare it with its checksum in `golden.json`.

    A folder of an earlier version has no checksums of companion files. The file is then read without a comparison.

    Args:
        version_folder: The folder that holds `model.onnx`.
        name: Name of the companion file.
        advice: What the user can do if the file cannot be read, for the error message.

    Returns:
        The bytes of the file.

    Raises:
        ModelError: If the file cannot be read, or its checksum is not the one in `golden.json`.
    """
    path = version_folder / name
    data = read_needed(path, ModelError, advice)
    golden_path = version_folder / "golden.json"
    checksums = None
    if golden_path.exists():
        checksums = read_golden(golden_path).companion_sha256
    if checksums is None:
        log.warning("%s: golden.json holds no checksum of this file; whether it fits model.onnx is not verified", path)
        return data
    expected_sha256 = checksums.get(name, "no such file")  # the text is no checksum, so that the comparison fails
    actual_sha256 = sha256_of(data)
    if actual_sha256 != expected_sha256:
        raise ModelError(
            f"{path}: expected sha256 {expected_sha256:.12} (golden.json), got {actual_sha256:.12}; the file is "
            f"damaged or belongs to another model: copy the whole folder of the model again, or {advice}"
        )
    return data
