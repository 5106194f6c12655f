"""What serve/deploy ships: units, images, manifests and hosts, each tried as far as this machine allows."""

import ctypes
import json
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import tritonclient.http as triton
import yaml
from prometheus_client.parser import text_string_to_metric_families

from isocharge.serve import find_model
from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol import Handler

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "serve/deploy"
UNIT = DEPLOY / "systemd/isocharge.service"
ENVIRONMENTS = Path(os.environ.get("ISOCHARGE_BENCH_ENVIRONMENTS", ROOT / "build/bench-environments"))
MODELS = find_model("three-25um-biaxial").parents[1]
PR_SET_NO_NEW_PRIVS, PR_SET_MDWE = 38, 65


@contextmanager
def running(words, **options):
    """A server process that prints its address."""
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)
    try:
        yield process, process.stdout.readline().strip()
    finally:
        process.terminate()
        process.communicate(timeout=30)


def status_of(url, token=None):
    request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"} if token else {})
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        with error:
            return error.code


# Hosts


def assert_golden(address):
    """Triton's stock client gets the golden answers of every model: a batch within the tolerance, a row within two."""
    with triton.InferenceServerClient("{}:{}".format(*address)) as client:
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


def test_our_answers_are_golden_for_a_stock_client(start_http):
    assert_golden(start_http(Handler(open_model_store(MODELS))).url.removeprefix("http://").split(":"))


@pytest.mark.slow
def test_triton_serves_the_models_as_they_stand(monkeypatch):
    """The stock tritonserver, the folder of models untouched, the same golden answers."""
    if not (ENVIRONMENTS / "triton/done").exists():
        pytest.skip(f"no environment {ENVIRONMENTS}/triton: tests/benchmarks/bench_http.py makes it")
    monkeypatch.syspath_prepend(str(ROOT / "tests/benchmarks"))
    bench_http = __import__("bench_http")
    before = {path: path.stat().st_mtime_ns for path in MODELS.rglob("*")}
    address = ("127.0.0.1", bench_http.free_port())
    python = bench_http.python_of("triton", ENVIRONMENTS)
    with bench_http.running([python, DEPLOY / "triton/start.py", MODELS, "--port", str(address[1])], address):
        assert_golden(address)
    assert {path: path.stat().st_mtime_ns for path in MODELS.rglob("*")} == before


# systemd


@pytest.fixture
def unit(tmp_path):
    """The unit with the program of this environment, which `verify` looks for."""
    path = tmp_path / "isocharge.service"
    program = str(Path(sys.executable).with_name("isocharge"))
    path.write_text(UNIT.read_text().replace("ExecStart=/opt/isocharge/bin/isocharge", f"ExecStart={program}"))
    return path


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze")
def test_systemd_finds_nothing_wrong_with_the_unit(unit):
    done = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze")
def test_systemd_calls_the_unit_safe(unit):
    """Below 1.5 of 10; the same unit without its hardening is above 9."""
    words = ["systemd-analyze", "security", "--offline=true", "--no-pager", "--threshold=15"]
    done = subprocess.run([*words, unit], capture_output=True, text=True, timeout=60, check=False)
    if "unrecognized option" in done.stderr or "Unknown" in done.stderr:
        pytest.skip("this systemd-analyze cannot judge a file")
    assert done.returncode == 0, done.stdout[-500:]
    bare = [line for line in unit.read_text().splitlines() if line.startswith(("[", "ExecStart", "Type"))]
    unit.write_text("\n".join(bare) + "\n")
    assert subprocess.run([*words, unit], capture_output=True, timeout=60, check=False).returncode != 0


def test_the_server_runs_within_what_the_unit_allows(unit, models):
    """As far as a process can restrict itself: no new rights, no writable code, few descriptors, a read-only folder."""
    text = unit.read_text()
    words = shlex.split(re.search(r"^ExecStart=(.+)$", text, re.MULTILINE)[1].replace("--port 8000", "--port 0"))
    descriptors = int(re.search(r"^LimitNOFILE=(\d+)$", text, re.MULTILINE)[1])
    libc = ctypes.CDLL(None, use_errno=True)

    def restrict():
        resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors, descriptors))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for option in (PR_SET_NO_NEW_PRIVS, PR_SET_MDWE):  # an older kernel knows not the second
            libc.prctl(option, 1, 0, 0, 0)

    named = dict(pair.split("=") for pair in re.search(r"^Environment=(.+)$", text, re.MULTILINE)[1].split())
    command = [*words, "--models", str(models)]
    with running(command, preexec_fn=restrict, env=os.environ | named, cwd="/") as (process, url):
        assert url, process.communicate(timeout=20)[1]
        assert status_of(f"{url}/v2/health/ready") == 200
        assert status_of(f"{url}/metrics") == 200


# Prometheus


def test_dashboard_and_alerts_ask_for_metrics_that_there_are(start_http):
    """Every metric that they name is one of a server that has answered a press and refused one."""
    files = DEPLOY / "monitoring"
    services = yaml.safe_load((files / "compose.yaml").read_text())["services"]
    mounts = [mount.split(":")[0] for service in services.values() for mount in service.get("volumes", ())]
    assert all((files / mount).is_file() for mount in mounts if mount != "./token")
    rules = [rule["expr"] for rule in yaml.safe_load((files / "alerts.yml").read_text())["groups"][0]["rules"]]
    panels = json.loads((files / "grafana/isocharge.json").read_text())["panels"]
    asked = " ".join(rules + [target["expr"] for panel in panels for target in panel["targets"]])
    url = start_http(Handler(open_model_store(MODELS))).url
    assert status_of(f"{url}/v2/health/ready") == 200
    with urllib.request.urlopen(f"{url}/metrics", timeout=20) as answer:
        families = text_string_to_metric_families(answer.read().decode())
    there = {sample.name for family in families for sample in family.samples}
    assert set(re.findall(r"\b(?:isocharge|process)_\w+", asked)) <= there


# Kubernetes


@pytest.fixture(scope="module")
def predictor_of_kserve():
    return yaml.safe_load((DEPLOY / "kserve/inference_service.yaml").read_text())["spec"]["predictor"]


def test_the_manifest_starts_our_server_as_it_says(predictor_of_kserve, models, tmp_path):
    """Its arguments start a server that answers its probes, and nothing else without the token."""
    (container,) = predictor_of_kserve["containers"]
    (port,) = (entry["containerPort"] for entry in container["ports"])
    arguments = [word if word != str(port) else "0" for word in container["args"]]
    assert str(port) in container["args"]
    assert [entry["name"] for entry in container["env"]] == ["ISOCHARGE_TOKEN"]
    words = [sys.executable, "-m", "isocharge.cli", *arguments, "--models", str(models)]
    with running(words, env=os.environ | {"ISOCHARGE_TOKEN": "yes"}, cwd=tmp_path) as (_, url):
        url = url.replace("0.0.0.0", "127.0.0.1")
        for probe in ("readinessProbe", "livenessProbe"):
            assert container[probe]["httpGet"]["port"] == port
            assert status_of(url + container[probe]["httpGet"]["path"]) == 200
        assert (status_of(f"{url}/metrics"), status_of(f"{url}/metrics", "yes")) == (401, 200)
    assert predictor_of_kserve["scaleMetric"] == "cpu"
    assert container["resources"]["requests"]["cpu"] == "1"


# Containers


def steps(stage):
    """Instructions of one stage of the Containerfile, with their arguments."""
    text = (DEPLOY / "Containerfile").read_text()
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    starts = [number for number, line in enumerate(lines) if line.startswith("FROM")] + [len(lines)]
    return [tuple(line.split(" ", 1)) for line in lines[starts[stage] : starts[stage + 1]]]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_steps_of_the_containerfile_make_a_server(tmp_path):
    """Its steps in a clean folder, as no container engine is here: COPY copies what git tracks, RUN runs."""
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    source, image = tmp_path / "src", tmp_path / "opt/isocharge"
    environment = {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin", "HOME": str(tmp_path)}
    environment |= {name: value for name, value in os.environ.items() if name.lower().startswith(("pip_", "https_"))}
    for instruction, words in steps(0):
        if instruction == "COPY":
            for name in words.split()[:-1]:
                for path in tracked:
                    if path == name or path.startswith(f"{name}/"):
                        (source / path).parent.mkdir(parents=True, exist_ok=True)
                        shutil.copy2(ROOT / path, source / path)
        elif instruction == "RUN":
            words = words.replace("/opt/isocharge", str(image))
            subprocess.run(["sh", "-ec", words], cwd=source, env=environment, check=True, timeout=600)
        else:
            assert instruction in ("FROM", "WORKDIR")
    packages = {path.name.split("-")[0].lower() for path in image.glob("lib/python3*/site-packages/*.dist-info")}
    assert {"isocharge", "onnxruntime", "uvloop", "prometheus_client"} <= packages
    assert not packages & {"pip", "torch", "scipy", "scikit_learn", "matplotlib", "onnx", "pytest"}
    shutil.rmtree(source)

    final = dict(steps(1))
    words = json.loads(final["ENTRYPOINT"]) + json.loads(final["CMD"])
    words = [word.replace("/opt/isocharge", str(image)) if word != "8000" else "0" for word in words]
    refused = subprocess.run(words, env=environment, cwd="/", capture_output=True, text=True, timeout=60, check=False)
    assert (refused.returncode, "--token" in refused.stderr) == (2, True)
    with running(words, env=environment | {"ISOCHARGE_TOKEN": "yes"}, cwd="/") as (_, url):
        url = url.replace("0.0.0.0", "127.0.0.1")
        health = json.loads(final["HEALTHCHECK"].removeprefix("CMD "))
        health = [word.replace("/opt/isocharge", str(image)).replace("http://127.0.0.1:8000", url) for word in health]
        assert subprocess.run(health, env=environment, timeout=60, check=False).returncode == 0
        assert status_of(f"{url}/v2/models/four-25um-biaxial", "yes") == 200
        assert status_of(f"{url}/v2/models/four-25um-biaxial") == 401
    assert subprocess.run(health, env=environment, stderr=subprocess.DEVNULL, timeout=60, check=False).returncode != 0
