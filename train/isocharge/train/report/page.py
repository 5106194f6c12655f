"""Folder of a report: its page in Markdown, its JSON record, and its picture of the errors and durations."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from isocharge.common.files import check_new_output, new_folder, write_whole
from isocharge.common.progress import track
from isocharge.serve.benchmark import machine
from isocharge.simulate import Dataset
from isocharge.simulate.plots.figure import FELT, INK, new_figure, save_picture
from isocharge.train.report.evaluation import SEED, MethodRecord, Section, Settings, evaluate_dataset
from isocharge.train.training.fit import threads_and_seed

RECORDED_PACKAGES = ("isocharge", "numpy", "scipy", "onnxruntime")
"""Packages whose versions are recorded with the results."""

FORMAT_VERSION = 3
"""Version of the format of `report.json`."""

PICTURE = "speed.png"
"""Name of the file of the picture."""

HEADER = (
    "sensor",
    "method",
    "computed by",
    "position rms, mm",
    "median, mm",
    "95 %, mm",
    "force rms, %",
    "one press, us",
)
"""Headers of the columns of the table."""

TEXT_COLUMNS = 3
"""Number of columns with text at the left of the table; the other columns contain numbers."""

ERROR_NAMES = ("position_rms_mm", "position_median_mm", "position_p95_mm", "force_rms_percent")
"""Names of the errors in the order of their columns."""


def report_page(sections: Sequence[Section], settings: Settings, machine: Mapping[str, str], command: str) -> str:
    """Return the page of a report in Markdown.

    Args:
        sections: Results of all datasets.
        settings: Settings of the report.
        machine: Properties of the machine, by name.
        command: Command that repeats the report; empty if there is none.
    """
    blocks = ["# Speed against error"]
    if settings.quick:
        blocks.append("**This is a quick report for a trial run. Its results are not meaningful.**")
    blocks += [
        f"![Position error against the time of one prediction]({PICTURE})",
        "\n".join(_table_lines(sections)),
        "The first network of each sensor is the evaluated model. The errors and the Cramér-Rao limit are computed for "
        "the same presses. No unbiased estimator has a smaller error than the Cramér-Rao limit. Estimators that use a "
        "prior distribution, such as a network, can have a smaller error near a fold of the charges. If a method "
        "answered less than 100 % of the presses, the table states its errors on the answered presses.",
    ]
    for section in sections:
        blocks.append(_conditions(section))
        blocks += [f"Left out: {reason}." for reason in section.left_out]
    blocks.append(
        "All methods run in one process with one thread, and take turns. The times are medians for one press. The seed "
        f"({SEED}) determines the presses and the noise."
    )
    blocks.append(f"Machine: {', '.join(f'{name} {value}' for name, value in machine.items())}.")
    if command:
        blocks.append(f"```sh\n{command}\n```")
    return "\n\n".join(blocks) + "\n"


def _conditions(section: Section) -> str:
    """Return a paragraph about the presses of a dataset and the conditions of their evaluation."""
    min_force, max_force = section.force_N
    area = (
        f"**{section.sensor}**: {', '.join(section.probes)} within {section.radius_mm:.3g} mm, {min_force:.3g} to "
        f"{max_force:.3g} N."
    )
    if section.measured:
        text = (
            f"{area} The presses were measured, and all errors are those of {section.test_presses} presses. No noise "
            "is added. The errors contain the uncertainty of the positions and forces that the test rig reports. The "
            "Cramér-Rao limit is left out, because the noise is unknown."
        )
    else:
        text = (
            f"{area} The {section.test_presses} test presses are at positions of the dataset that are held out, with "
            f"the noise `{section.noise}`."
        )
    if len(section.methods) > 1:
        text += (
            " Triangulation and least squares use a series that is fitted to the other "
            f"{section.fitted_presses} presses."
        )
    return text


def _table_lines(sections: Sequence[Section]) -> Iterator[str]:
    """Yield the lines of the table: first the header, and then the limit and the sorted methods of each dataset."""
    yield _table_line(HEADER)
    n_number_columns = len(HEADER) - TEXT_COLUMNS
    yield "|" + "---|" * TEXT_COLUMNS + "--:|" * n_number_columns  # numbers are aligned to the right
    for section in sections:
        if section.limits:  # the limit has no library and no time
            yield _table_line([section.sensor, "*Cramér-Rao limit, unbiased*", "", *_error_cells(section.limits), ""])
        for record in sorted(section.methods, key=_position_error):
            name = record.name
            if record.answered < 1.0:
                name += f" ({100 * record.answered:.3g} % answered)"
            time = f"{record.single_press_us:,.3g}"
            yield _table_line([section.sensor, name, record.library, *_error_cells(record.errors), time])


def _table_line(cells: Sequence[str]) -> str:
    """Return a line of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def _error_cells(errors: Mapping[str, float]) -> list[str]:
    """Return the cells of `ERROR_NAMES`. Missing errors are empty cells."""
    return [f"{errors[name]:.3g}" if name in errors else "" for name in ERROR_NAMES]


def _position_error(record: MethodRecord) -> float:
    """Return the root-mean-square position error of a method, mm; infinity if there is no estimate."""
    return record.errors.get("position_rms_mm", float("inf"))


def draw_speed(sections: Sequence[Section]) -> Figure:
    """Draw the position error against the time of one prediction, with one panel for each dataset.

    Args:
        sections: Results of all datasets.

    Returns:
        Figure with a logarithmic axis of the times. The evaluated model is a star, and the Cramér-Rao limit is a
        horizontal line. The line lies outside the panel if the limit is much larger than all errors, which occurs if
        the presses reach a fold of the charges.
    """
    figure = new_figure(6.5 * len(sections), 4.5)
    panels = figure.subplots(1, len(sections), squeeze=False)
    for axes, section in zip(panels[0], sections, strict=True):
        plotted = [record for record in section.methods if record.errors]  # methods with at least one estimate
        for record in plotted:
            style: dict[str, Any] = {"marker": "o", "ms": 7}
            if record is section.methods[0]:  # the evaluated model
                style = {"marker": "*", "ms": 14, "color": FELT}
            error_mm = _position_error(record)
            label = f"{record.name.replace('`', '')}, {error_mm:.3g} mm"  # without the backticks of Markdown
            axes.plot(record.single_press_us, error_mm, ls="", label=label, **style)
        if section.limits:
            limit_mm = section.limits["position_rms_mm"]
            axes.axhline(limit_mm, color=INK, ls=":", label=f"Cramér-Rao limit, unbiased, {limit_mm:.3g} mm")
        axes.set(xscale="log", xlabel="time of one prediction, median, us", ylabel="position error, rms, mm")
        axes.set_title(section.sensor)
        axes.set_ylim(0.0, 1.2 * max(map(_position_error, plotted), default=1.0))
        axes.xaxis.set_major_formatter("{x:,g}")
        axes.grid(alpha=0.25)
        axes.legend(fontsize=8)
    return figure


def write_report(
    folder: Path,
    subjects: Sequence[tuple[Dataset, Path]],
    settings: Settings | None = None,
    *,
    command: str = "",
) -> dict[str, Any]:
    """Measure every method on every dataset, and write `report.md`, `report.json` and the picture.

    All methods are tested on presses at positions that are held out.

    Args:
        folder: Folder to create. The folder must not exist.
        subjects: Datasets, each with the version folder of the model that is evaluated on it.
        settings: Settings of the report; None for the settings of a full report.
        command: Command that repeats the report, for the page; empty if there is none.

    Returns:
        The content of `report.json`.

    Raises:
        OutputExists: If the folder exists.
        DatasetError: If the methods cannot be fitted to a dataset.
        ModelError: If a model and its dataset are for different sensors.
        PressError: If there are too few measured presses.
    """
    check_new_output(folder)
    settings = settings or Settings()
    with threads_and_seed(1, SEED):  # all methods are timed with one thread
        sections = [
            evaluate_dataset(dataset, model_folder, settings) for dataset, model_folder in track(subjects, "datasets")
        ]

    this_machine = machine(RECORDED_PACKAGES)
    record = {
        "format_version": FORMAT_VERSION,
        "command": command,
        "machine": this_machine,
        "settings": {**asdict(settings), "seed": SEED},
        "datasets": [asdict(section) for section in sections],
    }
    page = report_page(sections, settings, this_machine, command)
    with new_folder(folder) as draft:
        save_picture(draw_speed(sections), draft / PICTURE)
        write_whole(draft / "report.md", page.encode())
        write_whole(draft / "report.json", (json.dumps(record, indent=1, allow_nan=False) + "\n").encode())
    return record
