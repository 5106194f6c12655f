"""Playground, an HTML page on which a visitor can press a simulated film.

The page shows the contact that a network estimates from the charges of the press. The page is a single file, which
loads no other files. The file contains the scripts, the networks as compressed ONNX files, and the stress of the film
as a series. The charges are computed from the series of the stress (see `isocharge.serve.viewer.stress_series`). The
playground can therefore show every model of a biaxial film whose stress the series describes.
"""

import base64
import gzip
import json
import re
from importlib.resources import as_file, files
from typing import Any

from msgspec import to_builtins

from isocharge.common.errors import ModelError
from isocharge.serve.flags import BEYOND, MEANINGS, MISFIT, OUTSIDE, STRESS
from isocharge.serve.model.model_folder import load_model
from isocharge.serve.model.model_search import find_model
from isocharge.serve.model.validity import Validity
from isocharge.serve.viewer.messages import describe_film
from isocharge.serve.viewer.stress_series import StressSeries, read_stress_series

MODELS = ("three-25um-biaxial", "four-25um-biaxial", "eight-25um-biaxial")
"""Names of the released models that the page shows, in the order of its buttons."""

SCRIPTS = (
    "page/theme.js",
    "page/plan.js",
    "playground/network.js",
    "playground/charges.js",
    "playground/contours.js",
    "playground/sensor.js",
    "playground/stage.js",
    "playground/main.js",
)
"""Scripts of the page in the order in which they are joined."""

STYLES = ("page/style.css", "playground/playground.css")
"""Style sheets of the page."""

SERIES_FILE = "playground/film-25um.json"
"""File that contains the stress of the film for which the models were trained."""

MODULE_SYNTAX = re.compile(r"^import .*;\n|^export (?=\w)", re.MULTILINE)
"""Pattern of import statements and of the word `export`, which are removed when the scripts are joined."""

QUADRILATERAL = 4
"""Number of corners of an electrode over which the page can integrate the stress."""


def playground_html(models: tuple[str, ...] = MODELS) -> str:
    """Return the playground as a single HTML page that contains its scripts, its style sheets and the networks.

    Args:
        models: Names or paths of the models that the page shows.

    Raises:
        ModelError: If a model is missing, or its film or electrodes cannot be shown.
    """
    with as_file(files("isocharge.serve.viewer")) as folder:
        series = read_stress_series(folder / SERIES_FILE)
        icon = (folder / "page/icon.svg").read_bytes()
        styles = [(folder / name).read_text("utf-8") for name in STYLES]
        scripts = [(folder / name).read_text("utf-8") for name in SCRIPTS]
        template = (folder / "playground/index.html").read_text("utf-8")
    parts = {
        "icon": base64.b64encode(icon).decode(),
        "style": "\n".join(styles),
        # All scripts become one script, which must not import or export anything.
        "script": "\n".join(MODULE_SYNTAX.sub("", script) for script in scripts),
        "data": _as_json(_page_data(series, models)),
    }

    # The template contains a placeholder for each part. It is the name of the part in double braces.
    html = template
    for name, text in parts.items():
        html = html.replace("{{" + name + "}}", text)
    return html


def _page_data(series: StressSeries, models: tuple[str, ...]) -> dict[str, Any]:
    """Return the data of the page: the stress of the film, the models, and the meanings of the flags it can show."""
    return {
        "stress": to_builtins(series),
        "models": [_describe_model(model, series) for model in models],
        "flags": {flag: MEANINGS[flag] for flag in (OUTSIDE, BEYOND, MISFIT, STRESS)},
    }


def _describe_model(name: str, series: StressSeries) -> dict[str, Any]:
    """Return the description of a model for the page, including its network.

    Args:
        name: Name or path of the model.
        series: Stress of the film that the playground contains.

    Raises:
        ModelError: If the model is missing, or its film or electrodes cannot be shown.
    """
    model = load_model(find_model(name))
    metadata = model.metadata
    piezo = metadata.sensor.get("piezo", {})
    is_biaxial = piezo.get("d31") == piezo.get("d32")  # equal coefficients in both directions of the film
    if not series.fits(metadata.sensor.get("film")) or not is_biaxial:
        raise ModelError(
            f"{name}: expected a model of the biaxial film of 25 um without pretension, whose stress the playground "
            f"contains, got the film {metadata.sensor.get('film')} with {piezo}; choose another model"
        )
    description = describe_film(metadata.name, metadata, None)
    outlines = description["outlines_mm"]
    corner_counts = [len(outlines.get(electrode, ())) for electrode in metadata.electrodes]
    if any(corner_count != QUADRILATERAL for corner_count in corner_counts):  # the page cannot integrate other shapes
        raise ModelError(f"{name}: expected electrodes with four corners, got {outlines}; choose another model")
    validity = Validity.of(metadata)
    network = (model.folder / "model.onnx").read_bytes()
    compressed_network = gzip.compress(network, compresslevel=9, mtime=0)  # no time, so that the bytes are repeatable
    return description | {
        "piezo_pC_per_N": piezo["d31"],
        "noise": {"white_pC": metadata.noise.white_pC, "gain": metadata.noise.gain},
        "misfit_limit": validity.misfit_limit,
        "yield_force_N": metadata.yield_force_N,
        "network": base64.b64encode(compressed_network).decode(),
    }


def _as_json(data: dict[str, Any]) -> str:
    """Encode data as JSON text that can be inserted into an HTML script element."""
    text = json.dumps(data, separators=(",", ":"))
    return text.replace("<", "\\u003c")  # otherwise a text such as "</script>" would end the element
