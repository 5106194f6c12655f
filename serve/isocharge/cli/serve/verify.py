"""`isocharge verify`: check whether a model folder is complete, unchanged, and correct on this machine."""

from dataclasses import asdict

import typer

from isocharge.cli.shared.options import JsonOption, ModelArgument, ModelsOption
from isocharge.cli.shared.terminal import show, show_json
from isocharge.serve.model.model_folder import verify_model
from isocharge.serve.model.model_search import find_model


def verify_command(model: ModelArgument, json: JsonOption = False, models: ModelsOption = None) -> None:
    """Check that a model folder is what was exported, and that this machine computes its golden vectors.

    The commands of `isocharge serve` make the same checks when they load a model. The exit code is 0 if everything
    fits, 1 if something does not fit, and 2 if there is no such model.

    Example: isocharge verify three-25um-biaxial
    """
    folder = find_model(model, models)
    checks = verify_model(folder)
    fits = all(check.fits for check in checks)
    if json:
        show_json({"folder": str(folder), "fits": fits, "checks": [asdict(check) for check in checks]})
    else:
        for check in checks:
            verdict = "" if check.fits else " does not fit"
            show(f"{check.name}{verdict}: {check.message}")
    raise typer.Exit(0 if fits else 1)
