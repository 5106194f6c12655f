"""Writer of a design as a folder with the sensor file, the drawings, the results and a picture."""

import json
from pathlib import Path

from isocharge.common.files import new_folder, write_whole
from isocharge.simulate.artwork.drawing import draw_layout, to_dxf, to_svg
from isocharge.simulate.layout.design import Design
from isocharge.simulate.plots.error_maps import error_maps_picture
from isocharge.simulate.plots.figure import picture_bytes
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
    drawing = draw_layout(design.sensor)
    files = {
        "sensor.toml": sensor_to_toml(design.sensor, sensor_comment).encode(),
        "layout.svg": to_svg(drawing).encode(),
        "layout.dxf": to_dxf(drawing).encode(),
        "design.json": (json.dumps(design.to_dict(), indent=1, allow_nan=False) + "\n").encode(),
        "design.png": picture_bytes(error_maps_picture(design)),
    }
    # The files are written into a temporary folder, which is renamed to `folder` when all files are complete.
    with new_folder(folder) as temporary_folder:
        for name, content in files.items():
            write_whole(temporary_folder / name, content)
