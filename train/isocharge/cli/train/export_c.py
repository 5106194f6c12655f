"""`isocharge train export-c`: a model, and the signal chain beside it, as C99."""

from isocharge.cli.shared.options import DeviceOption, ModelArgument, NewFolderOption
from isocharge.cli.shared.terminal import say, this_command
from isocharge.common.files import refuse_existing
from isocharge.serve import find_model, load_device
from isocharge.train.export_c.folder import export_c


def export_c_command(model: ModelArgument, output: NewFolderOption, device: DeviceOption = None) -> None:
    """Write a model as C99 for a host without Python, or for a microcontroller.

    DIR holds the network (isocharge_model.h and .c, pC in, mm and N out), a self-test with the model's golden vectors,
    the signal chain with the numbers of --device, the binary frame, an example for a host and an Arduino sketch. It
    allocates no memory and needs nothing but <math.h>. DIR/README.md has the lines that compile it.

    Example: isocharge train export-c four-25um-biaxial -o c
    """
    refuse_existing(output)
    folder = export_c(find_model(model), output, load_device(device), command=this_command())
    say(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
