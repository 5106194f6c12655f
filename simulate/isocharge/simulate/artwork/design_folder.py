"""Writer of the folder of a design: the sensor file, the drawings, the numerical results and a picture."""

import json
from pathlib import Path

from isocharge.common.files import new_folder, write_whole
from isocharge.simulate.artwork.drawing import draw_layout, to_dxf, to_svg
from isocharge.simulate.artwork.leads import straight_leads
from isocharge.simulate.layout.design import Design
from isocharge.simulate.plots.error_maps import error_maps_picture
from isocharge.simulate.plots.figure import picture_bytes
from isocharge.simulate.sensor.sensor_file import sensor_to_toml


def write_design(design: Design, folder: Path) -> None:
    """Write the files `sensor.toml`, `layout.svg`, `layout.dxf`, `design.json` and `design.png` into a new folder.

    The files of two equal designs are equal byte by byte.

    Args:
        design: Design to write.
        folder: Folder to create.

    Raises:
        OutputExists: If the folder already exists.
        OutputError: If the files cannot be written.
    """
    case = design.case
    errors = design.after.to_dict()["with_nuisances"]
    leads = straight_leads(design.sensor)
    comment = [
        f"Positions searched for {case.electrodes} electrodes over {case.radius:g} mm, goal {case.goal_name}:",
        f"lower limit of the position error {errors['worst_mm']:.3f} mm at worst, {errors['rms_mm']:.3f} mm rms.",
    ]
    drawing = draw_layout(design.sensor, leads)
    results = {**design.to_dict(), "leads": leads.summary}
    files = {
        "sensor.toml": sensor_to_toml(design.sensor, comment).encode(),
        "layout.svg": to_svg(drawing).encode(),
        "layout.dxf": to_dxf(drawing).encode(),
        "design.json": (json.dumps(results, indent=1, allow_nan=False) + "\n").encode(),
        "design.png": picture_bytes(error_maps_picture(design)),
    }
    with new_folder(folder) as draft:
        for name, data in files.items():
            write_whole(draft / name, data)
