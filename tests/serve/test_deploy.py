"""What serve/deploy ships: units, images, manifests and hosts, each tried as far as this machine allows."""

import configparser
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import urllib.error
import urllib.request
from pathlib import Path

import jsonschema_rs
import numpy as np
import pytest
import tritonclient.http as triton
import yaml
from prometheus_client.parser import text_string_to_metric_families

from isocharge.serve import find_model
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.handler import Handler
from processes import finished

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "serve/deploy"
ENVIRONMENTS = Path(os.environ.get("ISOCHARGE_BENCH_ENVIRONMENTS", ROOT / "build/bench-environments"))
MODELS = find_model("three-25um-biaxial").parents[1]


# Hosts


def assert_golden(host):
    """Triton's stock client gets the golden answers of every model: a batch within the tolerance, a row within two."""
    with triton.InferenceServerClient(host) as client:
        for path in sorted(MODELS.glob("*/1/golden.json")):
            golden = json.loads(path.read_text())
            charges, tolerance = np.array(golden["inputs"]["charge_pC"], np.float32), golden["tolerance"]
            for rows, share in ((slice(None), 1.0), (slice(1), 2.0)):
                tensor = triton.InferInput("charge_pC", list(charges[rows].shape), "FP32")
                tensor.set_data_from_numpy(charges[rows], binary_data=False)
                answer = client.infer(path.parents[1].name, [tensor])
                for name, outputs in golden["outputs"].items():
                    expected = np.array(outputs)[rows]
                    allowed = tolerance["relative"] * np.maximum(np.abs(expected), tolerance["floor"][name])
                    assert (np.abs(answer.as_numpy(name) - expected) <= share * allowed).all(), (path, name)


def test_stock_client_receives_the_golden_outputs(start_http):
    assert_golden(start_http(Handler(ModelStore(MODELS))).url.removeprefix("http://"))


@pytest.mark.slow
def test_triton_serves_the_released_models(monkeypatch):
    """The stock tritonserver, the folder of models untouched, the same golden answers."""
    python = ENVIRONMENTS / "triton/bin/python"
    if not python.exists():
        pytest.skip(f"no environment {ENVIRONMENTS}/triton: create it with pip install nvidia-pytriton onnxruntime")
    monkeypatch.syspath_prepend(str(ROOT / "tests/benchmarks"))
    bench_http = __import__("bench_http")
    before = {path: path.stat().st_mtime_ns for path in MODELS.rglob("*")}
    address = ("127.0.0.1", bench_http.free_port())
    with bench_http.running([python, DEPLOY / "triton/start.py", MODELS, "--port", str(address[1])], address):
        assert_golden(f"127.0.0.1:{address[1]}")
    assert {path: path.stat().st_mtime_ns for path in MODELS.rglob("*")} == before


# systemd


SYSTEMD = DEPLOY / "systemd"
PROGRAM = str(Path(sys.executable).with_name("isocharge"))
UNITS = [
    ["isocharge.service"],
    ["isocharge.service", "isocharge.service.d/tls.conf"],
    ["isocharge-stream.service"],
]
"""Units, with their drop-ins."""


def installed_unit(folder, names):
    """Copy units and their drop-ins into a folder, with the program of this environment, and return the first."""
    for name in names:
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        text = (SYSTEMD / path.name).read_text()
        path.write_text(text.replace("ExecStart=/opt/isocharge/bin/isocharge", f"ExecStart={PROGRAM}"))
    return folder / names[0]


def analyze(*words):
    """Exit code and messages of `systemd-analyze`."""
    done = finished(["systemd-analyze", *words], timeout=60)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze")
@pytest.mark.parametrize("names", UNITS)
def test_systemd_analyze_accepts_the_units_and_the_page_states_their_exposure(tmp_path, names):
    unit = installed_unit(tmp_path, names)
    assert analyze("verify", unit) == (0, "")
    _, report = analyze("security", "--offline=true", unit)
    exposure, word = re.findall(r"exposure level for .*: ([\d.]+) (\w+)", report)[0]
    page = (ROOT / "serve/docs/systemd.md").read_text("utf-8")
    assert re.search(rf"as {re.escape(exposure)}( of 10)? \({word}\)", page)
    last = tmp_path / names[-1]
    last.write_text(last.read_text().replace(PROGRAM, "/nowhere/isocharge"))
    assert "/nowhere/isocharge" in analyze("verify", unit)[1]  # so verify has read this file


def unit_command(name):
    """The words of the command of a unit, without the program."""
    return shlex.split(re.findall(r"^ExecStart=(\S.*)$", (SYSTEMD / name).read_text(), re.MULTILINE)[0])[1:]


def compose_command(name):
    """The words of the command of a service of the compose file."""
    return yaml.safe_load(COMPOSE.read_text())["services"][name]["command"]


COMPOSE = DEPLOY / "compose/compose.yaml"


def local_command(words, secrets, folder):
    """The command of a service on a free port of this machine; the stream reads frames from a pipe."""
    line = " ".join(words).replace(secrets, str(folder))
    line = re.sub(r"0\.0\.0\.0(:| --port )\d+", r"127.0.0.1\g<1>0", line)
    return re.sub(r"--port /dev/\S+", "--port -", line)


@pytest.mark.parametrize(("unit", "service"), [("tls.conf", "server"), ("isocharge-stream.service", "stream")])
def test_the_commands_of_a_unit_and_of_a_service_are_equal_listen_with_tls_and_need_the_token(
    unit, service, tmp_path, monkeypatch, authority, trusted, start_command
):
    issued = authority.issue_cert("127.0.0.1")
    issued.cert_chain_pems[0].write_to_path(tmp_path / "fullchain.pem")
    issued.private_key_pem.write_to_path(tmp_path / "privkey.pem")
    (tmp_path / "board.toml").write_text('name = "board"\n')
    line = local_command(unit_command(unit), "${CREDENTIALS_DIRECTORY}", tmp_path)
    assert line == local_command(compose_command(service), "/run/secrets", tmp_path)
    monkeypatch.setenv("ISOCHARGE_TOKEN", "s3cret")
    process = start_command(*line.split())
    printed = process.stderr if service == "stream" else process.stdout
    url = next(found[0] for text in printed if (found := re.search(r"https://127\.0\.0\.1:\d+", text)))
    path = "/session.json" if service == "stream" else "/v2/models/three-25um-biaxial"
    with pytest.raises(urllib.error.HTTPError, match="401"):
        urllib.request.urlopen(url + path, timeout=20, context=trusted)
    request = urllib.request.Request(url + path, headers={"Authorization": "Bearer s3cret"})
    with urllib.request.urlopen(request, timeout=20, context=trusted) as answer:
        assert json.loads(answer.read())


def test_the_compose_file_agrees_with_the_schema_of_compose():
    schema = json.loads((ROOT / "tests/data/compose/compose_spec.json").read_text())
    for path in (COMPOSE, DEPLOY / "monitoring/compose.yaml"):
        content = yaml.safe_load(path.read_text())
        jsonschema_rs.validate(schema, content)
        assert all({"mem_limit", "pids_limit"} <= service.keys() for service in content["services"].values())
        content["services"][next(iter(content["services"]))]["prots"] = []
        assert not jsonschema_rs.is_valid(schema, content)


def test_every_secret_of_the_compose_file_exists_and_is_used():
    content = yaml.safe_load(COMPOSE.read_text())
    for service in content["services"].values():
        used = {word.removeprefix("/run/secrets/") for word in service["command"] if word.startswith("/run/secrets/")}
        assert used == set(service["secrets"])
        assert used <= set(content["secrets"])


# Images

VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def test_every_image_is_pinned():
    """Our own image has the version as its tag; other images have a digest."""
    images = re.findall(r"^FROM (\S+)", (DEPLOY / "Containerfile").read_text(), re.MULTILINE)
    for path in DEPLOY.rglob("*.y*ml"):
        images += re.findall(r"^\s*image: (\S+)", path.read_text(), re.MULTILINE)
    ours = [image for image in images if image.startswith("isocharge")]
    assert set(ours) == {f"isocharge:{VERSION}"}
    assert len(ours) < len(images)
    for image in set(images) - set(ours):
        assert re.fullmatch(r"[\w./-]+:[\w.-]+@sha256:[0-9a-f]{64}", image), image


def test_the_service_and_the_budget_select_the_pods_of_the_deployment():
    deployment, service, budget = yaml.safe_load_all((DEPLOY / "kubernetes/isocharge.yaml").read_text())
    pod = deployment["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert pod["automountServiceAccountToken"] is False
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    selectors = [manifest["spec"]["selector"] for manifest in (deployment, budget, service)]
    assert selectors == [{"matchLabels": labels}, {"matchLabels": labels}, labels]
    assert service["spec"]["ports"][0]["targetPort"] == container["ports"][0]["containerPort"]
    assert budget["spec"]["minAvailable"] < deployment["spec"]["replicas"]


# Prometheus


def test_dashboard_and_alerts_ask_for_metrics_that_there_are(start_http):
    """Every metric that they name is one of a server that has answered a request."""
    files = DEPLOY / "monitoring"
    services = yaml.safe_load((files / "compose.yaml").read_text())["services"]
    mounts = [mount.split(":")[0] for service in services.values() for mount in service.get("volumes", ())]
    assert all((files / mount).is_file() for mount in mounts if mount != "./token")
    rules = [rule["expr"] for rule in yaml.safe_load((files / "alerts.yml").read_text())["groups"][0]["rules"]]
    panels = json.loads((files / "grafana/isocharge.json").read_text())["panels"]
    queries = " ".join(rules + [target["expr"] for panel in panels for target in panel["targets"]])
    url = start_http(Handler(ModelStore(MODELS))).url
    urllib.request.urlopen(f"{url}/v2/health/ready", timeout=20).close()
    with urllib.request.urlopen(f"{url}/metrics", timeout=20) as answer:
        families = text_string_to_metric_families(answer.read().decode())
    served = {sample.name for family in families for sample in family.samples}
    assert set(re.findall(r"\b(?:isocharge|process)_\w+", queries)) <= served


def test_the_node_is_installed_where_ros2_run_looks_for_it():
    settings = configparser.ConfigParser()
    settings.read(DEPLOY / "ros2/isocharge_ros/setup.cfg")
    assert settings["install"]["install_scripts"] == settings["develop"]["script_dir"] == "$base/lib/isocharge_ros"


def test_the_ros2_package_has_the_version_of_isocharge():
    folder = DEPLOY / "ros2/isocharge_ros"
    assert f'version="{VERSION}"' in (folder / "setup.py").read_text()
    assert f"<version>{VERSION}</version>" in (folder / "package.xml").read_text()


def test_the_page_copies_every_file_that_the_units_read(tmp_path):
    """The commands of the page, with folders below a temporary one in place of /etc, and without systemctl."""
    page = (ROOT / "serve/docs/systemd.md").read_text("utf-8")
    commands = [line for block in re.findall(r"```text\n(.*?)```", page, re.DOTALL) for line in block.splitlines()]
    installs = [line.replace(" /etc/", f" {tmp_path}/etc/") for line in commands if line.startswith("install ")]
    assert len(installs) == len([line for line in commands if "systemctl" not in line])
    (tmp_path / "etc/systemd/system").mkdir(parents=True)
    desk = tmp_path / "desk"
    shutil.copytree(SYSTEMD, desk)
    for name in ("fullchain.pem", "privkey.pem", "isocharge.env", "board.toml"):
        (desk / name).write_text("secret")
    subprocess.run(["sh", "-ec", "\n".join(installs)], cwd=desk, check=True, timeout=60)
    installed = [path for path in (tmp_path / "etc/systemd/system").rglob("*") if path.is_file()]
    assert {path.name for path in installed} == {"isocharge.service", "tls.conf", "isocharge-stream.service"}
    for unit in installed:
        read = re.findall(r"^(?:LoadCredential=\S+:|EnvironmentFile=)(/etc/\S+)$", unit.read_text(), re.MULTILINE)
        for path in read:
            assert (tmp_path / path.lstrip("/")).stat().st_mode & 0o777 == 0o600
