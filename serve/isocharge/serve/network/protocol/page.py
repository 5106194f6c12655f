"""Start page of the HTTP server, which shows the models and an example of a request.

The page is a static file. Its script reads the names of the models from the server, with a token if the server has one,
and never interprets texts of the server as HTML. The headers of the page do not allow browsers to run other scripts or
to load other files.
"""

import base64
import hashlib
import re
from importlib.resources import files

from isocharge.common.errors import ModelNotFound
from isocharge.common.files import read_whole
from isocharge.serve.model.model_folder import Model

START_PAGE = files(__package__).joinpath("index.html").read_bytes()
"""Content of the start page."""


def _hash_of(element: bytes) -> bytes:
    """Return the expression `'sha256-...'` that allows an element of the start page in a content security policy.

    A browser uses the element only if the hash of its content is equal to the hash in the expression.

    Args:
        element: Name of the element, `style` or `script`. The page contains one element with this name.
    """
    match = re.search(rb"<%s>(.*?)</%s>" % (element, element), START_PAGE, re.DOTALL)
    text = match[1] if match else b""
    return b"'sha256-%s'" % base64.b64encode(hashlib.sha256(text).digest())


PAGE_HEADERS = [
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
]
"""Headers of every page, in addition to its content security policy."""

START_PAGE_POLICY = (
    b"default-src 'none'; style-src %s; script-src %s; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    b"frame-ancestors 'none'" % (_hash_of(b"style"), _hash_of(b"script"))
)
"""Content security policy of the start page. It allows only the style sheet and the script in the page itself."""

MAX_CARD_BYTES = 1 << 18
"""Largest size of a model card that the server sends, bytes."""


def card(model: Model) -> bytes:
    """Read the model card in the folder of a model.

    Raises:
        ModelNotFound: If the folder contains no card that can be read.
    """
    try:
        return read_whole(model.folder / "card.md", MAX_CARD_BYTES)
    except OSError as error:
        raise ModelNotFound(f"{model.metadata.label}: this model has no card that can be read ({error})") from error
