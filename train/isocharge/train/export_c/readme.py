"""The README of an export: what is in the folder, how to compile and to call it."""

from isocharge.serve.live.device import Device
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.train.export_c.c_text import c_comment

README = """\
# {label} in C

Written by `{command}`.

```sh
cc -std=c99 -O2 -o self_test self_test.c isocharge_model.c -lm && ./self_test
```

answers the golden vectors of the model and exits with 0 if this machine computes the same.

```c
#include "isocharge_model.h"

float charge_pC[ISOCHARGE_ELECTRODES] = {{{charges}}};  /* {electrodes} */
float contact[7];  /* x_mm, y_mm, force_N, x_std_mm, y_std_mm, force_std_N, misfit */
isocharge_predict(charge_pC, contact);
```

The function allocates nothing, keeps nothing, and may run on several threads at once. On a host, `-O3 -march=native`
makes it about twice as fast.

| file | what it is |
|---|---|
| `isocharge_model.h`, `.c` | the network: touch charges to a contact |
| `isocharge_chain.h`, `.c` | the signal chain: readings of a board to touch charges |
| `isocharge_device.h` | its numbers, of the board {board} |
| `isocharge_frames.h`, `.c` | the binary frame: bytes to frames, and back |
| `self_test.c` | the golden vectors |
| `host_example.c` | frames from a serial port, contacts to stdout |
| `arduino/isocharge_sketch` | the same on a board, as an Arduino sketch with its own copies |

The host example, on Linux and other POSIX systems:

```sh
cc -std=c99 -O2 -o host_example host_example.c isocharge_chain.c isocharge_frames.c isocharge_model.c -lm
```

Then `./host_example /dev/ttyACM0` prints a line of JSON for each frame.

On a board:

```text
arm-none-eabi-gcc -mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 -std=c99 -ffp-contract=fast \\
    -O2 -DISOCHARGE_CHAIN_FLOAT -c isocharge_model.c isocharge_chain.c
```

`ISOCHARGE_CHAIN_FLOAT` computes the signal chain in single precision, for processors without double.
"""


def readme(metadata: ModelMetadata, device: Device, command: str) -> str:
    """The text of `README.md`."""
    return README.format(
        label=metadata.label,
        command=" ".join(command.replace("`", "'").split()) or "isocharge train export-c",
        charges=", ".join(["800.0f"] * len(metadata.electrodes)),
        electrodes=c_comment(", ".join(metadata.electrodes)),
        board=c_comment(device.name),
    )
