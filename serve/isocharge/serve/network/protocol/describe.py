"""What the server says about itself and its models: JSON objects, of whose fields gRPC has messages; OpenAPI; a page.

On the page for people, names, cards and reasons come from files: they are escaped, and the page's headers forbid a
browser to run or load anything, should one of them get through.
"""

import base64
import hashlib
from html import escape
from typing import Any
from urllib.parse import quote

import msgspec

from isocharge.common.files import read_whole
from isocharge.common.versions import package_version
from isocharge.serve.model.model_folder import Model
from isocharge.serve.model.session import INPUT, OUTPUT_MEANINGS, OUTPUTS
from isocharge.serve.network.address import ServerLimits
from isocharge.serve.network.model_store import LoadedVersion, ModelStore
from isocharge.serve.network.protocol.inference import FLAGS, InferBody

EXTENSIONS = (
    "binary_tensor_data",
    "model_configuration",
    "model_repository",
    "model_repository(unload_dependents)",
    "parameters",
    "statistics",
)

PLATFORM = "onnxruntime_onnx"
"""Triton's name for ONNX models."""

NO_LOAD_PARAMETERS = "load: parameters are not supported; put the files into the model's folder and load it again"


def server_metadata() -> dict[str, Any]:
    """Name, version and extensions."""
    return {"name": "isocharge", "version": package_version(), "extensions": list(EXTENSIONS)}


def model_metadata(loaded: LoadedVersion, store: ModelStore) -> dict[str, Any]:
    """Tensors of a model, and under `properties` everything that its file says about itself, as JSON texts."""
    metadata = loaded.metadata
    return {
        "name": metadata.name,
        "versions": [other.version for other in store.named(metadata.name)],
        "platform": PLATFORM,
        "inputs": [_tensor(INPUT, len(metadata.electrodes))],
        "outputs": [_tensor(name, OUTPUTS[name]) for name in loaded.outputs],
        "properties": metadata.to_props(),
    }


def _tensor(name: str, width: int) -> dict[str, Any]:
    return {"name": name, "datatype": "FP32", "shape": [-1, width]}


def model_config(loaded: LoadedVersion, limits: ServerLimits) -> dict[str, Any]:
    """A model's configuration as Triton would have it; unlike Triton by default, every version serves."""
    return {
        "name": loaded.metadata.name,
        "platform": PLATFORM,
        "backend": "onnxruntime",
        "version_policy": {"all": {}},
        "max_batch_size": limits.batch,
        "input": [{"name": INPUT, "data_type": "TYPE_FP32", "dims": [len(loaded.metadata.electrodes)]}],
        "output": [{"name": name, "data_type": "TYPE_FP32", "dims": [OUTPUTS[name]]} for name in loaded.outputs],
    }


def statistics_of(store: ModelStore, name: str = "", version: str = "") -> dict[str, Any]:
    """Counters of a version of a model, of all its versions, or of all models.

    Raises:
        ModelNotFound: If it does not serve.
    """
    models = [store.get(name, version)] if version else store.named(name) if name else store.all()
    return {
        "model_stats": [
            {"name": loaded.metadata.name, "version": loaded.version, **loaded.statistics.to_json()}
            for loaded in models
        ]
    }


def repository_index(store: ModelStore, *, ready: bool) -> list[dict[str, str]]:
    """Every version in the repository; with `ready`, only what serves."""
    return [row for row in store.index() if row["state"] == "READY" or not ready]


Json = dict[str, Any]

EXAMPLE = {"inputs": [{"name": "charge_pC", "datatype": "FP32", "shape": [1, 3], "data": [942.9, 910.4, 690.8]}]}

BODIES: Json = {
    "index": {"type": "object", "properties": {"ready": {"type": "boolean"}}},
    "load": {"type": "object", "properties": {"parameters": {"type": "object", "maxProperties": 0}}},
    "unload": {"type": "object"},
}
"""Schemas of the bodies that may be missing."""

PATHS = {
    "/v2/health/live": ("Whether the server runs", "any"),
    "/v2/health/ready": ("Whether a model is loaded", "any"),
    "/metrics": ("Counters of all models and requests, in the text format of Prometheus", "text"),
    "/v2": ("Name, version and extensions of the server", "server"),
    "/v2/models/stats": ("Counters of all models", "stats"),
    "/v2/repository/index": ("Every version in the repository", "rows"),
    "/v2/repository/models/{model}/load": ("Read a model's files again and swap it in", "any"),
    "/v2/repository/models/{model}/unload": ("Take a model off", "any"),
}
"""Path to what it is for and the schema of its answer."""

PATHS_OF_MODEL = {
    "": ("Tensors of a model and what its file says about itself", "model"),
    "/ready": ("Whether a model serves", "any"),
    "/config": ("A model's configuration, as Triton words it", "any"),
    "/stats": ("A model's counters", "stats"),
    "/infer": ("Charges to contacts", "answer"),
}
"""The same behind the name of a model, or behind its version."""


def openapi(store: ModelStore) -> Json:
    """The document, OpenAPI 3.1."""
    models = {loaded.metadata.name for loaded in store.all()}
    versions = {loaded.version for loaded in store.all()}
    bases = "/v2/models/{model}", "/v2/models/{model}/versions/{version}"
    paths = PATHS | {base + tail: of for base in bases for tail, of in PATHS_OF_MODEL.items()}
    _, schemas = msgspec.json.schema_components([InferBody], ref_template="#/components/schemas/{name}")
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "isocharge",
            "version": server_metadata()["version"],
            "description": "Computes contacts on a piezoelectric tactile film from the charges of its electrodes, with "
            "the Open Inference Protocol, version 2. The input `charge_pC` has one row for each press and one column "
            "for each electrode: the charge under load minus the charge without load, in pC. Bodies may be compressed "
            "with gzip or deflate, and tensors may follow the JSON in binary, as in the binary tensor extension of the "
            "protocol.",
        },
        "paths": {path: _path(path, *of) for path, of in paths.items()},
        "components": {
            "parameters": {"model": _path_parameter("model", models), "version": _path_parameter("version", versions)},
            "schemas": schemas | BODIES | ANSWERS,
            "responses": {"error": {"description": "Why not", "content": _content("error")}},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{}, {"token": []}],
    }


def _path(path: str, summary: str, answer: str) -> Json:
    """What the document says about a path; those with a body are asked for with POST."""
    good = {"description": summary, "content": _content(answer, "text/plain" if answer == "text" else JSON)}
    operation: Json = {"summary": summary, "responses": {"200": good, "4XX": _ref("responses/error")}}
    tail = path.rpartition("/")[2]
    if tail == "infer":
        operation["requestBody"] = {"required": True, "content": _content("InferBody", example=EXAMPLE)}
    elif tail in BODIES:
        operation["requestBody"] = {"content": _content(tail)}
    parameters = [_ref(f"parameters/{name}") for name in ("model", "version") if f"{{{name}}}" in path]
    return {"parameters": parameters, "post" if "requestBody" in operation else "get": operation}


JSON = "application/json"


def _ref(name: str) -> Json:
    return {"$ref": f"#/components/{name}"}


def _content(schema: str, kind: str = JSON, **more: Any) -> Json:
    return {kind: {"schema": _ref(f"schemas/{schema}"), **more}}


def _path_parameter(name: str, values: set[str]) -> Json:
    schema = {"type": "string", "enum": sorted(values) or ["none"]}
    return {"name": name, "in": "path", "required": True, "schema": schema}


def _object(properties: Json, required: list[str] | None = None) -> Json:
    return {"type": "object", "properties": properties, "required": required or list(properties)}


def _list_of(items: Json) -> Json:
    return {"type": "array", "items": items}


_TEXT, _SHAPE = {"type": "string"}, _list_of({"type": "integer"})

_TENSORS = _list_of(_object({"name": _TEXT, "datatype": _TEXT, "shape": _SHAPE}))

_NUMBER = {"type": ["number", "null"], "description": "null: not finite, which JSON has no number for"}

_OUTPUT = _object(
    {
        "name": {
            "enum": [*OUTPUTS, FLAGS],
            "description": "; ".join(f"`{name}`: {meaning}" for name, meaning in OUTPUT_MEANINGS.items())
            + f"; `{FLAGS}`: reasons not to trust the contact, separated by commas",
        },
        "datatype": {"enum": ["FP32", "BYTES"]},
        "shape": _SHAPE | {"description": "number of presses, and numbers for each press"},
        "data": {"anyOf": [_list_of(_NUMBER), _list_of(_TEXT)]},
    },
    ["name", "datatype", "shape"],
)

ANSWERS: Json = {
    "any": {"type": "object"},
    "text": _TEXT,
    "error": _object({"error": _TEXT}),
    "server": _object({"name": _TEXT, "version": _TEXT, "extensions": _list_of(_TEXT)}),
    "model": _object(
        {
            "name": _TEXT,
            "versions": _list_of(_TEXT),
            "platform": _TEXT,
            "inputs": _TENSORS,
            "outputs": _TENSORS,
            "properties": {"type": "object", "additionalProperties": _TEXT},
        }
    ),
    "stats": _object({"model_stats": _list_of(_object({"name": _TEXT, "version": _TEXT}))}),
    "rows": _list_of(_object({"name": _TEXT, "version": _TEXT, "state": _TEXT, "reason": _TEXT})),
    "answer": _object(
        {"model_name": _TEXT, "model_version": _TEXT, "id": _TEXT, "outputs": _list_of(_OUTPUT)},
        ["model_name", "model_version", "outputs"],
    ),
}
"""Schemas of the answers."""


STYLE = """
:root { color-scheme: light dark; --line: color-mix(in srgb, currentColor 18%, transparent) }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 52rem; margin: 0 auto; padding: 2rem 1.25rem 4rem }
h1 { font-size: 1.9rem; margin: 0 } h2 { font-size: 1.3rem; margin: 1.2rem 0 0 } article h2 { margin: 0 }
h3 { font-size: 1.05rem; margin: 1.4rem 0 .4rem }
p { margin: .6rem 0 } a { color: #2563c9 } .quiet { opacity: .7 }
article { border: 1px solid var(--line); border-radius: 12px; padding: 1.25rem 1.5rem; margin: 1.5rem 0 }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.25rem; margin: 1rem 0 } dt { opacity: .7 }
dd { margin: 0 } summary { cursor: pointer; margin-top: .8rem }
pre { background: color-mix(in srgb, currentColor 7%, transparent); border-radius: 8px; padding: .8rem 1rem;
  white-space: pre-wrap; overflow-wrap: anywhere; font-size: .85rem }
.refused { border-left: 4px solid #c2410c; padding-left: 1rem }
@media (prefers-color-scheme: dark) { a { color: #7fb0ff } }
"""


_STYLE_HASH = base64.b64encode(hashlib.sha256(STYLE.encode()).digest())

PAGE_HEADERS = (
    (
        b"content-security-policy",
        b"default-src 'none'; style-src 'sha256-%s'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        % _STYLE_HASH,
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
"""Headers of every page: its one style, known by its hash, and nothing else."""

LONGEST_CARD = 1 << 18
"""Longest card that the page shows, bytes."""


def page(store: ModelStore) -> str:
    """Return the page for people as HTML. It loads nothing else.

    It begins with an example of a request, because this is what most visitors look for.
    """
    refused = "".join(f'<p class="refused">Refused: {escape(reason)}</p>' for reason in store.refusals())
    served = store.all()
    articles = "".join(map(_article, served)) or "<p>No model is loaded.</p>"
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>isocharge</title><style>{STYLE}</style></head><body>
<h1>isocharge</h1>
<p>Computes where a piezoelectric tactile film is touched, and how hard, from the charges of its electrodes.
<span class="quiet">Version {escape(server_metadata()["version"])}</span></p>
{_first_request(served)}
<h2>Models</h2>
{refused}{articles}</body></html>
"""


def _first_request(served: list[LoadedVersion]) -> str:
    """Return how to send a press, and what the answer means."""
    if not served:
        return ""
    loaded = served[0]
    path = f"v2/models/{quote(loaded.metadata.name, safe='')}"
    meanings = "".join(
        f"<dt><code>{name}</code></dt><dd>{escape(OUTPUT_MEANINGS[name])}</dd>" for name in loaded.outputs
    )
    return f"""<h2>Send a press</h2>
<p>The numbers are the charges of the electrodes {escape(", ".join(loaded.metadata.electrodes))} in pC: under load minus
without load.</p>
<pre>{escape(_example(loaded, path))}</pre>
<p>Each output of the answer has one row for each press:</p>
<dl>{meanings}</dl>
<p>The server speaks the Open Inference Protocol, version 2, so the clients of Triton and KServe work, too.
<a href="openapi.json">openapi.json</a> describes every route.</p>"""


def _article(loaded: LoadedVersion) -> str:
    metadata = loaded.metadata
    low, high = metadata.force_range_N
    facts = {
        "sensor": metadata.frame_id,
        "charges": f"{', '.join(metadata.electrodes)}, pC, in this order",
        "forces": f"{low:g} to {high:g} N",
        "probes": ", ".join(metadata.probes),
    }
    rows = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts.items())
    path = f"v2/models/{quote(metadata.name, safe='')}/versions/{metadata.version}"
    return f"""<article><h2>{escape(metadata.name)} <span class="quiet">version {metadata.version}</span></h2>
<dl>{rows}</dl><pre>{escape(_example(loaded, path))}</pre>
<p><a href="{path}">metadata</a> · <a href="{path}/config">configuration</a> · <a href="{path}/stats">statistics</a></p>
<details open><summary>Model card</summary>{_card(loaded.model)}</details></article>
"""


def _example(loaded: LoadedVersion, path: str) -> str:
    press = ", ".join(f"{charge:.1f}" for charge in loaded.model.golden.charge_pC[0].tolist())
    tensor = f'"name": "charge_pC", "datatype": "FP32", "shape": [1, {len(loaded.metadata.electrodes)}]'
    body = f'{{"inputs": [{{{tensor}, "data": [{press}]}}]}}'
    return f"SERVER=...  # the address of this page\ncurl $SERVER/{path}/infer -d '{body}'"


def _card(model: Model) -> str:
    """The card in the model's folder, as the text that it is."""
    try:
        return f"<pre>{escape(read_whole(model.folder / 'card.md', LONGEST_CARD).decode('utf-8'))}</pre>"
    except (OSError, UnicodeDecodeError):
        return "<p>This model has no card that can be shown.</p>"
