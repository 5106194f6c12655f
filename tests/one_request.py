"""A client that opens a connection for each request."""

import http.client
import json
from urllib.parse import urlsplit


def send(url, method, path, content=None, **headers):
    """Send a request to a server, and return the status, the headers and the body of the response."""
    connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=20)
    body = content if isinstance(content, str | bytes | None) else json.dumps(content)
    connection.request(method, path, body, headers)
    answer = connection.getresponse()
    result = answer.status, answer.headers, answer.read()
    connection.close()
    return result
