"""Functions that write a design as a folder with the sensor file, the drawings, the results and pictures."""

import json
from pathlib import Path
from typing import Any

from isocharge.common.files import new_folder, write_whole
from isocharge.simulate.artwork.drawing import draw_layout, to_dxf, to_svg
from isocharge.simulate.artwork.leads import straight_leads
from isocharge.simulate.layout.design import Design
from isocharge.simulate.layout.guard import GuardDesign
from isocharge.simulate.plots.error_maps import error_maps_picture
from isocharge.simulate.plots.figure import picture_bytes
from isocharge.simulate.plots.mirror_map import mirror_picture
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.sensor.sensor_file import sensor_to_toml


def write_design(design: Design, folder: Path) -> None:
    """Write a designed layout into a new folder.

    The files are `sensor.toml`, `layout.svg`, `layout.dxf`, `design.json`, and the picture `design.png` of the position
    errors. Equal designs result in identical files.

    Args:
        design: Result of the design.
        folder: Folder that is created.

    Raises:
        OutputExists: If the folder already exists.
        OutputError: If the files cannot be written.
    """
    case = design.case
    errors = design.errors_after.to_dict()["with_nuisances"]  # includes the errors by uncertain nuisance parameters
    sensor_comment = [
        f"Positions searched for {case.electrodes} electrodes over {case.radius:g} mm, goal {case.goal}:",
        f"lower limit of the position error {errors['worst_mm']:.3f} mm at worst, {errors['rms_mm']:.3f} mm rms.",
    ]
    pictures = {"design.png": picture_bytes(error_maps_picture(design))}
    _write_folder(folder, design.sensor, sensor_comment, design.to_dict(), pictures)


def write_guard_design(design: GuardDesign, folder: Path) -> None:
    """Write a sensor with a guard electrode into a new folder.

    The files are `sensor.toml`, `layout.svg`, `layout.dxf`, `design.json`, and the pictures `mirror_before.png` and
    `mirror.png` of the mirror region without and with the guard electrode.

    Args:
        design: Result of the search for a guard electrode.
        folder: Folder that is created.

    Raises:
        OutputExists: If the folder already exists.
        OutputError: If the files cannot be written.
    """
    sensor_comment = [
        f"Guard electrode {design.guard.name} searched for presses outside {design.case.radius:g} mm:",
        f"{100.0 * design.region_before.total_share:.1f} % of them cannot be noticed without it, "
        f"{100.0 * design.region_after.total_share:.1f} % with it.",
    ]
    pictures = {
        "mirror_before.png": picture_bytes(mirror_picture(design.case.sensor, design.region_before)),
        "mirror.png": picture_bytes(mirror_picture(design.sensor, design.region_after)),
    }
    _write_folder(folder, design.sensor, sensor_comment, design.to_dict(), pictures)


def _write_folder(
    folder: Path, sensor: Sensor, sensor_comment: list[str], results: dict[str, Any], pictures: dict[str, bytes]
) -> None:
    """Write the files of a designed sensor into a new folder.

    The drawings also show the leads, which are the conductors from the electrodes to the rim of the film.

    Args:
        folder: Folder that is created.
        sensor: The designed sensor.
        sensor_comment: Comment lines at the beginning of the sensor file.
        results: Content of `design.json`. This function adds a sentence about the leads.
        pictures: Contents of PNG files by file name.
    """
    leads = straight_leads(sensor)
    drawing = draw_layout(sensor, leads)
    all_results = {**results, "leads": leads.summary}
    files = {
        "sensor.toml": sensor_to_toml(sensor, sensor_comment).encode(),
        "layout.svg": to_svg(drawing).encode(),
        "layout.dxf": to_dxf(drawing).encode(),
        "design.json": (json.dumps(all_results, indent=1, allow_nan=False) + "\n").encode(),
        **pictures,
    }
    # The files are written into a temporary folder, which is renamed to `folder` when all files are complete.
    with new_folder(folder) as temporary_folder:
        for name, content in files.items():
            write_whole(temporary_folder / name, content)
