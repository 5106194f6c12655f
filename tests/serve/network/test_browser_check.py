"""Check of Host, Origin and Sec-Fetch-Site, which refuses requests of browsers for pages of other sites."""

import json
from contextlib import nullcontext

import pytest

from headless_chromium import start_chromium
from infer_requests import INFER, infer_request
from isocharge.common.errors import InputError, OriginError
from isocharge.serve.network.browser_check import AccessCheck, host_name
from isocharge.serve.network.protocol.handler import Handler

CHROMIUM_ARGUMENTS = (
    "--host-resolver-rules=MAP evil.example 127.0.0.1",
    # The browser's own protection of local addresses must not hide what the server does.
    "--disable-features=LocalNetworkAccessChecks,BlockInsecurePrivateNetworkRequests,PrivateNetworkAccessSendPreflights",
)
UNLOAD = "/v2/repository/models/linear/unload"


def headers_of(**headers):
    """Return headers as bytes. An underscore in a name stands for a hyphen."""
    return {name.replace("_", "-").encode(): value.encode() for name, value in headers.items()}


SERVED = [
    {"host": "127.0.0.1:8000"},
    {"host": "[::1]:8000"},
    {"host": "192.168.1.7:8000"},
    {"host": "LocalHost:8000"},
    {"host": "localhost.:8000"},
    {},  # HTTP/1.0
    {"host": "localhost:8000", "origin": "http://localhost:8000", "sec_fetch_site": "same-origin"},
    {"host": "localhost:8000", "sec_fetch_site": "none", "sec_fetch_mode": "navigate"},  # the address was typed
]

REFUSED = [
    ({"host": "evil.example:8000"}, "Host"),
    ({"host": "evil.example", "origin": "http://evil.example"}, "Host"),
    ({"host": "localhost.evil.example"}, "Host"),
    ({"host": "localhost@evil.example"}, "Host"),  # a user name
    ({"host": "127.1:8000"}, "Host"),
    ({"host": "[::1"}, "Host"),
    ({"host": "127.0.0.1:8000", "origin": "https://evil.example"}, "Origin"),
    ({"host": "127.0.0.1:8000", "origin": "http://127.0.0.1:3000"}, "Origin"),
    ({"host": "127.0.0.1:8000", "origin": "null"}, "Origin"),  # a page in a sandbox
    ({"host": "127.0.0.1:8000", "origin": "file://"}, "Origin"),
    ({"host": "127.0.0.1:8000", "sec_fetch_site": "cross-site"}, "Sec-Fetch-Site"),
    ({"host": "127.0.0.1:8000", "sec_fetch_site": "same-site"}, "Sec-Fetch-Site"),
    ({"host": "127.0.0.1:8000", "sec_fetch_site": "new-value"}, "Sec-Fetch-Site"),
]


@pytest.mark.parametrize("headers", SERVED)
def test_clients_and_own_pages_are_served(headers):
    AccessCheck().check("POST", headers_of(**headers))


@pytest.mark.parametrize(("headers", "header"), REFUSED)
def test_pages_of_other_sites_are_refused(headers, header):
    for method in ("GET", "POST"):
        with pytest.raises(OriginError, match=f"^{header}: expected"):
            AccessCheck().check(method, headers_of(**headers))


def test_repeated_host_is_refused_and_other_repeated_headers_are_joined(handler):
    """A second Host or Origin could be the one that a proxy has not checked."""
    own, other = (b"host", b"localhost"), (b"host", b"127.0.0.1")
    origins = [(b"origin", b"http://localhost"), (b"origin", b"http://evil.example")]
    for headers, status in [([own], 200), ([own, other], 400), ([own, own], 400), ([own, *origins], 403)]:
        for order in (headers, headers[::-1]):
            assert handler.answer("GET", "/v2", order, b"").status == status


def test_link_on_another_site_is_accepted():
    link = headers_of(
        host="127.0.0.1:8000", sec_fetch_site="cross-site", sec_fetch_mode="navigate", sec_fetch_dest="document"
    )
    AccessCheck().check("GET", link)
    for method, changes in (("POST", {}), ("GET", {b"sec-fetch-dest": b"iframe"})):
        with pytest.raises(OriginError, match="Sec-Fetch-Site"):
            AccessCheck().check(method, link | changes)


@pytest.mark.parametrize(
    ("host", "origin", "message"),
    [
        ("robot.example", "https://robot.example", None),
        ("127.0.0.1:8000", "https://robot.example:8443", None),  # the proxy replaces the name
        ("robot.example", "https://robot.example:8443", None),  # nginx: proxy_set_header Host $host
        ("robot.example:443", "https://robot.example", None),  # nginx: proxy_set_header Host $host:$server_port
        ("other.example", "", r"Host: .*one of 0\.0\.0\.0, localhost, robot\.example"),
        ("robot.example:8000", "http://robot.example:3000", "Origin: expected a page of this server"),
        ("robot.example:443", "https://robot.example.evil.example:1", "Origin: expected a page of this server"),
        ("robot.example:443", "http://robot.example", "Origin: expected a page of this server"),
    ],
)
def test_allow_host_accepts_pages_behind_a_proxy_and_none_of_another_port(host, origin, message):
    expected = pytest.raises(OriginError, match=message) if message else nullcontext()
    for allowed_hosts in (["Robot.Example"], "Robot.Example"):
        with expected:
            AccessCheck("0.0.0.0", allowed_hosts).check("POST", headers_of(host=host, origin=origin))


@pytest.mark.parametrize(
    "name", ["", " ", ".", "http://robot", "robot:8000", "robot/path", "*", "a b", "ro\nbot", "roböt"]
)
def test_allow_host_expects_a_plain_name(name):
    with pytest.raises(InputError, match="--allow-host: expected a host name without scheme, port and path"):
        host_name(name)


def test_with_a_token_any_host_name_is_served(store):
    handler = Handler(store, access=AccessCheck(token="sesame"))
    headers = [(b"host", b"inference.cluster.local"), (b"authorization", b"Bearer sesame")]
    assert handler.answer("GET", "/v2", headers, b"").status == 200
    assert handler.answer("GET", "/v2", [*headers, (b"origin", b"http://evil.example")], b"").status == 403


ATTACK = """<!doctype html><title>attack</title><iframe name="result"></iframe>
<form id="form" method="post" enctype="text/plain" target="result" action="{target}{unload}"><input name="x"></form>
<script>
async function attack() {{
  const tensor = {{ name: "charge_pC", datatype: "FP32", shape: [1, 3], data: [1, 2, 3] }};
  const body = JSON.stringify({{ inputs: [tensor] }});
  const answers = [];
  for (const [path, options] of [
    ["{infer}", {{ method: "POST", mode: "no-cors", body }}], ["{unload}", {{ method: "POST", mode: "no-cors" }}],
    ["/v2", {{ mode: "no-cors" }}], ["/metrics", {{}}],
  ]) {{
    try {{
      const answer = await fetch("{target}" + path, options);
      answers.push(answer.type === "opaque" ? "opaque" : answer.status);
    }} catch (error) {{ answers.push("blocked"); }}
  }}
  return answers;
}}
</script>"""


def test_no_page_of_another_origin_operates_the_server_in_chromium(store, start_http):
    handler = Handler(store)
    url = start_http(handler).url
    port = url.rpartition(":")[2]
    attack = ATTACK.format(target=url, infer=INFER, unload=UNLOAD)
    with start_chromium(*CHROMIUM_ARGUMENTS) as browser:
        page = browser.new_page()

        # A page of another origin: a form, and fetches that may not read the answers.
        page.route("http://evil.example/", lambda route: route.fulfill(body=attack, content_type="text/html"))
        page.goto("http://evil.example/")
        page.evaluate("attack()")
        page.evaluate("document.getElementById('form').submit()")
        page.wait_for_timeout(500)

        # A rebound name: the page and the server have the same origin, and the page could read the answers.
        answer = page.goto(f"http://evil.example:{port}/v2")
        assert answer.status == 403
        content = page.evaluate("fetch('/v2/models/linear').then((answer) => answer.text())")
        assert "Host: expected an IP address" in json.loads(content)["error"]

        # The server's own page, which a user opens by its address, still works.
        assert page.goto(f"{url}/v2").status == 200
        statuses = (
            "fetch('/v2/models/linear/infer', { method: 'POST', body: arguments }).then((answer) => answer.status)"
        )
        body = json.dumps(json.dumps(infer_request()))
        assert page.evaluate(statuses.replace("arguments", body)) == 200

    (requests, *_) = handler.traffic.registry.collect()
    counts = [sample for sample in requests.samples if sample.name == "isocharge_requests_total"]
    assert sum(sample.value for sample in counts if sample.labels["status"] == "403") >= 5
    statistics = store.get("linear", "").statistics.to_json()
    assert statistics["inference_count"] == 1  # the press of the server's own page
    assert len(store.versions_of()) == 2  # nothing was unloaded
