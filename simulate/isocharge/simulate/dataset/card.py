"""The columns and the data card of a dataset."""

from collections.abc import Iterator
from typing import Any

COLUMNS = {
    "x_mm": "position of the press along the drawn direction, mm",
    "y_mm": "position of the press across it, mm",
    "force_N": "force of the press, N, positive pushes",
    "probe": "the object that presses, notation without the angle",
    "orientation_deg": "angle by which the probe is turned against its notation, deg, anticlockwise",
    "charge_pC": "touch charge of each electrode, pC, electrodes in the manifest's order",
}


def data_card(name: str, manifest: dict[str, Any]) -> str:
    """The data card."""
    ranges, solver = manifest.get("ranges", {}), manifest.get("solver", {})
    lines = [
        f"# {name}",
        "",
        f"{manifest['samples']} presses on the sensor `{manifest['sensor']['name']}` and the touch charge of each "
        f"electrode ({', '.join(manifest['electrodes'])}).",
        "",
        f"Made by isocharge {manifest['package_version']}. Touch charge is the reading under load minus the reading "
        "without load.",
        "",
        "| column | meaning |",
        "|---|---|",
        *(f"| `{column}` | {meaning} |" for column, meaning in COLUMNS.items()),
        "",
        "| what | value |",
        "|---|---|",
        f"| probes | {', '.join(manifest.get('probes', []))} |",
        *(f"| {key} | {value} |" for key, value in ranges.items()),
        *(f"| {key} | {manifest[key]} |" for key in ("sampling", "noise", "seed") if key in manifest),
        *(f"| solver: {key} | {value} |" for key, value in _flat(solver)),
        "",
        "Read it with `isocharge.simulate.read_dataset(folder)`, which checks every shard's checksum.",
        "",
    ]
    return "\n".join(lines)


def _flat(table: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from ((f"{key} {inner}", deep) for inner, deep in _flat(value))
        else:
            yield key, value
