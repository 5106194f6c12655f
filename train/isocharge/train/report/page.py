"""The page: summary, one table, pictures with captions; Markdown from the record alone.

The record is that of `report.json`, but for the methods, which are `MethodRecord`s."""

from collections.abc import Iterator, Sequence
from typing import Any

from isocharge.train.baselines import linear_band
from isocharge.train.baselines.networks import RELEASED
from isocharge.train.data.alarms import FALSE_ALARMS
from isocharge.train.report.effects import FARTHEST, GAIN_OFF, PRETENSION_OFF
from isocharge.train.report.measures import MethodRecord


def page(record: dict[str, Any]) -> str:
    """The whole page of a report."""
    lines = ["# Speed against error", ""]
    if record["settings"]["quick"]:
        lines += ["**A quick report: everything small, to try it out. Its figures mean nothing.**", ""]
    for section in record["datasets"]:
        lines += [*_summary(section), ""]
    for section in record["datasets"]:
        lines += [*_section(section, record["settings"]), ""]
    lines += [*_how(record)]
    return "\n".join(lines) + "\n"


def _summary(section: dict[str, Any]) -> Iterator[str]:
    released: MethodRecord = section["methods"][0]
    limits = section["limits"]
    errors = released.errors
    yield f"**{section['sensor']}**, released model `{section['model']['label']}`:"
    yield ""
    yield (
        f"- It errs by {errors.position_rms_mm:.3g} mm rms ({errors.position_median_mm:.3g} mm median) and by "
        f"{errors.force_rms_percent:.3g} % of the force, and takes {released.p50_us:.3g} us for one press."
    )
    if released.over_bayes:
        bayes = limits["bayes"]
        yield (
            f"- That is {released.over_bayes:.3f} times the Bayes limit, {bayes['position_rms_mm']:.3g} mm and "
            f"{bayes['force_rms_percent']:.3g} % of the force on the same charges: no method can do better on average."
        )
    yield from (f"- {sentence}" for sentence in section["verdict"]["sentences"])


def _section(section: dict[str, Any], settings: dict[str, Any]) -> Iterator[str]:
    yield f"## {section['sensor']}"
    yield ""
    if section["measured"]:
        yield from _measured(section, settings)
        return
    low, high = section["force_N"]
    presses, noise = section["presses"], section["noise"]
    yield (
        f"Presses of {', '.join(section['probes'])} within {section['radius_mm']:g} mm, {low:g} to {high:g} N (uniform "
        f"over the disk, log-uniform in force), noise `{noise['name']}` ({noise['white_pC']:g} pC and "
        f"{100 * noise['gain']:g} %). Every method learnt from the same {presses['train']} presses, chose its "
        f"hyperparameters by {presses['validation']} others, and is measured on {presses['test']} more, from solves "
        "that no method has seen. One process, one thread."
    )
    yield ""
    yield from _table(section["methods"], section["limits"])
    yield ""
    yield from _plots(section, settings)
    yield from _where(section)
    yield from _calibration(section)
    yield from _effects(section)
    yield from _choices(section["methods"])


def _measured(section: dict[str, Any], settings: dict[str, Any]) -> Iterator[str]:
    low, high = section["force_N"]
    presses = section["presses"]
    yield (
        f"Measured presses of {', '.join(section['probes'])} within {section['radius_mm']:.3g} mm, {low:.3g} to "
        f"{high:.3g} N. The methods learnt from {presses['train']} of them, chose their hyperparameters by "
        f"{presses['validation']} others, and are measured on {presses['test']} more, as they were measured: no noise "
        "is added, no simulator says what would be right, and the errors hold what the rig does not know of places and "
        "forces. One process, one thread."
    )
    yield ""
    yield (
        "Left out, because it needs a simulator of this very film: the least possible error (Bayes, Cramér-Rao), "
        "triangulation, and films, probes and noise other than those of the presses."
    )
    yield ""
    yield from _table(section["methods"], section["limits"])
    yield ""
    yield from _plots(section, settings)
    for name, reason in section["left_out"].items():
        yield f"- {name}: left out; {reason}."
    yield ""
    yield from _choices(section["methods"])


def _table(records: Sequence[MethodRecord], limits: dict[str, Any]) -> Iterator[str]:
    yield (
        "| method | computed by | position rms, mm | median | 95 % | over Bayes | force rms, % | one, us | 95 % | "
        "per second | bytes |"
    )
    yield "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|"
    for name, key, over_bayes in (("*Bayes limit*", "bayes", "1"), ("*Cramér-Rao, unbiased*", "cramer_rao", "")):
        if limit := limits[key]:
            positions = [_number(limit.get(f"position_{figure}_mm")) for figure in ("rms", "median", "p95")]
            yield _row([name, "", *positions, over_bayes, _number(limit["force_rms_percent"]), "", "", "", ""])
    for record in sorted(records, key=_order):
        yield _row(_cells(record))
    yield ""
    yield (
        "Bold: nothing is both faster (one prediction) and more accurate. *Force given*: by the true force, which no "
        "sensor knows. A share answered below 100 %: errors are of those presses only. Within the band up to "
        f"{linear_band.BAND_N:g} N, as the paper has it: {_band(records)}."
    )


def _order(record: MethodRecord) -> tuple[float, float]:
    return record.errors.position_rms_mm or float("inf"), record.p50_us


def _cells(record: MethodRecord) -> list[str]:
    errors = record.errors
    cells = [
        record.name + (f" ({100 * errors.answered:.3g} % answered)" if errors.answered < 1.0 else ""),
        record.form,
        *(_number(value) for value in (errors.position_rms_mm, errors.position_median_mm, errors.position_p95_mm)),
        _number(record.over_bayes),
        _number(errors.force_rms_percent),
        _number(record.p50_us),
        _number(record.p95_us),
        f"{record.per_second:,.0f}",
        f"{record.memory_bytes:,}",
    ]
    return [f"**{cell}**" if cell else "" for cell in cells] if "latency" in record.best_on else cells


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"


def _band(records: Sequence[MethodRecord]) -> str:
    """Errors of the linear band and of the released network where the band holds."""
    parts = []
    for record in records:
        errors = record.errors_in_band
        if record.name in (linear_band.NAME, RELEASED) and errors and errors.position_rms_mm:
            parts.append(f"{record.name} {errors.position_rms_mm:.3g} mm and {errors.force_rms_percent:.3g} %")
    return "; ".join(parts) or "no presses"


CAPTIONS = {
    "latency": "Position error (rms, mm) against the time of one prediction (median, us). Points of one method are "
    "joined; markers say what computes it. Dashed: the front that nothing beats. The error axis is stretched near the "
    "limit. Hollow: the true force given, or not all presses answered.",
    "throughput": "The same against predictions per second in batches of {batch} (more to the left).",
    "memory": "The same against the bytes a method needs to predict.",
    "maps": "Errors of the released model over the film: rms over forces and {draws} draws of the noise. Squares: "
    "electrodes; dotted: working area.",
    "force": "Position error (rms, mm) against force (N).",
    "calibration": "Share of true contacts inside the released model's central intervals against the nominal level; "
    "shaded: 2 percentage points.",
    "noise": "Position error (rms, mm) when the noise is not the one that the methods were fitted for.",
    "effects": "Left: position error (rms, mm) when the probe, the pretension or gains are not as the methods "
    "assume; answers beyond {farthest:g} mm or N are cut there. Right: share of presses whose misfit gives an alarm, "
    "at {alarms:g} % false alarms (dashed).",
}


def _picture(section: dict[str, Any], name: str, **values: Any) -> str:
    png = section["pictures"][name][0]
    return f"![{name}]({png})\n\n*{CAPTIONS[name].format(**values)}*\n"


def _plots(section: dict[str, Any], settings: dict[str, Any]) -> Iterator[str]:
    for name in ("latency", "throughput", "memory"):
        yield _picture(section, name, batch=settings["batch"])


def _where(section: dict[str, Any]) -> Iterator[str]:
    yield "### Where the errors are"
    yield ""
    yield _picture(section, "maps", draws="several")
    yield _picture(section, "force")
    yield "Worst regions of the released model:"
    yield ""
    yield "| from the centre, mm | direction, deg | force, N | position rms, mm | over Bayes | force rms, % |"
    yield "|--:|--:|--:|--:|--:|--:|"
    for region in section["worst_regions"]:
        ranges = [f"{_number(low)} to {_number(high)}" for low, high in (region[k] for k in REGION)]
        yield _row([*ranges, *(_number(region[k]) for k in ("position_rms_mm", "over_bayes", "force_rms_percent"))])
    yield ""


REGION = ("radius_mm", "angle_deg", "force_N")


def _calibration(section: dict[str, Any]) -> Iterator[str]:
    yield "### Whether the deviations are true"
    yield ""
    yield _picture(section, "calibration")
    yield "| presses | 68 %: x | y | force | 95 %: x | y | force |"
    yield "|---|--:|--:|--:|--:|--:|--:|"
    for part in section["calibration"]["parts"]:
        shares = [part[level][c] for level in ("coverage_68", "coverage_95") for c in ("x", "y", "force")]
        yield _row([part["where"], *(f"{100 * share:.1f}" for share in shares)])
    yield ""


def _effects(section: dict[str, Any]) -> Iterator[str]:
    yield "### When the film, the probe or the chain differ from the model"
    yield ""
    yield _picture(section, "noise")
    yield _picture(section, "effects", alarms=100.0 * FALSE_ALARMS, farthest=FARTHEST)
    names = list(next(case["errors"] for case in section["cases"] if case["errors"]))
    threshold = _number(section["alarm_threshold"])
    yield f"Position error rms, mm, and alarms of the released model (misfit above {threshold}):"
    yield ""
    yield f"| what is different | {' | '.join(names)} | force rms, % | 68 % intervals hold, % | alarms, % | at 1 N |"
    yield "|---|" + "--:|" * (len(names) + 4)
    for case in section["cases"]:
        yield _row(_case_cells(case, names))
    yield ""
    yield (
        f"Gains: every electrode off by {100 * GAIN_OFF:g} % rms, another draw for every press. Pretension: "
        f"{1e-6 * PRETENSION_OFF:g} MPa more than the models assume. Force and intervals are the released model's."
    )
    yield ""
    yield from _without(section)


def _case_cells(case: dict[str, Any], names: Sequence[str]) -> list[str]:
    errors = case["errors"]
    positions = [_number(errors[name]["position_rms_mm"]) if errors else "" for name in names]
    force = _number(errors[names[0]]["force_rms_percent"]) if errors else ""
    inside = "" if case["coverage_68"] is None else f"{100 * case['coverage_68']:.1f}"
    alarms = [_number(case["alarms_percent"]), _number(case["alarms_percent_about_1N"])]
    return [f"{case['group']}: {case['case']}", *positions, force, inside, *alarms]


def _without(section: dict[str, Any]) -> Iterator[str]:
    records = section["without_one"]
    if not records:
        yield (
            "A dead electrode leaves two charges of three, which cannot determine x, y and force: nothing is to be "
            "fitted to them. What the model makes of it is in the table above."
        )
        yield ""
        return
    names = list(records[0]["errors"])
    yield "A dead electrode that is known to be dead leaves three charges; methods fitted again to those:"
    yield ""
    yield f"| without | {' | '.join(f'{name}: position rms, mm | force rms, %' for name in names)} |"
    yield "|---|" + "--:|--:|" * len(names)
    for record in records:
        cells = [
            _number(record["errors"][name][key]) for name in names for key in ("position_rms_mm", "force_rms_percent")
        ]
        yield _row([record["without"], *cells])
    yield ""


def _choices(records: Sequence[MethodRecord]) -> Iterator[str]:
    yield "### Choices"
    yield ""
    yield "| method | chosen | fitting, s |"
    yield "|---|---|--:|"
    first_forms = {record.name: record for record in reversed(records)}
    for record in reversed(first_forms.values()):
        yield _row([record.name, record.choice, _number(record.fit_seconds)])
    yield ""


def _how(record: dict[str, Any]) -> Iterator[str]:
    settings = record["settings"]
    yield "## How it was measured"
    yield ""
    yield (
        f"One prediction: all methods take turns in {settings['rounds']} rounds of {settings['round_ms']:g} ms after "
        "one to warm up, each over the same presses; median and 95th percentile of all calls. Batches: the median of "
        f"three of {settings['batch']}; a method that is slower than a second takes fewer. Memory: serialised size. "
        "Test charges, noise, splits and subsets follow from the seed."
    )
    yield ""
    yield f"Machine: {', '.join(f'{name} {value}' for name, value in record['machine'].items())}."
    if record["command"]:
        yield ""
        yield f"```sh\n{record['command']}\n```"
