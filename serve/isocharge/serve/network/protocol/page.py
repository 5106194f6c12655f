"""Start page of the HTTP server, and the page that asks a browser for the token.

The start page shows the models and an example of a request. The names of models and the reasons for refusals come from
files. In all texts that come from files, special characters of HTML are therefore escaped. In addition, the headers of
the page do not allow browsers to run scripts or to load other files.
"""

import base64
import hashlib
import math
import re
from html import escape
from urllib.parse import quote

from isocharge.common.errors import ModelNotFound
from isocharge.common.files import read_whole
from isocharge.serve.model.model_folder import Model
from isocharge.serve.model.session import OUTPUT_MEANINGS
from isocharge.serve.network.model_store import LoadedVersion, ModelStore
from isocharge.serve.network.protocol.describe import server_metadata

STYLE = """
:root { color-scheme: light dark; --line: color-mix(in srgb, currentColor 18%, transparent) }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 52rem; margin: 0 auto; padding: 2rem 1.25rem 4rem }
h1 { font-size: 1.9rem; margin: 0 } h2 { font-size: 1.3rem; margin: 1.2rem 0 0 }
p { margin: .6rem 0 } a { color: #2563c9 } .quiet { opacity: .7 }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.25rem; margin: 1rem 0 } dt { opacity: .7 }
dd { margin: 0 } .wide { overflow-x: auto }
table { border-collapse: collapse; font-size: .9rem } th { opacity: .7; font-weight: normal; vertical-align: bottom }
th, td { text-align: left; padding: .35rem 1.1rem .35rem 0; border-bottom: 1px solid var(--line); white-space: nowrap }
th { white-space: normal }
.number { text-align: right; font-variant-numeric: tabular-nums }
input, button { font: inherit; padding: .35rem .6rem }
pre { background: color-mix(in srgb, currentColor 7%, transparent); border-radius: 8px; padding: .8rem 1rem;
  white-space: pre-wrap; overflow-wrap: anywhere; font-size: .85rem }
.refused { border-left: 4px solid #c2410c; padding-left: 1rem }
@media (prefers-color-scheme: dark) { a { color: #7fb0ff } }
@media (max-width: 40rem) {
  dl { grid-template-columns: 1fr } dd { margin-bottom: .5rem }
  table { font-size: .7rem } th, td { white-space: normal; padding-right: .4rem }
}
"""


def _hash(text: str) -> bytes:
    """Return the source of a content security policy that allows a style sheet or a script with the given text."""
    return b"'sha256-%s'" % base64.b64encode(hashlib.sha256(text.encode()).digest())


CONTENT_SECURITY_POLICY = (
    b"default-src 'none'; style-src %s; base-uri 'none'; form-action 'none'; frame-ancestors 'none'" % _hash(STYLE)
)
"""Content security policy of the start page. It allows only the style sheet in the page itself."""

PAGE_HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
"""Headers of every page, in addition to its content security policy."""

TOKEN_SCRIPT = """
const key = "isocharge token", form = document.querySelector("form"), field = document.querySelector("input");
const show = async (token) => {
  const answer = await fetch(location, { headers: { Accept: "text/html", Authorization: `Bearer ${token}` } });
  if (answer.status === 401) {
    sessionStorage.removeItem(key);
    document.querySelector("output").textContent = "The server expects another token.";
    return;
  }
  sessionStorage.setItem(key, token);
  const text = await answer.text();
  if (answer.headers.get("content-type").startsWith("text/html")) {
    const page = new DOMParser().parseFromString(text, "text/html").documentElement;
    document.replaceChild(document.adoptNode(page), document.documentElement);
  } else {
    const content = document.createElement("pre");
    content.textContent = text;
    document.body.replaceChildren(content);
  }
};
form.addEventListener("submit", (event) => { event.preventDefault(); show(field.value); });
const given = decodeURIComponent(location.hash.slice(1)) || sessionStorage.getItem(key);
history.replaceState(null, "", location.pathname);
if (given) show(given);
"""
"""Script that asks for the token, sends the request of the browser again with the token, and shows the answer."""

TOKEN_PAGE = f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>isocharge</title><style>{STYLE}</style></head><body>
<h1>isocharge</h1>
<p>This server answers only requests with its token, the value of <code>--token</code> or
<code>ISOCHARGE_TOKEN</code>.</p>
<form><p><label>Token <input type="password" autofocus required></label> <button>Show the models</button></p></form>
<p><output></output></p>
<script>{TOKEN_SCRIPT}</script></body></html>
"""
"""Page that a browser receives in place of every other answer if it has not sent the token."""

TOKEN_PAGE_POLICY = CONTENT_SECURITY_POLICY + b"; connect-src 'self'; script-src " + _hash(TOKEN_SCRIPT)
"""Content security policy of the page that asks for the token."""

MAX_CARD_BYTES = 1 << 18
"""Largest size of a model card that the page shows, bytes."""


ADDRESS = re.compile(r"https?://[A-Za-z0-9.:\[\]_-]+")
"""Addresses that are written into the example. The header `Host` of a request could contain any other text."""


def page(store: ModelStore, address: str = "", *, has_token: bool = False) -> str:
    """Return the start page as HTML. The page loads no other files.

    The page begins with an example of a request, because most visitors look for such an example.

    Args:
        store: Store of the models that the server uses.
        address: Address of the server, as the browser has requested it.
        has_token: Whether requests must contain a token.
    """
    refused = "".join(f'<p class="refused">Refused: {escape(reason)}</p>' for reason in store.refusals())
    served = store.loaded_versions()
    models = _table(served) if served else "<p>No model is loaded.</p>"
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>isocharge</title><style>{STYLE}</style></head><body>
<h1>isocharge</h1>
<p>Computes where a piezoelectric tactile film is touched, and how hard, from the charges of its electrodes.
<span class="quiet">Version {escape(server_metadata()["version"])}</span></p>
{_first_request(served, address, has_token=has_token)}
<h2>Models</h2>
{refused}{models}</body></html>
"""


def _first_request(served: list[LoadedVersion], address: str, *, has_token: bool) -> str:
    """Return the HTML of the section that shows how to send a press, or an empty text if no model is loaded.

    Args:
        served: All loaded versions of models. The first one is used for the example.
        address: Address of the server.
        has_token: Whether requests must contain a token.
    """
    if not served:
        return ""
    loaded = served[0]
    meanings = {name: OUTPUT_MEANINGS[name] for name in loaded.outputs}
    meanings["flags"] = 'reasons not to trust the contact; only on request: "outputs": [{"name": "flags"}]'
    rows = "".join(f"<dt><code>{name}</code></dt><dd>{escape(meaning)}</dd>" for name, meaning in meanings.items())
    return f"""<h2>Send a press</h2>
<p>The numbers are the charges of the electrodes {escape(", ".join(loaded.metadata.electrodes))} in pC: under load minus
without load.</p>
<pre>{escape(_example(loaded, address, has_token=has_token))}</pre>
<p>Each output of the answer has one row for each press:</p>
<dl>{rows}</dl>
<p>The server speaks the Open Inference Protocol, version 2, so the clients of Triton and KServe work, too.
<a href="openapi.json">openapi.json</a> describes every route.</p>"""


COLUMNS = (
    "model",
    "electrodes",
    "radius of the area, mm",
    "forces, N",
    "median error, mm",
    "median force error, %",
)
"""Headings of the table of models."""


def _table(served: list[LoadedVersion]) -> str:
    """Return the HTML of the table of models. The name of each model is a link to its card."""
    headings = "".join(f"<th>{heading}</th>" for heading in COLUMNS)
    rows = "".join(map(_row, served))
    return f'<div class="wide"><table><tr>{headings}</tr>{rows}</table></div>'


def _row(loaded: LoadedVersion) -> str:
    """Return the HTML of the row of one version of a model."""
    metadata = loaded.metadata
    min_force_N, max_force_N = metadata.force_range_N
    radius_mm = max(math.hypot(x_mm, y_mm) for x_mm, y_mm in metadata.working_area_mm)
    numbers = [
        f"{radius_mm:.1f}",
        f"{min_force_N:g} to {max_force_N:g}",
        *(
            f"{metadata.errors[name]:.2g}" if name in metadata.errors else ""
            for name in ("position_median_mm", "force_median_percent")
        ),
    ]
    cells = "".join(f'<td class="number">{number}</td>' for number in numbers)
    link = f'<a href="{_path(loaded)}/versions/{metadata.version}/card">{escape(metadata.label)}</a>'
    return f"<tr><td>{link}</td><td>{escape(', '.join(metadata.electrodes))}</td>{cells}</tr>"


def _path(loaded: LoadedVersion) -> str:
    """Return the path of a model on the server, without the slash at its beginning."""
    return f"v2/models/{quote(loaded.metadata.name, safe='')}"


def _example(loaded: LoadedVersion, address: str, *, has_token: bool) -> str:
    """Return a shell command that sends the first golden press of a model to the server with curl.

    Args:
        loaded: Version of the model whose press is sent.
        address: Address of the server.
        has_token: Whether requests must contain a token.
    """
    charges = ", ".join(f"{charge:.1f}" for charge in loaded.model.golden.charge_pC[0].tolist())
    tensor = f'"name": "charge_pC", "datatype": "FP32", "shape": [1, {len(loaded.metadata.electrodes)}]'
    body = f'{{"inputs": [{{{tensor}, "data": [{charges}]}}]}}'
    server = address if ADDRESS.fullmatch(address) else "http://ADDRESS"
    header = ' -H "Authorization: Bearer $ISOCHARGE_TOKEN"' if has_token else ""
    return f"curl '{server}/{_path(loaded)}/infer'{header} -d '{body}'"


def card(model: Model) -> str:
    """Read the model card in the folder of a model.

    Raises:
        ModelNotFound: If the folder contains no card that can be read.
    """
    path = model.folder / "card.md"
    try:
        return read_whole(path, MAX_CARD_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ModelNotFound(f"{model.metadata.label}: this model has no card that can be read ({error})") from error
