"""The training configuration and its file."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import ConfigError
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, load_config

CONFIGS = Path(__file__).parents[3] / "train" / "configs"


def write(folder, text):
    path = folder / "config.toml"
    path.write_text(text)
    return path


def test_the_default_file_states_the_defaults():
    assert load_config(CONFIGS / "default.toml") == FitConfig()


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_configurations_load(path):
    assert isinstance(load_config(path), FitConfig)


def test_keys_left_out_keep_their_defaults(tmp_path):
    config = load_config(write(tmp_path, "[training]\nsteps = 7\n"))
    assert config == FitConfig(NetworkConfig(), TrainingConfig(steps=7))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[trainig]\nsteps = 1\n", "unknown key 'trainig'"),
        ("[training]\nstep = 1\n", "unknown key 'training.step'"),
        ("[training]\nsteps = 0\n", "training.steps: expected a whole number from 1 to 10000000, got 0"),
        ("[training]\nsteps = 1.5\n", "training.steps: expected a whole number from 1 to 10000000, got 1.5"),
        ("[training]\nsteps = true\n", "training.steps: expected a whole number from 1 to 10000000, got True"),
        ("[training]\nlearning_rate = 2\n", "training.learning_rate: expected a number between 0 and 1, got 2"),
        ("[training]\nlearning_rate = nan\n", "training.learning_rate: expected a finite number, got nan"),
        ("[training]\nhold_out = 0.95\n", "training.hold_out: expected a number between 0 and 0.6, got 0.95"),
        ("[training]\nnoise = 3\n", "training.noise: expected a text, got 3"),
        ("[training]\nseed = -1\n", "training.seed: expected a whole number from 0"),
        ("[training]\nthreads = 100000\n", "training.threads: expected a whole number from 1 to 64"),
        ("[network]\nhidden = [true]\n", "network.hidden: expected widths"),
        ("[network]\nhidden = []\n", "network.hidden: expected widths"),
        ("[network]\nhidden = [64]\n", "as many layers as network.hidden"),
        ("[network]\nelectrodes = 2\n", "network.electrodes: expected 0 (as the dataset) or 3 to 64, got 2"),
        ("[network]\nweights = 'int4'\n", "network.weights: expected one of float32, int8, got 'int4'"),
        ("[training]\nfinish_steps = 5\n", "training.finish_steps: expected 0 with the noise 'reference'"),
        ("[training]\npatience = 0\n", "training.patience: expected a whole number from 1"),
        ("network = 3\n", "network: expected a table, got 3"),
        ("steps = \n", "not a TOML file"),
    ],
)
def test_wrong_files_are_refused_with_file_and_key(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "none.toml")


KNOWN = set(TrainingConfig.__dataclass_fields__)


@settings(derandomize=True, max_examples=50)
@given(st.from_regex(r"[a-z_]{1,12}", fullmatch=True).filter(lambda key: key not in KNOWN))
def test_any_unknown_key_is_named(tmp_path_factory, key):
    path = write(tmp_path_factory.mktemp("config"), f"[training]\n{key} = 1\n")
    with pytest.raises(ConfigError, match=f"unknown key 'training.{key}'"):
        load_config(path)
