"""Fixtures and hooks that the tests of several packages share."""

import gc
import os
import re
import signal
import subprocess
import sys
import zlib
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import settings

from extras import PACKAGES
from isocharge.cli.main import main
from processes import finished
from whole_films import whole_film_map_solved_once, yield_force_solved_once

ROOT = Path(__file__).parents[1]

LONGEST = (
    "tests/train",
    "tests/cli",
    "tests/serve/test_pages",
    "tests/serve/viewer",
    "tests/test_pages",
    "tests/test_examples",
    "tests/test_flags",
    "tests/test_pip",
)
"""Folders and files with the longest tests, which begin first."""

settings.register_profile("patient", deadline=None)  # an example may take long on a busy machine
settings.register_profile("quick", settings.get_profile("patient"), max_examples=50)

gc.disable()  # imports and the collection of the tests create no garbage, so the collector would only cost time

# A shell starts background processes with SIGINT ignored, and the commands that tests start would inherit this.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config):
    """Test properties with half of the usual number of random examples if slow tests are not run."""
    is_quick = config.getoption("markexpr") == "not slow"
    settings.load_profile("quick" if is_quick else "patient")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark all but the first n cases of a test with `first_cases(n)` as slow, before slow tests are deselected.

    The files that take longest begin first. Otherwise, one worker could still run such a file when all other workers
    have finished. The other files are shuffled, because files that wait for a clock or a process are neighbours: if all
    workers waited at the same time, the processors would be idle. The order is the same in every run.
    """
    items.sort(key=_starting_order)
    seen = Counter()
    for item in items:
        if marker := item.get_closest_marker("first_cases"):
            test = item.nodeid.partition("[")[0]
            seen[test] += 1
            if seen[test] > marker.args[0]:
                item.add_marker(pytest.mark.slow)
    gc.freeze()
    gc.enable()


def _starting_order(item):
    """Return the key by which the tests are sorted, which is equal for all tests of a file."""
    path = item.path.relative_to(ROOT).as_posix()
    starts_late = not path.startswith(LONGEST)
    return starts_late, zlib.crc32(path.encode()), path


@pytest.fixture(scope="session", autouse=True)
def few_solves():
    """Compare each forward map with four direct solves instead of ten when it is built, and solve each film once.

    The tests build many maps. The tests of the forward map compare it with further direct solves. The coarse map of a
    whole film is solved once for all sweeps and all mirror regions of this film, and so is its yield force.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("isocharge.simulate.forward.forward_map.CHECK_COUNT", 4)
        for module in ("dataset.sweep", "identifiability.mirror_region"):
            patch.setattr(f"isocharge.simulate.{module}.whole_film_map", whole_film_map_solved_once)
        patch.setattr("isocharge.simulate.dataset.sweep.yield_force", yield_force_solved_once)
        yield


@pytest.fixture
def command(monkeypatch, capfd):
    """Function that runs `isocharge ...` in this process and returns (exit code, stdout, stderr)."""
    monkeypatch.setenv("COLUMNS", "100")  # the width of the terminal decides how tables are printed

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["isocharge", *map(str, words)])
        with pytest.raises(SystemExit) as done:
            main()
        out, err = capfd.readouterr()
        return int(done.value.code or 0), out, err

    return run


@pytest.fixture
def refused(command):
    """Function that runs `isocharge ...` and checks that the command refuses its input.

    The command must end with the given exit code, write nothing to stdout, and write the message to stderr, without a
    traceback. Line breaks in stderr are ignored.
    """

    def run(*words, message, code=2):
        got, out, err = command(*words)
        assert (got, out, "Traceback" in err) == (code, "", False), err
        assert message in " ".join(err.split())

    return run


@pytest.fixture
def start_command():
    """Function that starts `isocharge ...` in a new process. The process is killed at the end of the test."""
    started = []

    def start(*words, program=("-m", "isocharge.cli")):
        process = subprocess.Popen(
            [sys.executable, *program, *map(str, words)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


ABSENT = """
import os, sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in os.environ["ABSENT_PACKAGES"].split():
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
"""
"""Python code that runs at the start of Python and makes the packages of `ABSENT_PACKAGES` impossible to import."""


@pytest.fixture(scope="session")
def installed(tmp_path_factory):
    """Function that returns the environment variables for an installation with some extras, `pip install '.[x]'`.

    Programs that run with these variables cannot import the packages of the other extras of pyproject.toml.
    """
    folder = tmp_path_factory.mktemp("absent")
    (folder / "sitecustomize.py").write_text(ABSENT)

    def environment(*extras):
        chosen = [*PACKAGES] if "all" in extras else extras
        present = set().union(*(PACKAGES.get(extra, set()) for extra in chosen))
        absent = set().union(*PACKAGES.values()) - present
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"  # this environment's `isocharge` first
        search = f"{folder}:{os.environ.get('PYTHONPATH', '')}"
        return os.environ | {
            "PATH": path,
            "COLUMNS": "100",
            "PYTHONPATH": search,
            "ABSENT_PACKAGES": " ".join(sorted(absent)),
        }

    return environment


@pytest.fixture
def run_example():
    """Function that runs a Python example of a page.

    Each print must print exactly the text of the comment on its line.
    """

    def run(example, folder, environment):
        done = finished([sys.executable, "-c", example], cwd=folder, env=environment, timeout=3600)
        prints = [line for line in example.splitlines() if line.lstrip().startswith("print(")]
        expected = [line.rpartition(")  # ")[2] for line in prints]
        assert expected
        assert done.returncode == 0, done.stderr
        assert done.stdout.splitlines() == expected
        assert "np.float" not in done.stdout

    return run


@pytest.fixture
def run_commands():
    """Function that runs a shell example of a page in a folder and returns its stdout.

    Its background processes end with it. The files that its options name as output must exist afterwards.
    """

    def run(example, folder, environment, timeout=280):
        script = f"trap 'kill $(jobs -p) || true; wait' EXIT\n{example}"
        done = finished(["bash", "-ec", script], cwd=folder, env=environment, timeout=timeout)
        assert done.returncode == 0, done.stderr
        for output in re.findall(r" (?:-o|--record|>) ([\w./-]+)", example):
            assert (folder / output).exists(), output
        return done.stdout

    return run


class PageExample(NamedTuple):
    """A block of Python or shell code on a page. The blocks of a page run in their order, in one folder.

    Attributes:
        page: Path of the page in the project.
        language: "python" or "sh".
        text: Text of the block.
        extras: Extras that are installed; ("base",) for an installation without extras. They are read from the command
            `pip install '.[extra]'` in the section before the block. Without such a command, they are read from the
            first lines of the page, or else from the first lines of the README of its package.
    """

    page: str
    language: str
    text: str
    extras: tuple[str, ...]


def pytest_generate_tests(metafunc):
    """Run a test with an argument `page_example` once for each block of the pages in EXAMPLE_PAGES of its module.

    The function `is_slow` of the module determines which blocks are marked as slow.
    """
    if "page_example" in metafunc.fixturenames:
        module, parameters = metafunc.module, []
        for page in module.EXAMPLE_PAGES:
            for number, example in enumerate(examples_of(ROOT / page)):
                slow = [pytest.mark.slow, pytest.mark.timeout(3600)] if module.is_slow(example) else []
                parameters.append(pytest.param(example, id=f"{page}-{number}-{example.language}", marks=slow))
        metafunc.parametrize("page_example", parameters)


def examples_of(page):
    """Return the examples of a page, in their order."""
    text = page.read_text("utf-8")
    readme = page.parent / "README.md" if page.parent.name != "docs" else page.parents[1] / "README.md"
    general = _extras(_opening(text)) or _extras(_opening(readme.read_text("utf-8"))) or ("base",)
    blocks = list(re.finditer(r"^```(\w+)\n(.*?)^```", text, re.DOTALL | re.MULTILINE))
    ends = [0, *(block.end() for block in blocks)]
    return [
        PageExample(
            page.relative_to(ROOT).as_posix(),
            block[1],
            block[2],
            _extras(text[end : block.start()].rpartition("\n#")[2]) or general,
        )
        for end, block in zip(ends, blocks, strict=False)
        if block[1] in ("python", "sh")
    ]


def _opening(text):
    """Return the text above the first example and the first section."""
    return re.split(r"^(?:```|## )", text, maxsplit=1, flags=re.MULTILINE)[0]


def _extras(text):
    """Return the extras of the first install command in a text.

    Returns:
        The extras; ("base",) if the command names none; () if the text contains no install command.
    """
    command = re.search(r"pip install (?:'\.\[([\w,]+)\]'|\.(?=[`\s]))", text)
    return () if command is None else tuple((command[1] or "base").split(","))
