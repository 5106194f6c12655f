"""Writer of the page of a report in Markdown, with a summary, tables of all methods, and pictures.

The page is written from the content of `report.json`, in which each method is given as a `MethodRecord`.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from isocharge.train.model_release.evaluate import FALSE_ALARM_RATE
from isocharge.train.report.measures import MethodRecord
from isocharge.train.report.studies import CLIP_LIMIT, GAIN_STD, PRETENSION_ERROR_MPa

SectionContent = Mapping[str, Any]
"""Content of a section of the report, which contains the results of one dataset."""


def report_page(record: Mapping[str, Any]) -> str:
    """Return the page of a report in Markdown.

    Args:
        record: The content of `report.json`, with the methods as `MethodRecord` objects.
    """
    blocks = ["# Speed against error"]
    if record["settings"]["quick"]:
        blocks.append("**This is a quick report for a trial run. Its results are not meaningful.**")
    blocks += ["\n".join(_summary_lines(section)) for section in record["datasets"]]
    for section in record["datasets"]:
        if section["measured"]:
            blocks += _measured_section(section)
        else:
            blocks += _simulated_section(section)
    blocks += _conditions(record)
    return "\n\n".join(blocks) + "\n"


def _summary_lines(section: SectionContent) -> Iterator[str]:
    """Yield the lines of the summary: the errors of the evaluated model, and its comparison with the other methods.

    The line about the Bayes limit is left out if this limit was not computed.

    Args:
        section: Content of the section.
    """
    evaluated_record: MethodRecord = section["methods"][0]  # the evaluated model is always listed first
    errors = evaluated_record.errors
    yield f"**{section['sensor']}**, evaluated model `{section['model']['label']}`:\n"
    yield (
        f"- The position error is {errors.position_rms_mm:.3g} mm rms ({errors.position_median_mm:.3g} mm median), the "
        f"force error is {errors.force_rms_percent:.3g} % rms, and the prediction of one press takes "
        f"{evaluated_record.single_timing.p50_us:.3g} us."
    )
    if evaluated_record.bayes_ratio:
        bayes = section["limits"]["bayes"]
        yield (
            f"- The position error is {evaluated_record.bayes_ratio:.3f} times the Bayes limit. The Bayes limit on the "
            f"same charges is {bayes['position_rms_mm']:.3g} mm and {bayes['force_rms_percent']:.3g} % of the force. "
            "No method has a smaller mean squared error."
        )
    for sentence in section["verdict"]["sentences"]:
        yield f"- {sentence}"


def _simulated_section(section: SectionContent) -> Iterator[str]:
    """Yield the blocks of the section of a simulated dataset.

    Args:
        section: Content of the section.
    """
    min_force, max_force = section["force_N"]
    presses = section["presses"]
    noise = section["noise"]
    yield f"## {section['sensor']}"
    yield (
        f"The presses are simulated: {', '.join(section['probes'])} within {section['radius_mm']:g} mm, {min_force:g} "
        f"to {max_force:g} N (positions uniform over the disk, forces log-uniform). The noise is `{noise['name']}` "
        f"({noise['white_pC']:g} pC and {100 * noise['gain']:g} % of the charge). All methods are fitted to the same "
        f"{presses['train']} presses, and their hyperparameters are chosen with {presses['validation']} other presses. "
        f"The errors are measured on {presses['test']} test presses, which come from separate solves of the film. All "
        "methods run in one process with one thread."
    )
    yield from _method_comparison(section)
    yield "### Errors over the film and the force"
    yield _picture(section, "maps")
    yield _picture(section, "force")
    yield "### Coverage of the reported standard deviations"
    yield _picture(section, "calibration")
    yield from _mismatch_effects(section)
    yield from _chosen_parameters(section["methods"])


def _measured_section(section: SectionContent) -> Iterator[str]:
    """Yield the blocks of the section of a measured dataset.

    Args:
        section: Content of the section.
    """
    min_force, max_force = section["force_N"]
    presses = section["presses"]
    yield f"## {section['sensor']}"
    yield (
        f"The presses were measured: {', '.join(section['probes'])} within {section['radius_mm']:.3g} mm, "
        f"{min_force:.3g} to {max_force:.3g} N. The methods are fitted to {presses['train']} of the presses, and their "
        f"hyperparameters are chosen with {presses['validation']} others. The errors are measured on "
        f"{presses['test']} held-out presses. No noise is added to the charges. The errors contain the uncertainty of "
        "the positions and forces that the test rig reports. All methods run in one process with one thread."
    )
    yield (
        "The following parts are left out, because they need a simulation of exactly this film: the Bayes limit, the "
        "Cramér-Rao limit, triangulation, and the tests with other films, probes and noise."
    )
    yield from _method_comparison(section)
    yield "\n".join(f"- {name} is left out: {reason}." for name, reason in section["left_out"].items())
    yield from _chosen_parameters(section["methods"])


METHOD_TABLE_HEADER = (
    "method",
    "computed by",
    "position rms, mm",
    "median, mm",
    "95 %, mm",
    "ratio to Bayes limit",
    "force rms, %",
    "one press, median, us",
    "one press, 99 %, us",
    "presses per second",
    "bytes",
)
"""Headers of the columns in the table of methods."""

TEXT_COLUMNS = 2
"""Number of columns with text at the left of a table; the other columns contain numbers."""


def _method_comparison(section: SectionContent) -> Iterator[str]:
    """Yield the table of limits and methods, an explanation of the table, and the plots of the error against each cost.

    The methods are sorted by their position error.

    Args:
        section: Content of the section.
    """
    records: Sequence[MethodRecord] = section["methods"]
    sorted_records = sorted(records, key=_error_and_latency)
    rows = [*_limit_rows(section["limits"]), *(_method_row(record) for record in sorted_records)]
    yield markdown_table(METHOD_TABLE_HEADER, rows, TEXT_COLUMNS)
    yield (
        "A method is printed in bold if no other method is both faster for one press and more accurate. Methods with "
        "*force given* use the true force, which no sensor measures. If a method answered less than 100 % of the "
        "presses, the table states its errors on the answered presses."
    )
    for picture_name in ("latency", "throughput", "memory"):
        yield _picture(section, picture_name)


def _error_and_latency(record: MethodRecord) -> tuple[float, float]:
    """Return the key that sorts methods by the error and then by the latency. Methods without an estimate come last."""
    error_mm = record.errors.position_rms_mm
    if error_mm is None:
        error_mm = float("inf")
    return error_mm, record.single_timing.p50_us


def _limit_rows(limits: Mapping[str, Any]) -> Iterator[list[str]]:
    """Yield rows for the table of methods, one for each theoretical limit that was computed.

    Args:
        limits: The entry "limits" of a section. Each limit is None if it was not computed.
    """
    for name, key, bayes_ratio in (("*Bayes limit*", "bayes", "1"), ("*Cramér-Rao limit, unbiased*", "cramer_rao", "")):
        limit = limits[key]
        if limit:
            yield [
                name,
                "",
                _number_text(limit["position_rms_mm"]),
                _number_text(limit["position_median_mm"]),
                _number_text(limit.get("position_p95_mm")),
                bayes_ratio,
                _number_text(limit["force_rms_percent"]),
                "",
                "",
                "",
                "",
            ]


def _method_row(record: MethodRecord) -> list[str]:
    """Return the row of a method in the table of methods.

    The row is in bold if no other method is better in both the position error and the duration of one prediction, which
    means that the method is on the Pareto front of the latency.

    Args:
        record: Record of the method.
    """
    errors = record.errors
    name = record.method.name
    if errors.answered < 1.0:
        name += f" ({100 * errors.answered:.3g} % answered)"
    cells = [
        name,
        record.method.computed_by,
        _number_text(errors.position_rms_mm),
        _number_text(errors.position_median_mm),
        _number_text(errors.position_p95_mm),
        _number_text(record.bayes_ratio),
        _number_text(errors.force_rms_percent),
        _number_text(record.single_timing.p50_us),
        _number_text(record.single_timing.p99_us),
        f"{record.batch_timing.presses_per_s:,.0f}",
        f"{record.memory_bytes:,}",
    ]
    if "latency" not in record.pareto_costs:
        return cells
    return [f"**{cell}**" if cell else "" for cell in cells]


def _mismatch_effects(section: SectionContent) -> Iterator[str]:
    """Yield the blocks about errors with films, probes and electronics that differ from the assumptions.

    Args:
        section: Content of the section of a simulated dataset.
    """
    yield "### Errors if the film, the probe or the electronics differ from the assumptions"
    yield _picture(section, "noise")
    yield _picture(section, "effects")
    yield (
        "The table shows the root-mean-square position errors in mm, and the alarms of the evaluated model (misfit "
        f"above {_number_text(section['alarm_threshold'])} standard deviations of the noise)."
    )
    method_names = list(section["cases"][0]["errors"])
    header = ["difference", *method_names, "force rms, %", "coverage of the 68 % intervals, %", "alarms, %"]
    rows = [_mismatch_row(result, method_names) for result in section["cases"]]
    yield markdown_table(header, rows)
    yield (
        f"Wrong gains have independent errors of {100 * GAIN_STD:g} % rms for every electrode and every press. The "
        f"other pretension is {PRETENSION_ERROR_MPa:g} MPa larger than the models assume. The force errors and the "
        "coverage are those of the evaluated model."
    )


def _mismatch_row(result: Mapping[str, Any], method_names: Sequence[str]) -> list[str]:
    """Return the row of a mismatch in the table of conditions that differ from the assumptions of the models.

    Args:
        result: Result of `studies.measure_mismatch`.
        method_names: Names of the methods in the order of the columns; the first one is the evaluated model.
    """
    errors = result["errors"]
    evaluated_errors = errors[method_names[0]]
    return [
        f"{result['group']}: {result['case']}",
        *(_number_text(errors[name]["position_rms_mm"]) for name in method_names),
        _number_text(evaluated_errors["force_rms_percent"]),
        f"{100 * result['coverage_68']:.1f}",
        _number_text(result["alarms_percent"]),
    ]


def _chosen_parameters(records: Sequence[MethodRecord]) -> Iterator[str]:
    """Yield the table of the hyperparameters that were chosen for each method, and the durations of fitting."""
    yield "### Hyperparameters"
    rows = [[record.method.name, record.method.choice, _number_text(record.fit_seconds)] for record in records]
    yield markdown_table(["method", "chosen", "fitting, s"], rows, TEXT_COLUMNS)


def _conditions(record: Mapping[str, Any]) -> Iterator[str]:
    """Yield the blocks that state how the report was measured, on which machine, and with which command.

    Args:
        record: The content of `report.json`.
    """
    batch_size = record["settings"]["batch"]
    yield "## How the report was measured"
    yield (
        f"Every method predicts single presses and batches of {batch_size} presses. The methods take turns, and the "
        "first turn of each is not counted. The report states the median and the 99th percentile of the durations of "
        "all calls, and the number of presses divided by the total time. If a method needs more than 0.1 s for a "
        "batch, a smaller batch is measured. The memory is the serialised size of the method. The test charges, the "
        "noise, the splits and the subsets are determined by the seed."
    )
    machine = ", ".join(f"{name} {value}" for name, value in record["machine"].items())
    yield f"Machine: {machine}."
    if record["command"]:
        yield f"```sh\n{record['command']}\n```"


CAPTIONS = {
    "latency": "Position error (rms, mm) against the duration of one prediction (median, us). The dashed line is the "
    "Pareto front: no method is better in both. Hollow markers: the method is given the true force, or did not answer "
    "all presses.",
    "throughput": "Position error (rms, mm) against the predictions per second in batches. The axis is reversed, so "
    "that faster methods are on the left.",
    "memory": "Position error (rms, mm) against the size of the serialised method (bytes).",
    "maps": "Root-mean-square errors of the evaluated model over the film, for all forces and several draws of the "
    "noise. Squares: electrodes. Dotted line: edge of the working area.",
    "force": "Position error (rms, mm) against the force (N).",
    "calibration": "Coverage of the central intervals of the evaluated model (fraction of the true values inside an "
    "interval) minus the nominal level. Shaded area: 2 percentage points.",
    "noise": "Position error (rms, mm) against the noise, relative to the noise for which the methods were fitted.",
    "effects": "Left: position error (rms, mm) if the probe, the pretension or the gains differ from what the methods "
    f"assume. Estimates above {CLIP_LIMIT:g} mm or N are clipped. Right: percentage of presses whose misfit exceeds "
    f"the threshold for an alarm; the dashed line is the false alarm rate of {100.0 * FALSE_ALARM_RATE:g} %.",
}
"""Caption of each picture, by the name of the picture."""


def _picture(section: SectionContent, name: str) -> str:
    """Return the Markdown of a picture with its caption."""
    files = section["pictures"][name]
    return f"![{name}]({files[0]})\n\n*{CAPTIONS[name]}*"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]], text_columns: int = 1) -> str:
    """Return a table in Markdown.

    Args:
        header: The headers of the columns.
        rows: The cells of each row.
        text_columns: Number of columns at the left that are aligned to the left; the others are aligned to the right.
    """
    number_columns = len(header) - text_columns
    lines = [
        f"| {' | '.join(header)} |",
        "|" + "---|" * text_columns + "--:|" * number_columns,
    ]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join(lines)


def _number_text(value: float | None) -> str:
    """Format a number for a table: with three significant digits below 1000, and as a rounded integer from 1000.

    Args:
        value: The number; None for an empty cell.
    """
    if value is None:
        return ""
    if abs(value) < 1000:
        return f"{value:.3g}"
    return f"{value:,.0f}"
