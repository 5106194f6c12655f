"""A released model in a JavaScript runtime: onnxruntime's WebAssembly build, in node, gives the golden answers."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from isocharge.serve import find_model, load_model
from isocharge.serve.model.golden import check_answers
from isocharge.serve.model.model_folder import model_names
from isocharge.serve.model.session import OUTPUTS

MODELS = Path(__file__).parents[3] / "models"
PACKAGE = "onnxruntime-web@1"

WASM = 3e-5
"""Relative tolerance: the exponential of WebAssembly rounds otherwise where a deviation is 9 mm."""

SCRIPT = """
import { readFileSync } from "node:fs";
import * as ort from "onnxruntime-web";

ort.env.wasm.numThreads = 1;
const [model, golden] = process.argv.slice(2);
const charges = JSON.parse(readFileSync(golden)).inputs.charge_pC;
const session = await ort.InferenceSession.create(readFileSync(model), { executionProviders: ["wasm"] });
const input = new ort.Tensor("float32", charges.flat(), [charges.length, charges[0].length]);
const answers = await session.run({ charge_pC: input });
console.log(JSON.stringify(Object.fromEntries(
  Object.entries(answers).map(([name, tensor]) => [name, { dims: tensor.dims, data: Array.from(tensor.data) }]))));
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (shutil.which("node") and shutil.which("npm")), reason="node or npm is not installed"),
]


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = tmp_path_factory.mktemp("node")
    (folder / "package.json").write_text('{"type": "module", "private": true}')
    (folder / "answer.mjs").write_text(SCRIPT)
    install = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", PACKAGE]
    done = subprocess.run(install, cwd=folder, capture_output=True, text=True, timeout=240, check=False)
    if done.returncode:
        pytest.skip(f"npm cannot install {PACKAGE}: {done.stderr[-200:]}")
    return folder


@pytest.mark.parametrize("name", model_names(MODELS))
def test_node_gives_the_golden_answers(project, name):
    model = load_model(find_model(MODELS / name))
    command = ["node", "answer.mjs", model.folder / "model.onnx", model.folder / "golden.json"]
    done = subprocess.run(command, cwd=project, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    answers = {
        key: np.array(tensor["data"], dtype=np.float32).reshape(tensor["dims"])
        for key, tensor in json.loads(done.stdout).items()
    }
    assert set(answers) == set(OUTPUTS)
    check_answers(replace(model.golden, relative=WASM), answers, f"{name} in node")
