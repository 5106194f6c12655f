"""Start page of the HTTP server, which shows the models and an example of a request.

The names of models, the model cards and the reasons for refusals come from files. In all texts that come from files,
special characters of HTML are therefore escaped. In addition, the headers of the page do not allow browsers to run
scripts or to load other files.
"""

import base64
import hashlib
from html import escape
from urllib.parse import quote

from isocharge.common.files import read_whole
from isocharge.serve.model.model_folder import Model
from isocharge.serve.model.session import OUTPUT_MEANINGS
from isocharge.serve.network.model_store import LoadedVersion, ModelStore
from isocharge.serve.network.protocol.describe import server_metadata

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
"""Headers of every page. They allow only the style sheet in the page itself, which is identified by its hash."""

MAX_CARD_BYTES = 1 << 18
"""Largest size of a model card that the page shows, bytes."""


def page(store: ModelStore) -> str:
    """Return the start page as HTML. The page loads no other files.

    The page begins with an example of a request, because most visitors look for such an example.
    """
    refused = "".join(f'<p class="refused">Refused: {escape(reason)}</p>' for reason in store.refusals())
    served = store.loaded_versions()
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
    """Return the HTML of the section that shows how to send a press, or an empty text if no model is loaded.

    Args:
        served: All loaded versions of models. The first one is used for the example.
    """
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
    """Return the HTML of the section about one version of a model."""
    metadata = loaded.metadata
    min_force_N, max_force_N = metadata.force_range_N
    facts = {
        "sensor": metadata.frame_id,
        "charges": f"{', '.join(metadata.electrodes)}, pC, in this order",
        "forces": f"{min_force_N:g} to {max_force_N:g} N",
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
    """Return shell commands that send the first golden press of a model to the server with curl.

    Args:
        loaded: Version of the model whose press is sent.
        path: Path of the model on the server, without the slash at its beginning.
    """
    charges = ", ".join(f"{charge:.1f}" for charge in loaded.model.golden.charge_pC[0].tolist())
    tensor = f'"name": "charge_pC", "datatype": "FP32", "shape": [1, {len(loaded.metadata.electrodes)}]'
    body = f'{{"inputs": [{{{tensor}, "data": [{charges}]}}]}}'
    return f"SERVER=...  # the address of this page\ncurl $SERVER/{path}/infer -d '{body}'"


def _card(model: Model) -> str:
    """Read the model card in the folder of a model, and return the card as preformatted HTML.

    If the card cannot be read, the function returns a paragraph with a message instead.
    """
    try:
        text = read_whole(model.folder / "card.md", MAX_CARD_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError):
        return "<p>This model has no card that can be shown.</p>"
    return f"<pre>{escape(text)}</pre>"
