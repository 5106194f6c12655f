"""What serve/deploy ships: units, images, manifests and hosts, each tried as far as this machine allows."""

import ctypes
import importlib.util
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

import pytest
import yaml

from isocharge.serve import find_model
from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol import Handler

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "serve/deploy"
UNIT = DEPLOY / "systemd/isocharge.service"
ENVIRONMENTS = Path(os.environ.get("ISOCHARGE_BENCH_ENVIRONMENTS", ROOT / "build/bench-environments"))
MODELS = find_model("three-25um-biaxial").parents[1]
PR_SET_NO_NEW_PRIVS, PR_SET_MDWE = 38, 65


def script(path):
    """A script of serve/deploy as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def check_host():
    return script(DEPLOY / "check_host.py")


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


def test_our_answers_are_right_for_a_stock_client(check_host, start_http):
    url = start_http(Handler(open_model_store(MODELS))).url.removeprefix("http://")
    report = check_host.check(url, MODELS, 0.2, 2)
    assert set(report["difference_over_tolerance"]) == {path.parents[1].name for path in MODELS.glob("*/1/golden.json")}
    assert check_host.is_right(report)
    assert report["not_served"] == []
    assert 0 < report["p50_us"] <= report["p99_us"]


def test_a_wrong_answer_and_a_missing_model_are_noticed(check_host, film, start_http, tmp_path, monkeypatch, capsys):
    folder = film.write(tmp_path / "models")
    url = start_http(Handler(open_model_store(tmp_path / "models"))).url.removeprefix("http://")
    monkeypatch.setattr(sys, "argv", ["check_host.py", url, "--models", str(tmp_path / "models"), "--seconds", "0.1"])
    check_host.main()
    golden = json.loads((folder / "golden.json").read_text())
    golden["outputs"]["contact"][3][2] *= 1.0001
    (folder / "golden.json").write_text(json.dumps(golden))
    with pytest.raises(SystemExit) as done:
        check_host.main()
    assert done.value.code == 1
    shutil.copytree(tmp_path / "models/linear", tmp_path / "models/cubic")
    with pytest.raises(SystemExit):
        check_host.main()
    assert "not_served                 ['cubic']" in capsys.readouterr().out


def test_settings_of_mlserver_name_the_models_as_they_stand(tmp_path):
    start = script(DEPLOY / "mlserver/start.py")
    folder = start.write_settings(tmp_path, MODELS, "127.0.0.1", 8080)
    settings = [json.loads(path.read_text()) for path in sorted(folder.glob("*/model-settings.json"))]
    assert [of["name"] for of in settings] == sorted(path.name for path in MODELS.iterdir() if path.is_dir())
    assert all(Path(of["parameters"]["uri"]).is_file() for of in settings)


@pytest.mark.slow
@pytest.mark.parametrize("host", ["triton", "mlserver"])
def test_another_host_serves_the_models_as_they_stand(check_host, host, monkeypatch):
    """The stock tritonserver and MLServer, the folder of models untouched, the same script as for ours."""
    if not (ENVIRONMENTS / host / "done").exists():
        pytest.skip(f"no environment {ENVIRONMENTS / host}: tests/benchmarks/bench_http.py makes it")
    monkeypatch.syspath_prepend(str(ROOT / "tests/benchmarks"))
    bench_http = __import__("bench_http")
    before = {path: path.stat().st_mtime_ns for path in MODELS.rglob("*")}
    address = ("127.0.0.1", bench_http.free_port())
    python = bench_http.python_of(host, ENVIRONMENTS)
    with bench_http.running([python, DEPLOY / host / "start.py", MODELS, "--port", str(address[1])], address):
        report = check_host.check("{}:{}".format(*address), MODELS, 0.5, 2)
    assert report["not_served"] == []
    assert check_host.is_right(report)
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


def test_the_manifest_does_not_start_without_its_token(predictor_of_kserve, models):
    (container,) = predictor_of_kserve["containers"]
    environment = {name: value for name, value in os.environ.items() if name != "ISOCHARGE_TOKEN"}
    words = [sys.executable, "-m", "isocharge.cli", *container["args"], "--models", str(models)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "lets other machines in" in done.stderr


def test_every_manifest_is_one():
    for path in (DEPLOY / "kserve").glob("*.yaml"):
        manifest = yaml.safe_load(path.read_text())
        assert (manifest["apiVersion"], manifest["kind"]) == ("serving.kserve.io/v1beta1", "InferenceService")
        predictor = manifest["spec"]["predictor"]
        assert 1 < predictor["minReplicas"] < predictor["maxReplicas"]


# Containers


def steps(stage):
    """Instructions of one stage of the Containerfile, with their arguments."""
    text = (DEPLOY / "Containerfile").read_text()
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    starts = [number for number, line in enumerate(lines) if line.startswith("FROM")] + [len(lines)]
    return [tuple(line.split(" ", 1)) for line in lines[starts[stage] : starts[stage + 1]]]


def test_the_image_copies_files_that_are_tracked_only_by_name():
    copied = [word for name, words in steps(0) if name == "COPY" for word in words.split()[:-1]]
    assert all((ROOT / word).exists() for word in copied)
    named = dict(steps(1))
    assert named["USER"] == "65534:65534"
    assert json.loads(named["ENTRYPOINT"]) == ["/opt/isocharge/bin/isocharge"]


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
    assert {"isocharge", "onnxruntime", "uvicorn", "prometheus_client"} <= packages
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
