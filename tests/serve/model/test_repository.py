"""Models are found by name, version and path, in the documented order."""

from pathlib import Path

import pytest

from isocharge.common.errors import ModelError
from isocharge.serve import find_model
from isocharge.serve.model.repository import model_names


@pytest.fixture
def roots(tmp_path, monkeypatch):
    """Three repositories - given, from the environment, of the working folder - and nothing shipped."""
    given, variable, current = (tmp_path / name for name in ("given", "variable", "work/models"))
    monkeypatch.setenv("ISOCHARGE_MODELS", str(variable))
    current.mkdir(parents=True)
    given.mkdir()
    monkeypatch.chdir(current.parent)
    monkeypatch.setattr("isocharge.serve.model.repository._shipped", lambda: tmp_path / "shipped")
    return {"given": given, "variable": variable, "current": current, "shipped": tmp_path / "shipped"}


def put(root: Path, name: str = "m", version: str = "1") -> Path:
    folder = root / name / version
    folder.mkdir(parents=True)
    (folder / "model.onnx").touch()
    return folder.resolve()


def test_first_repository_wins(roots):
    first = []
    for name in ("shipped", "current", "variable", "given"):
        put(roots[name])
        first.append(find_model("m", roots["given"]).resolve().parents[1])
    assert first == [roots[name].resolve() for name in ("shipped", "current", "variable", "given")]


def test_highest_version_is_by_number(roots):
    for version in ("1", "10", "9", "011", "draft", ".11.abcd"):
        put(roots["given"], version=version)
    assert find_model("m", roots["given"]).name == "10"
    assert find_model("m/1", roots["given"]).name == "1"


def test_path_of_every_kind(roots):
    folder = put(roots["given"])
    for path in (folder.parent, folder, folder / "model.onnx"):
        assert find_model(path) == find_model(str(path)) == folder


def test_path_beside_us_is_found_when_no_model_has_the_name(roots):
    folder = put(roots["current"].parent, "mine")
    assert find_model("mine").resolve() == folder
    shadow = put(roots["current"], "mine")
    assert find_model("mine").resolve() == shadow
    assert find_model("./mine").resolve() == folder
    assert find_model(Path("mine")).resolve() == folder


def test_what_is_no_model_is_ignored(roots):
    put(roots["given"])
    (roots["given"] / "README.md").touch()
    (roots["given"] / "notes").mkdir()
    assert model_names(roots["given"]) == ["m"]


def test_missing_name_says_where_and_what(roots):
    put(roots["given"], "three")
    with pytest.raises(ModelError) as caught:
        find_model("four", roots["given"])
    message = str(caught.value)
    assert "no model 'four'" in message
    assert f"{roots['given']} (three)" in message
    assert f"{roots['variable']} (no models)" in message


def test_missing_path_says_what_was_expected(roots):
    with pytest.raises(ModelError, match=r"nowhere/model.onnx: no model; expected a model folder"):
        find_model("nowhere/model.onnx", roots["given"])


def test_repository_that_was_named_must_be_there(roots):
    put(roots["current"])
    with pytest.raises(ModelError, match="nope: expected a folder of models"):
        find_model("m", roots["given"] / "nope")
