"""What README.md and train/README.md show is true: every example runs."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README, TRAIN = ((ROOT / name).read_text("utf-8") for name in ("README.md", "train/README.md"))


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


@pytest.mark.parametrize("example", blocks(README, "python"), ids=["charges to contact", "press to charges"])
def test_python_examples_print_what_they_promise(example, capsys):
    exec(compile(example, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    numbers = [float(number) for number in re.findall(r"-?\d+\.\d+", printed)]
    wanted = [3.0, -2.0, 1.0] if "Contact(" in printed else [942.9, 910.4, 690.8]
    assert numbers[:3] == pytest.approx(wanted, rel=0.02)


def test_command_line_example_runs_line_by_line(tmp_path, shell):
    (example,) = (block for block in blocks(README, "sh") if "simulate point" in block)
    (tmp_path / "train").symlink_to(ROOT / "train")
    printed = shell(example, cwd=tmp_path)
    assert '"charge_pC"' in printed
    assert printed.count('"frame_id": "three-25um-biaxial"') > 800  # 5 s at 200 Hz
    assert (tmp_path / "models/mine/1/model.onnx").is_file()


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_study_examples_run(tmp_path, shell):
    (example,) = (block for block in blocks(README, "sh") if "simulate paper" in block)
    sweep = "isocharge simulate sweep three-25um-biaxial --samples 3000 -o presses"
    shell(f"{sweep}\n{example}", cwd=tmp_path, timeout=3600)
    assert (tmp_path / "paper" / "paper.md").is_file()
    assert (tmp_path / "report" / "report.md").is_file()


def test_train_example_runs(tmp_path, monkeypatch, capsys):
    from isocharge.simulate import Circle, Sweep, load_sensor, run_sweep

    monkeypatch.chdir(tmp_path)
    run_sweep(Path("presses"), load_sensor("three-25um-biaxial"), (Circle(1e-3),), Sweep(samples=2000))
    Path("quick.toml").write_text("[training]\nsteps = 50\nmisfit_steps = 20\nmisfit_charges = 2000\n")
    (example,) = (block for block in blocks(TRAIN, "python") if "train_model" in block)
    exec(compile(example, "train/README.md", "exec"), {})
    assert "position_median_mm" in capsys.readouterr().out


@pytest.mark.slow
def test_bayes_limit_is_what_train_says(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ISOCHARGE_CACHE", str(tmp_path))
    (example,) = (block for block in blocks(TRAIN, "python") if "bayes_limit" in block)
    exec(compile(example, "train/README.md", "exec"), {})
    said = re.search(r"print\(bayes_limit.*# ([\d.]+)", example)
    assert f"{float(capsys.readouterr().out):.3f}" == said[1]


@pytest.mark.parametrize(
    "page", ["README.md", "train/README.md", "serve/README.md", "simulate/README.md", "models/README.md"]
)
def test_links_lead_somewhere(page):
    path = ROOT / page
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text("utf-8")):
        assert target.startswith("http") or (path.parent / target).exists(), target
