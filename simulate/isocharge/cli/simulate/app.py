"""`isocharge simulate ...`: its commands, one module each."""

from isocharge.cli.shared.lazy import LazyCommand, lazy_group

simulate_app = lazy_group(
    "Compute the charges of presses, and what charges determine about a press.",
    {
        "point": LazyCommand(
            "isocharge.cli.simulate.point:point_command",
            "Compute the charges and the deflection of one press.",
            extra="simulate",
        ),
        "sweep": LazyCommand(
            "isocharge.cli.simulate.sweep:sweep_command",
            "Compute the charges of many presses: a dataset to train on.",
            extra="simulate",
        ),
        "identify": LazyCommand(
            "isocharge.cli.simulate.identify:identify_command",
            "Say what the charges of a sensor determine: limits, folds, working area.",
            extra="simulate",
        ),
        "design": LazyCommand(
            "isocharge.cli.simulate.design:design_command",
            "Place the electrodes where their charges determine contacts best.",
            extra="design",
        ),
    },
)
