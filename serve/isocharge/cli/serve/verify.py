"""`isocharge verify`: check whether a model folder is complete, unchanged, and correct on this machine."""

from isocharge.cli.shared.options import JsonOption, ModelArgument, ModelsOption
from isocharge.cli.shared.terminal import show_result
from isocharge.serve.model.model_folder import find_model, load_checked_model


def verify_command(model: ModelArgument, json: JsonOption = False, models: ModelsOption = None) -> None:
    """Check that a model folder is what was exported, and that this machine computes its golden vectors.

    The commands of `isocharge serve` make the same checks when they load a model. The command fails with the reason if
    a file is missing, is changed or belongs to another model, or if an output differs.

    Example: isocharge verify three-25um-biaxial
    """
    checked = load_checked_model(find_model(model, models))
    golden = checked.golden
    facts = {
        "model": checked.metadata.label,
        "folder": str(checked.folder),
        "sha256": golden.checksums,
        "golden_presses": len(golden.charge_pC),
        "dataset_sha256": checked.metadata.dataset_sha256,
        "made_with": checked.metadata.made_with,
    }
    show_result(facts, json=json)
