"""Configurations of short trainings."""

from isocharge.train import FitConfig, NetworkConfig, TrainingConfig


def short_training(width, misfit_width, steps, misfit_steps, misfit_charges):
    """Return the configuration of a training of two perceptrons with two hidden layers of given widths."""
    return FitConfig(
        network=NetworkConfig(hidden=(width, width), misfit_hidden=(misfit_width, misfit_width)),
        training=TrainingConfig(steps=steps, misfit_steps=misfit_steps, misfit_charges=misfit_charges, batch=256),
    )
