"""What README.md and the pages show is true: every example runs and prints what it says, links lead somewhere."""

import re
from pathlib import Path

import pytest

from isocharge.simulate import Circle, Sweep, load_sensor, run_sweep

ROOT = Path(__file__).parents[1]
FOLDERS = ("simulate", "train", "serve")
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text("utf-8")
    for folder in (".", "models", *FOLDERS, *(f"{folder}/docs" for folder in FOLDERS))
    for path in sorted((ROOT / folder).glob("*.md"))
}
LONGEST_README, LONGEST_PAGE = 120, 200
"""Lines."""

SLOW = {
    "simulate design",
    "simulate paper",
    "simulate identify",
    "simulate curves",
    "--orientation random",
    "train report",
    "bayes_limit",
}
"""What takes an example more than a few seconds."""

SMALLER = {"--samples 100000": "--samples 500"}
"""Figures of an example that would take a test too long."""


def examples(language):
    """Examples of the pages outside serve, whose tests use ports, with the page as id; the slow ones marked."""
    for page, text in PAGES.items():
        for number, block in enumerate(re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)):
            if not page.startswith("serve/") and page != "CONTRIBUTING.md":  # tests/serve, tests/test_contributing.py
                slow = [pytest.mark.slow, pytest.mark.timeout(3600)] if any(key in block for key in SLOW) else []
                yield pytest.param(page, block, id=f"{page}-{number}", marks=slow)


@pytest.fixture(scope="module")
def presses(tmp_path_factory):
    """A dataset for the examples that begin with one."""
    folder = tmp_path_factory.mktemp("data") / "presses"
    return run_sweep(folder, load_sensor("three-25um-biaxial"), (Circle(1e-3),), Sweep(samples=2000))


@pytest.fixture
def desk(tmp_path, presses, monkeypatch):
    """An empty folder with the files that examples read: `train/configs`, and `presses` unless they are made there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ISOCHARGE_CACHE", str(tmp_path / "cache"))
    (tmp_path / "train").symlink_to(ROOT / "train")
    (tmp_path / "quick.toml").write_text("[training]\nsteps = 50\nmisfit_steps = 20\nmisfit_charges = 2000\n")

    def lay_out(example):
        if not re.search(r'-o presses\b|Path\("presses"\), load_sensor', example):
            (tmp_path / "presses").symlink_to(presses)
        return tmp_path

    return lay_out


@pytest.mark.parametrize(("page", "example"), [*examples("python")])
def test_python_example_prints_what_it_says(page, example, desk, run_example):
    desk(example)
    run_example(example, page)


@pytest.mark.parametrize(("page", "example"), [*examples("sh")])
def test_commands_run_line_by_line(page, example, desk, run_commands):
    for shown, smaller in SMALLER.items():
        example = example.replace(shown, smaller)
    printed = run_commands(example, desk(example), timeout=3600)
    if page == "README.md" and "simulate point" in example:
        assert '"charge_pC"' in printed
        assert printed.count('"frame_id": "three-25um-biaxial"') > 800  # 5 s at 200 Hz


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", PAGES[page]):
        assert target.startswith("http") or (ROOT / page).parent.joinpath(target).exists(), target


@pytest.mark.parametrize("page", PAGES)
def test_files_that_are_named_exist(page):
    """A path in backticks is a file of the project, or one that the examples make."""
    for name in re.findall(r"`(?:python )?((?:tests|simulate|train|serve|models|isocharge)/[\w./-]+)", PAGES[page]):
        made = name.startswith(("models/NAME", "models/mine"))
        assert made or (ROOT / name).exists(), name


@pytest.mark.parametrize("page", PAGES)
def test_pages_are_short(page):
    lines = PAGES[page].splitlines()
    assert max(map(len, lines)) <= 120
    if page not in ("CHANGELOG.md", "CONTRIBUTING.md"):  # versions, and whole recipes in code
        assert len(lines) <= (LONGEST_README if page.endswith("README.md") else LONGEST_PAGE)


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_readme_shows_every_package_once(folder):
    """In its pictures, where packages stand apart by two blanks or more."""
    source = ROOT / folder / "isocharge" / folder
    packages = {".".join(path.parent.relative_to(source).parts) for path in source.rglob("*/__init__.py")}
    pictures = re.findall(r"^```text\n(.*?)^```", PAGES[f"{folder}/README.md"], re.DOTALL | re.MULTILINE)
    shown = [word for picture in pictures for word in re.split(r"\s{2,}|\n", picture)]
    assert {name: shown.count(name) for name in packages} == dict.fromkeys(packages, 1)


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_readme_links_every_page_of_its_folder(folder):
    for path in (ROOT / folder / "docs").glob("*.md"):
        assert f"(docs/{path.name})" in PAGES[f"{folder}/README.md"]


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_readme_names_every_command(folder):
    commands = {path.stem for path in (ROOT / "serve/isocharge/cli" / folder).glob("*.py")}
    commands -= {"__init__", "app", "options", "record_output"}
    assert set(re.findall(rf"\| `isocharge {folder} (\w+)` \|", PAGES[f"{folder}/README.md"])) == commands


def test_figures_of_the_released_models_are_their_cards():
    rows = re.findall(
        r"^\| `(\S+)` \| within (\S+) mm \| (\S+), (\S+) mm \| (\S+) % \|", PAGES["models/README.md"], re.M
    )
    assert len(rows) == 3
    for name, radius, median, rms, force in rows:
        card = (ROOT / "models" / name / "1" / "card.md").read_text("utf-8")
        assert f"within {radius} mm" in card
        patterns = (r"position, median \| (\S+) mm", r"position, rms \| (\S+) mm", r"force, rms \| (\S+) %")
        figures = [float(re.search(pattern, card)[1]) for pattern in patterns]
        assert figures == pytest.approx([float(median), float(rms), float(force)], abs=0.005, rel=0.01)


def test_figures_of_the_models_for_all_films_are_their_cards():
    rows = re.findall(
        r"^\| \[?`([\w-]+)`\S* \| (\S+) mm \| (\S+) mm, (\S+) % \| (\S+) mm, (\S+) % \|",
        PAGES["models/README.md"] + PAGES["train/docs/films.md"],
        re.M,
    )
    assert len(rows) == 6
    for name, radius, *figures in rows:
        card = (ROOT / "models" / name / "1" / "card.md").read_text("utf-8")
        assert f"within {radius} mm" in card
        position, force = (re.search(rf"{key}, rms \| (\S+) \S+ \| (\S+) ", card) for key in ("position", "force"))
        assert [position[1], force[1], position[2], force[2]] == figures
