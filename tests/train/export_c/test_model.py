"""The network in C against onnxruntime: on presses, at the corners, in several compilers, with sanitizers."""

import itertools
import subprocess

import numpy as np
import pytest

from isocharge.serve import find_model
from isocharge.serve.model.model_folder import load_model
from isocharge.simulate import Circle, Sweep, load_sensor, noise_model, solve_maps
from isocharge.train.data.noise import noisy_charges
from isocharge.train.data.presses import LabelledPresses

FLOORS = np.array([1.0, 1.0, 0.1, 1.0, 1.0, 0.1, 20.0])
"""mm and N, and the floor that golden vectors have for the misfit."""

MODELS = (
    "three-25um-biaxial",
    "four-25um-biaxial",
    "four-25um-uniaxial-films",
    "three-25um-biaxial-student",
    "four-25um-biaxial-student",
)


def answers(model, charge_pC):
    """What onnxruntime answers, shape (n, 7), one press at a time as a host program asks."""
    session = load_model(find_model(model)).session
    return np.array([np.concatenate(session.run(None, {"charge_pC": row[np.newaxis]}), axis=1)[0] for row in charge_pC])


def apart(mine, theirs):
    """Largest difference of each column, relative to max(|b|, floor)."""
    return np.max(np.abs(mine - theirs) / np.maximum(np.abs(theirs), FLOORS), axis=0)


@pytest.fixture(scope="module")
def compiled(build):
    libraries = {}

    def get(model):
        if model not in libraries:
            libraries[model] = build(model)
        return libraries[model]

    return get


def presses(model, count, seed):
    """Noisy charges of presses in the whole working area, float32, shape (count, electrodes), pC."""
    metadata = load_model(find_model(model)).metadata
    radius = min(np.hypot(*np.array(metadata.working_area_mm).T).min(), 8.0) * 0.998
    film = solve_maps(load_sensor(metadata.frame_id), (Circle(1e-3),), Sweep())[0]
    rng = np.random.default_rng(seed)
    r, angle = radius * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    low, high = metadata.force_range_N
    contact = np.column_stack([r * np.cos(angle), r * np.sin(angle), low * (high / low) ** rng.random(count)])
    charge_pC = 1e12 * film.forward(1e-3 * contact[:, 0], 1e-3 * contact[:, 1], contact[:, 2])
    return noisy_charges(LabelledPresses(contact, charge_pC), noise_model("reference"), seed).astype(np.float32)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("model", ["three-25um-biaxial", "four-25um-biaxial"])
def test_ten_thousand_presses_agree_with_onnxruntime(model, compiled):
    charge_pC = presses(model, 10_000, seed=0)
    assert np.all(apart(compiled(model).predict(charge_pC), answers(model, charge_pC)) <= 1e-5)


@pytest.mark.parametrize("model", MODELS)
def test_golden_vectors_agree(model, compiled):
    golden = load_model(find_model(model)).golden
    expected = np.concatenate(list(golden.outputs.values()), axis=1)
    assert np.all(apart(compiled(model).predict(golden.charge_pC), expected) <= 1e-5)


@pytest.mark.parametrize("model", MODELS)
def test_corners_are_finite_and_those_of_onnxruntime(model, compiled):
    """Zeros, negative and huge charges, denormal numbers and infinities; the misfit there is the sinh of tens."""
    exported = compiled(model)
    values = (0.0, -1.0, -3e38, 1e-45, 1.0, 800.0, 1e6, 3e38, np.inf, -np.inf)
    corners = np.array(list(itertools.product(values, repeat=exported.electrodes)), np.float32)[::7]
    mine, theirs = exported.predict(corners), answers(model, corners)
    assert np.isfinite(mine).all()
    # The logarithms go far beyond any press there, and with them the exponentials: 4e-7 in tanh are 1e-4 here.
    assert np.all(apart(mine, theirs) <= 1e-3)


@pytest.mark.parametrize("model", MODELS)
def test_nan_gives_nan_as_in_onnxruntime(model, compiled):
    exported = compiled(model)
    charge_pC = np.full((exported.electrodes + 1, exported.electrodes), 800.0, np.float32)
    charge_pC[np.arange(exported.electrodes), np.arange(exported.electrodes)] = np.nan
    mine, theirs = exported.predict(charge_pC), answers(model, charge_pC)
    np.testing.assert_array_equal(np.isnan(mine), np.isnan(theirs))
    assert np.isnan(mine[:-1]).all()
    assert np.isfinite(mine[-1]).all()


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize(
    "options",
    [
        ("-O2",),
        ("-O3", "-march=native", "-ffp-contract=fast"),
        ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
    ],
    ids=lambda options: options[-1],
)
def test_self_test_passes_in_strict_c99(compiler, options, exports, compile_c):
    for folder in exports:
        program = compile_c(
            compiler,
            folder,
            folder / f"self_test_{compiler}",
            "self_test.c",
            "isocharge_model.c",
            options=options,
        )
        done = subprocess.run([program], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "64 golden vectors, 0 wrong numbers" in done.stdout


def test_self_test_fails_if_a_weight_is_changed(exports, compile_c, tmp_path):
    folder = exports[0]
    source = (folder / "isocharge_model.c").read_text()
    begin = source.index("layer_1_weights_0[")
    changed = source[:begin] + source[begin:].replace("{\n    ", "{\n    1.0f + ", 1)
    (tmp_path / "changed.c").write_text(changed)
    program = compile_c("gcc", folder, tmp_path / "self_test", "self_test.c", tmp_path / "changed.c")
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "expected" in done.stdout


def test_tanh_is_within_what_it_says(exports, compile_c, tmp_path):
    """Against tanh in double precision, on a million numbers from 1e-8 to 20, their negatives, and ends."""
    functions = (exports[0] / "isocharge_model.c").read_text()
    begin, end = functions.index("/* tanh within 4e-7"), functions.index("/* A number within")
    (tmp_path / "tanh.c").write_text(
        "#include <math.h>\n#include <stdio.h>\n"
        + functions[begin:end]
        + """
int main(void)
{
    double worst = 0;
    for (int k = 0; k <= 1000000; ++k) {
        const float x = (float)pow(10.0, -8.0 + 9.3 * k / 1e6);
        const double apart = fmax(fabs((double)tanh_of(x) - tanh(x)), fabs((double)tanh_of(-x) - tanh(-x)));
        worst = apart > worst ? apart : worst;
    }
    printf("%g %g %g %g %g\\n", worst, (double)tanh_of(INFINITY), (double)tanh_of(-INFINITY), (double)tanh_of(0.0f),
           (double)tanh_of(NAN));
    return 0;
}
"""
    )
    program = compile_c("gcc", exports[0], tmp_path / "tanh", tmp_path / "tanh.c")
    worst, *ends, not_a_number = map(float, subprocess.check_output([program], text=True).split())
    assert 0.0 < worst <= 4e-7
    assert ends == [1.0, -1.0, 0.0]
    assert np.isnan(not_a_number)


def test_no_memory_is_allocated_and_nothing_but_math_h_is_used(exports, compile_c, tmp_path):
    """Undefined names in the object file are the float functions of the C library; nothing in it can be written."""
    for folder in exports:
        compile_c("gcc", folder, tmp_path / "model.o", "isocharge_model.c", options=("-O2", "-c"))
        symbols = subprocess.check_output(["nm", tmp_path / "model.o"], text=True).splitlines()
        needed = {line.split()[-1] for line in symbols if " U " in line}
        assert needed <= {"logf", "log1pf", "expf", "sinhf", "sqrtf", "memset", "memcpy", "__stack_chk_fail"}, needed
        assert not [line for line in symbols if " d " in line.lower() or " b " in line.lower()]
