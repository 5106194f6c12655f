"""The examples of README.md and of the pages run and print what their comments say, and all links have targets."""

import re

import pytest

from isocharge.simulate import Circle, ForwardMap, Sweep, load_sensor
from isocharge.simulate.dataset.sweep import write_sweep
from kept import ROOT, kept

FOLDERS = ("simulate", "train", "serve")
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text("utf-8")
    for folder in (".", "models", *FOLDERS, *(f"{folder}/docs" for folder in FOLDERS))
    for path in sorted((ROOT / folder).glob("*.md"))
}
SMALLER = {
    "--samples 100000": "--samples 500",
    "--radius 8 --force 0.05 2 --samples 6000": "--radius 3 --force 0.5 1 --samples 800",
    "--link film &": "--link film --force-max 0.05 &",
    "--count 2000": "--count 1000",
    "radius=10.0, force_range=(0.05, 2.0)": "radius=4.0, force_range=(1.0, 1.0)",
    "train/configs/quick.toml": "quick.toml",
}
"""Parts of examples that would take a test too long, and the shorter parts that the tests run in their place."""


QUICK = """
[network]
hidden = [24, 24]
misfit_hidden = [24, 24]
[training]
steps = 100
misfit_steps = 10
misfit_charges = 1000
"""

EXAMPLE_PAGES = [page for page in PAGES if not page.startswith(("serve/", "CONTRIBUTING", "CHANGELOG"))]
"""Pages whose examples run here. tests/serve runs those of serve, and tests/test_contributing.py the recipes."""

RESEARCH_TUTORIAL = "simulate/docs/tutorial.md"
"""Tutorial that goes from a press to records of a virtual sensor."""


SLOW = ("simulate identify", "train report", "examples/paper", "make paper", "train fit presses")
"""Parts of examples that take more than a few seconds."""


def is_slow(example):
    """Examples of the READMEs and of the tutorial run in `make test`, those of other pages in `make test-all`."""
    return not example.page.endswith(("README.md", RESEARCH_TUTORIAL)) or any(key in example.text for key in SLOW)


@pytest.fixture(scope="module")
def presses(tmp_path_factory):
    """A dataset for the examples that begin with one."""
    return write_sweep(
        tmp_path_factory.mktemp("data") / "presses",
        (kept(ForwardMap.build, load_sensor("three-25um-biaxial"), Circle(1.0)),),
        Sweep(samples=1000, outside=2000),
    )


@pytest.fixture(scope="module")
def desks(tmp_path_factory):
    """A folder for each page, with what its reader has already: a checkout's folders, and a small configuration."""
    folders = {page: tmp_path_factory.mktemp("desk") for page in EXAMPLE_PAGES}
    for folder in folders.values():
        for name in FOLDERS:
            (folder / name).symlink_to(ROOT / name)
        (folder / "quick.toml").write_text(QUICK)
    return folders


@pytest.fixture
def desk(page_example, desks, presses):
    """The folder of a page. It contains a dataset `presses` if the page reads a dataset that it does not create."""
    folder = desks[page_example.page]
    reads = re.search(r'(?:fit|report) presses\b|read_dataset\(Path\("presses"\)\)', page_example.text)
    makes = re.search(r'-o presses\b|Path\("presses"\), load_sensor', page_example.text)
    if reads and not makes and not (folder / "presses").exists():
        (folder / "presses").symlink_to(presses)
    return folder


def test_an_example_does_what_it_says(page_example, desk, installed, run_example, run_commands, train_in_this_process):
    """The examples run in the order of the page, with the extras that it names, and print what their comments say."""
    text, environment = page_example.text, installed(*page_example.extras)
    for shown, smaller in SMALLER.items():
        text = text.replace(shown, smaller)
    if "from isocharge.train import" in text:
        train_in_this_process(text, desk)
        return
    if page_example.language == "python":
        run_example(text, desk, environment)
        return
    printed = run_commands(text, desk, environment, timeout=3600)
    if page_example.page == RESEARCH_TUTORIAL and "simulate point" in text:
        assert '"charge_pC"' in printed


@pytest.fixture
def train_in_this_process(monkeypatch, capsys):
    """Run a Python example that trains, in this process.

    It must have one `print`, which prints what the comment on its line says.
    """

    def run(example, folder):
        monkeypatch.chdir(folder)
        exec(compile(example, "example", "exec"), {})
        (expected,) = re.findall(r"^print\(.*\)  # (.*)$", example, re.MULTILINE)
        assert capsys.readouterr().out == f"{expected}\n"

    return run


def anchors(text):
    """Return the anchors of the headings of a page, as GitHub and the site make them."""
    without_code = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.+)$", without_code, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_a_file_and_to_a_heading(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", PAGES[page]):
        if target.startswith("http"):
            continue
        name, _, anchor = target.partition("#")
        path = (ROOT / page).parent / name if name else ROOT / page
        assert path.exists(), target
        assert not anchor or anchor in anchors(path.read_text("utf-8")), target


def test_the_readme_is_short():
    """At most 80 words stand above the first code block, and about 600 words in all."""
    text = re.sub(r"\]\([^)]*\)", "]", PAGES["README.md"])
    words = [word for word in text.split() if re.search(r"\w", word)]
    assert len(text[: text.index("```")].split()) <= 80
    assert len(words) <= 650


SITE_CONTENTS = (ROOT / ".ci/docs/contents.md").read_text("utf-8")


@pytest.mark.parametrize("page", PAGES)
def test_every_page_is_in_the_contents_of_the_site(page):
    assert page == "README.md" or page.removesuffix(".md") in SITE_CONTENTS.split()


def test_figures_of_the_readme_are_on_the_pages_that_it_links_to():
    links = re.findall(r"\[(\d[^\]]*)\]\(([^)#]+\.md)\)", PAGES["README.md"])
    assert len(links) >= 5
    for text, page in links:
        for number, unit in re.findall(r"([\d.]+) (mm|%|us|ms)", text):
            further = r"( / [\d.]+)*"  # quantiles that share the unit
            assert re.search(rf"(?<![\d.]){number}{further} {unit}", (ROOT / page).read_text("utf-8")), (text, page)


def test_figures_of_the_released_models_are_their_cards():
    rows = re.findall(
        r"^\| `(\S+)` \| within (\S+) mm \| (\S+), (\S+) mm \| (\S+) % \|", PAGES["models/README.md"], re.M
    )
    assert len(rows) == 10
    for name, radius, median, rms, force in rows:
        card = (ROOT / "models" / name / "1/card.md").read_text("utf-8")
        assert f"within {radius} mm" in card
        patterns = (r"position, median \| (\S+) mm", r"position, rms \| (\S+) mm", r"force, rms \| (\S+) %")
        figures = [float(re.search(pattern, card)[1]) for pattern in patterns]
        assert figures == pytest.approx([float(median), float(rms), float(force)], abs=0.005, rel=0.01)
