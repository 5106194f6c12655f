"""The training configuration and its file."""

from pathlib import Path

import pytest

from isocharge.common.errors import ConfigError
from isocharge.simulate import NoiseModel
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, load_config

CONFIGS = Path(__file__).parents[3] / "train" / "configs"


def write(folder, text):
    path = folder / "config.toml"
    path.write_text(text)
    return path


def test_the_default_file_states_the_defaults():
    assert load_config(CONFIGS / "default.toml") == FitConfig()


def test_keys_left_out_keep_their_defaults(tmp_path):
    config = load_config(write(tmp_path, "[training]\nsteps = 7\n"))
    assert config == FitConfig(network=NetworkConfig(), training=TrainingConfig(steps=7))
    assert load_config(CONFIGS / "quick.toml").network == NetworkConfig()


def test_noise_of_ones_own():
    mine = NoiseModel("mine", 0.5, 1e-3)
    config = FitConfig(training=TrainingConfig(noise=mine))
    assert config.training.noise_model is mine
    assert config.checked() == config
    assert FitConfig().training.noise_model == NoiseModel("reference", 1.0, 2e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[trainig]\nsteps = 1\n", "unknown key 'trainig'"),
        ("[training]\nstep = 1\n", "unknown key 'training.step'"),
        ("[training]\nsteps = 0\n", "training.steps: expected a whole number from 1 to 10000000, got 0"),
        ("[training]\nsteps = 1.5\n", "training.steps: expected a whole number from 1 to 10000000, got 1.5"),
        ("[training]\nlearning_rate = 2\n", "training.learning_rate: expected a number between 0 and 1, got 2"),
        ("[training]\nlearning_rate = nan\n", "training.learning_rate: expected a number between 0 and 1, got nan"),
        ("[training]\nhold_out = 0.95\n", "training.hold_out: expected a number between 0 and 0.6, got 0.95"),
        ("[training]\nnoise = 3\n", "training.noise: expected a text, got 3"),
        ("[network]\nhidden = [true]\n", "network.hidden[1]: expected a whole number from 1 to 4096, got True"),
        ("[network]\nhidden = []\n", "network.hidden: expected widths"),
        ("[network]\nhidden = [64]\n", "as many layers as network.hidden"),
        ("[network]\nelectrodes = 2\n", "network.electrodes: expected 0 (as the dataset) or 3 to 64, got 2"),
        ("[network]\nweights = 'int4'\n", "network.weights: expected one of float32, int8, got 'int4'"),
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
