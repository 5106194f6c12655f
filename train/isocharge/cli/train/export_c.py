"""`isocharge train export-c`: write a model and its signal chain as C99."""

from isocharge.cli.shared.options import DeviceOption, ModelArgument, ModelsOption, NewFolderOption
from isocharge.cli.shared.terminal import say, this_command
from isocharge.serve import find_model, load_device
from isocharge.train.export_c.folder import export_c


def export_c_command(
    model: ModelArgument, output: NewFolderOption, device: DeviceOption = None, models: ModelsOption = None
) -> None:
    """Write a model as C99 for a host without Python, or for a microcontroller.

    DIR contains the network (isocharge_model.h and isocharge_model.c) and a self-test with the golden vectors of the
    model. It also contains the signal chain with the settings of --device, the binary frame, an example for a host, and
    an Arduino sketch. The network takes charges in pC, and returns the position in mm and the force in N. The code
    allocates no memory and needs only <math.h>. DIR/README.md states the commands that compile it.

    Example: isocharge train export-c four-25um-biaxial -o c
    """
    folder = export_c(find_model(model, models), output, load_device(device), command=this_command())
    file_names = sorted(path.name for path in folder.iterdir())
    say(f"{folder}: {', '.join(file_names)}")
