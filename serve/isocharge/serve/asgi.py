"""ASGI application that other programs mount, for example a program with FastAPI or Starlette."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from isocharge.common.extras import require

if TYPE_CHECKING:
    from isocharge.serve.network.http import Application


def asgi_app(
    models: Path | None = None, *, token: str | None = None, allowed_hosts: Iterable[str] = ()
) -> "Application":
    """Load models, and return an ASGI application that serves them with the Open Inference Protocol.

    The limits of connections belong to the server that runs the program. The application itself limits the size of a
    request, and checks the token and the headers of browsers.

    Args:
        models: Folder of the models. By default, all repositories are searched, as `isocharge serve http` does.
        token: Secret that clients must send as `Authorization: Bearer TOKEN`. By default, requests need no token.
        allowed_hosts: Host names by which browsers reach the program, in addition to IP addresses and `localhost`. With
            a token, every host name is accepted.

    Raises:
        MissingExtra: If the extra `http` is not installed.
        InputError: If the token or a host name cannot be used.
        ModelError: If there is no model, or no version passes its checks.

    Example:
        >>> from starlette.applications import Starlette  # doctest: +SKIP
        >>> from starlette.routing import Mount  # doctest: +SKIP
        >>> app = Starlette(routes=[Mount("/touch", asgi_app(token="s3cret"))])  # doctest: +SKIP
    """
    with require("http"):
        from isocharge.serve.network.address import Token
        from isocharge.serve.network.browser_check import BrowserCheck
        from isocharge.serve.network.http import Application
        from isocharge.serve.network.model_store import open_model_store
        from isocharge.serve.network.protocol import Handler

    secret = None if token is None else Token(token)
    browser_check = BrowserCheck(allowed_hosts=allowed_hosts, any_host=secret is not None)
    return Application(Handler(open_model_store(models), token=secret, browser_check=browser_check))
