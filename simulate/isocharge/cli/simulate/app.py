"""Command group `isocharge simulate`, which imports the module of a command only when the command is called."""

from isocharge.cli.shared.lazy import LazyCommand, lazy_group

simulate_app = lazy_group(
    "Compute the charges of presses, and the accuracy with which charges determine a press.",
    {
        "point": LazyCommand(
            "isocharge.cli.simulate.point:point_command",
            "Compute the charges and the deflection of one press.",
            extra="simulate",
        ),
        "sweep": LazyCommand(
            "isocharge.cli.simulate.sweep:sweep_command",
            "Compute the charges of many presses and write them as a dataset for training.",
            extra="simulate",
        ),
        "identify": LazyCommand(
            "isocharge.cli.simulate.identify:identify_command",
            "Compute error limits, folds and the working area of a sensor.",
            extra="simulate",
        ),
        "design": LazyCommand(
            "isocharge.cli.simulate.design:design_command",
            "Search for the electrode positions with the smallest position errors.",
            extra="design",
        ),
    },
)
