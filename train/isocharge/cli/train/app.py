"""Command group `isocharge train`. The module of a command is imported when the command is called."""

from isocharge.cli.shared.lazy import LazyCommand, lazy_group

train_app = lazy_group(
    "Train models on simulated or measured charges; calibrate films; compare methods.",
    {
        "fit": LazyCommand(
            "isocharge.cli.train.fit:fit_command", "Train a network and write its model folder.", extra="train"
        ),
        "press": LazyCommand(
            "isocharge.cli.train.press:press_command",
            "Record presses at a port, and write them to a file.",
            extra="train",
        ),
        "calibrate": LazyCommand(
            "isocharge.cli.train.calibrate:calibrate_command",
            "Fit a real film to some presses, and write its model folder.",
            extra="train",
        ),
        "report": LazyCommand(
            "isocharge.cli.train.report:report_command", "Compare methods: speed against error.", extra="train"
        ),
        "export-c": LazyCommand(
            "isocharge.cli.train.export_c:export_c_command", "Write a model as C source.", extra="train"
        ),
    },
)
