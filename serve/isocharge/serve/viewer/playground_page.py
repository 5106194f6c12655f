"""Playground, an HTML page on which a visitor can press a simulated film.

The page shows the contact that a network estimates from the charges of the press. The page is a single file, which
loads no other files. The file contains the scripts, the networks as compressed ONNX files, and the stress of the film
as a series, from which `playground/charges.js` computes the charges. The playground can show the models of a biaxial
film if the series describes the stress of this film, and if each electrode has four corners.
"""

import base64
import gzip
import json
import re
from pathlib import Path
from typing import Any

from isocharge.serve.flags import BEYOND, MEANINGS, MISFIT, OUTSIDE, STRESS
from isocharge.serve.model.model_folder import find_model, load_model
from isocharge.serve.viewer.film_description import describe_film

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


def playground_html() -> str:
    """Return the playground as a single HTML page that contains its scripts, its style sheets and the networks.

    Raises:
        ModelError: If a released model is missing.
    """
    folder = Path(__file__).parent
    icon = (folder / "page/icon.svg").read_bytes()
    styles = [(folder / name).read_text("utf-8") for name in STYLES]
    scripts = [(folder / name).read_text("utf-8") for name in SCRIPTS]
    html = (folder / "playground/index.html").read_text("utf-8")
    data = {
        "stress": json.loads((folder / SERIES_FILE).read_bytes()),
        "models": [_describe_model(model) for model in MODELS],
        "flags": {flag: MEANINGS[flag] for flag in (OUTSIDE, BEYOND, MISFIT, STRESS)},
    }
    parts = {
        "icon": base64.b64encode(icon).decode(),
        "style": "\n".join(styles),
        # All scripts become one script, which must not import or export anything.
        "script": "\n".join(MODULE_SYNTAX.sub("", script) for script in scripts),
        # A text such as "</script>" in the data must not end the script element.
        "data": json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
    }
    for name, text in parts.items():  # the page contains the name of each part in double braces
        html = html.replace("{{" + name + "}}", text)
    return html


def _describe_model(name: str) -> dict[str, Any]:
    """Return the description of a released model for the page, including its network."""
    model = load_model(find_model(name))
    metadata = model.metadata
    network = (model.folder / "model.onnx").read_bytes()
    compressed_network = gzip.compress(network, compresslevel=9, mtime=0)  # no time, so that the bytes are repeatable
    return describe_film(metadata.name, metadata) | {
        "piezo_pC_per_N": metadata.sensor["piezo"]["d31"],
        "noise": {"white_pC": metadata.noise.white_pC, "gain": metadata.noise.gain},
        "yield_force_N": metadata.yield_force_N,
        "network": base64.b64encode(compressed_network).decode(),
    }
