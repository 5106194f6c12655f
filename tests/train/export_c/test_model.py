"""The C source of a model: several compilers, sanitizers, a changed weight, and the functions that it needs."""

import numpy as np
import pytest
from tests.train.random_networks import random_network, write_random_model

from isocharge.serve import find_model, load_model
from isocharge.serve.model.contact import Contacts, Validity
from isocharge.serve.model.model_folder import model_names
from isocharge.train.export_c.folder import export_c
from isocharge.train.export_c.model_source import FLAG_BITS
from processes import finished


@pytest.fixture
def run_self_test(compile_c, tmp_path):
    """Function that compiles and runs the self test of an export, and returns the exit code and the stdout."""

    def run(folder, compiler="gcc", model="isocharge_model.c", options=("-O0",)):
        program = compile_c(compiler, folder, tmp_path / "self_test", "self_test.c", model, options=options)
        done = finished([program])
        return done.returncode, done.stdout

    return run


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize(
    "options",
    [
        ("-O2",),
        ("-O3", "-march=native", "-ffp-contract=fast"),
        ("-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
    ],
)
def test_self_test_passes_in_strict_c99(compiler, options, exports, run_self_test):
    code, printed = run_self_test(exports[compiler == "clang"], compiler, options=options)
    assert code == 0, printed
    assert " golden vectors, 0 wrong numbers" in printed


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("name", model_names(find_model("four-25um-biaxial").parents[1]))
def test_self_test_of_each_released_model_passes(name, run_self_test, tmp_path):
    code, printed = run_self_test(export_c(find_model(name), tmp_path / "export"))
    assert code == 0, printed


def test_self_test_fails_if_a_weight_is_changed(exports, run_self_test, tmp_path):
    source = (exports[0] / "isocharge_model.c").read_text()
    begin = source.index("contact_1_weights[")
    (tmp_path / "changed.c").write_text(source[:begin] + source[begin:].replace("{\n    ", "{\n    1.0f + ", 1))
    code, printed = run_self_test(exports[0], model=tmp_path / "changed.c")
    assert code == 1
    assert "expected" in printed


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"yield_force_N": None},
        {"working_area_mm": ((2.0, 1.0), (9.0, 2.0), (8.0, 7.0), (5.0, 3.0), (3.0, 8.0))},  # beside the centre
        {"errors": {"misfit_p999": 7.0}},
    ],
)
def test_flags_in_c_are_those_of_python(changes, build, tmp_path):
    model = write_random_model(tmp_path / "limits", random_network(4, (4, 4), (4, 4)), **changes)
    random = np.random.default_rng(0)
    contacts = np.zeros((3000, 10), np.float32)
    contacts[:, :2] = random.normal(0.0, 12.0, (3000, 2))
    contacts[:, 2] = random.exponential(1.5, 3000)
    contacts[:, 6] = random.exponential(2.5, 3000)
    contacts[0] = np.nan
    contacts[1, :3] = 1e30
    expected = Validity.of(load_model(model).metadata).batch_flags(Contacts(*contacts.T))
    flags = build(model).flags(contacts[:, :7])
    assert flags.tolist() == [sum(FLAG_BITS[word] for word in words) for words in expected]
    assert {word for words in expected for word in words} >= set(FLAG_BITS) - {"stress"}


TANH_TEST = """
int main(void)
{
    double worst = 0;
    for (int k = 0; k <= 1000000; ++k) {
        const float x = (float)pow(10.0, -8.0 + 9.3 * k / 1e6);
        const double error = fmax(fabs((double)tanh_of(x) - tanh(x)), fabs((double)tanh_of(-x) - tanh(-x)));
        worst = error > worst ? error : worst;
    }
    printf("%g %g %g %g %g\\n", worst, (double)tanh_of(INFINITY), (double)tanh_of(-INFINITY), (double)tanh_of(0.0f),
           (double)tanh_of(NAN));
    return 0;
}
"""


def test_tanh_has_the_stated_error(exports, compile_c, tmp_path):
    """Against tanh in double precision, on a million numbers from 1e-8 to 20, their negatives, and the limits."""
    source = (exports[0] / "isocharge_model.c").read_text()
    begin = source.index("static float tanh_of")
    tanh = source[begin : source.index("\n}\n", begin) + 3]
    (tmp_path / "tanh.c").write_text(f"#include <math.h>\n#include <stdio.h>\n{tanh}{TANH_TEST}")
    program = compile_c("gcc", exports[0], tmp_path / "tanh", tmp_path / "tanh.c")
    worst, *limits, not_a_number = map(float, finished([program]).stdout.split())
    assert 0.0 < worst <= 4e-7
    assert limits == [1.0, -1.0, 0.0]
    assert np.isnan(not_a_number)


def test_no_memory_is_allocated_and_nothing_but_math_h_is_used(exports, compile_c, tmp_path):
    """The object file only refers to float functions of the C library, and it has no writable data."""
    compile_c("gcc", exports[0], tmp_path / "model.o", "isocharge_model.c", options=("-O2", "-c"))
    symbols = finished(["nm", tmp_path / "model.o"]).stdout.splitlines()
    needed = {line.split()[-1] for line in symbols if " U " in line}
    assert needed <= {"logf", "log1pf", "expf", "sinhf", "sqrtf", "cosf", "memset", "memcpy", "__stack_chk_fail"}, (
        needed
    )
    assert not [line for line in symbols if " d " in line.lower() or " b " in line.lower()]
