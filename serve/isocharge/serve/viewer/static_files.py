"""The files of the page, read once."""

from importlib.resources import files
from importlib.resources.abc import Traversable

from isocharge.serve.network.protocol.page import PAGE_HEADERS
from isocharge.serve.network.protocol.response import Response, response_of

TYPES = {
    ".html": b"text/html; charset=utf-8",
    ".css": b"text/css; charset=utf-8",
    ".js": b"text/javascript; charset=utf-8",
    ".svg": b"image/svg+xml",
    ".LICENSE": b"text/plain; charset=utf-8",
}
"""Content type by the end of a file's name."""

POLICY = (
    b"default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; "
    b"base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""What a browser may load: our own files, and nothing from anywhere else."""


def page_files() -> dict[str, Response]:
    """The answer to each path; `/` is the page."""
    folder = files("isocharge.serve.viewer") / "page"
    answers = {f"/{name}": _answer(file) for name, file in _walk(folder, "")}
    return answers | {"/": answers["/index.html"]}


def _walk(folder: Traversable, prefix: str) -> list[tuple[str, Traversable]]:
    entries: list[tuple[str, Traversable]] = []
    for entry in folder.iterdir():
        name = prefix + entry.name
        entries += _walk(entry, f"{name}/") if entry.is_dir() else [(name, entry)]
    return entries


def _answer(file: Traversable) -> Response:
    response = response_of(200, TYPES["." + file.name.rpartition(".")[2]], file.read_bytes())
    others = [header for header in PAGE_HEADERS if header[0] != b"content-security-policy"]
    response.headers.extend([(b"content-security-policy", POLICY), (b"cache-control", b"no-cache"), *others])
    return response
