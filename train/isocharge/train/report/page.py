"""The page: summary, one table, pictures with captions; Markdown from the record alone.

The record is that of `report.json`, but for the methods, each a `MethodRecord`.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from isocharge.train.model_release.evaluate import FALSE_ALARM_RATE
from isocharge.train.report.measures import MethodRecord
from isocharge.train.report.studies import FARTHEST, GAIN_OFF, PRETENSION_OFF

Section = Mapping[str, Any]


def page(record: Mapping[str, Any]) -> str:
    """The whole page of a report."""
    quick = "**A quick report: everything small, to try it out. Its figures mean nothing.**"
    parts = ["# Speed against error", *([quick] if record["settings"]["quick"] else [])]
    parts += ["\n".join(_summary(section)) for section in record["datasets"]]
    for section in record["datasets"]:
        parts += _measured(section) if section["measured"] else _simulated(section)
    return "\n\n".join([*parts, *_how(record)]) + "\n"


def _summary(section: Section) -> Iterator[str]:
    released: MethodRecord = section["methods"][0]
    errors, limits = released.errors, section["limits"]
    yield f"**{section['sensor']}**, released model `{section['model']['label']}`:\n"
    yield (
        f"- It errs by {errors.position_rms_mm:.3g} mm rms ({errors.position_median_mm:.3g} mm median) and by "
        f"{errors.force_rms_percent:.3g} % of the force, and takes {released.one.p50_us:.3g} us for one press."
    )
    if released.over_bayes:
        bayes = limits["bayes"]
        yield (
            f"- That is {released.over_bayes:.3f} times the Bayes limit, {bayes['position_rms_mm']:.3g} mm and "
            f"{bayes['force_rms_percent']:.3g} % of the force on the same charges: no method can do better on average."
        )
    yield from (f"- {sentence}" for sentence in section["verdict"]["sentences"])


def _simulated(section: Section) -> Iterator[str]:
    low, high = section["force_N"]
    presses, noise = section["presses"], section["noise"]
    yield f"## {section['sensor']}"
    yield (
        f"Presses of {', '.join(section['probes'])} within {section['radius_mm']:g} mm, {low:g} to {high:g} N (uniform "
        f"over the disk, log-uniform in force), noise `{noise['name']}` ({noise['white_pC']:g} pC and "
        f"{100 * noise['gain']:g} %). Every method learnt from the same {presses['train']} presses, chose its "
        f"hyperparameters by {presses['validation']} others, and is measured on {presses['test']} more, from solves "
        "that no method has seen. One process, one thread."
    )
    yield from _methods(section)
    yield "### Where the errors are"
    yield _picture(section, "maps")
    yield _picture(section, "force")
    yield "### Whether the deviations are true"
    yield _picture(section, "calibration")
    yield from _effects(section)
    yield from _choices(section["methods"])


def _measured(section: Section) -> Iterator[str]:
    low, high = section["force_N"]
    presses = section["presses"]
    yield f"## {section['sensor']}"
    yield (
        f"Measured presses of {', '.join(section['probes'])} within {section['radius_mm']:.3g} mm, {low:.3g} to "
        f"{high:.3g} N. The methods learnt from {presses['train']} of them, chose their hyperparameters by "
        f"{presses['validation']} others, and are measured on {presses['test']} more, as they were measured: no noise "
        "is added, no simulator says what would be right, and the errors hold what the rig does not know of places and "
        "forces. One process, one thread."
    )
    yield (
        "Left out, because it needs a simulator of this very film: the least possible error (Bayes, Cramér-Rao), "
        "triangulation, and films, probes and noise other than those of the presses."
    )
    yield from _methods(section)
    yield "\n".join(f"- {name}: left out; {reason}." for name, reason in section["left_out"].items())
    yield from _choices(section["methods"])


def _methods(section: Section) -> Iterator[str]:
    """The table, and its pictures."""
    head = ["method", "computed by", "position rms, mm", "median", "95 %", "over Bayes", "force rms, %"]
    head += ["one, us", "99 %", "per second", "bytes"]
    rows = []
    for name, key, ratio in (("*Bayes limit*", "bayes", "1"), ("*Cramér-Rao, unbiased*", "cramer_rao", "")):
        if limit := section["limits"][key]:
            positions = [_number(limit.get(f"position_{figure}_mm")) for figure in ("rms", "median", "p95")]
            rows.append([name, "", *positions, ratio, _number(limit["force_rms_percent"]), "", "", "", ""])
    records: Sequence[MethodRecord] = section["methods"]
    rows += [
        _cells(record) for record in sorted(records, key=lambda r: (r.errors.position_rms_mm or 1e9, r.one.p50_us))
    ]
    yield table(head, rows, left=2)
    yield (
        "Bold: nothing is both faster (one prediction) and more accurate. *Force given*: by the true force, which no "
        "sensor knows. A share answered below 100 %: errors are of those presses only."
    )
    yield from (_picture(section, name) for name in ("latency", "throughput", "memory"))


def _cells(record: MethodRecord) -> list[str]:
    errors = record.errors
    cells = [
        record.compared.name + (f" ({100 * errors.answered:.3g} % answered)" if errors.answered < 1.0 else ""),
        record.compared.computed_by,
        *(_number(value) for value in (errors.position_rms_mm, errors.position_median_mm, errors.position_p95_mm)),
        _number(record.over_bayes),
        _number(errors.force_rms_percent),
        _number(record.one.p50_us),
        _number(record.one.p99_us),
        f"{record.many.presses_per_s:,.0f}",
        f"{record.memory_bytes:,}",
    ]
    return [f"**{cell}**" if cell else "" for cell in cells] if "latency" in record.best_on else cells


def _effects(section: Section) -> Iterator[str]:
    yield "### When the film, the probe or the chain differ from the model"
    yield _picture(section, "noise")
    yield _picture(section, "effects")
    threshold = _number(section["alarm_threshold"])
    yield f"Position error rms, mm, and alarms of the released model (misfit above {threshold}):"
    names = list(section["cases"][0]["errors"])
    head = ["what is different", *names, "force rms, %", "68 % intervals hold, %", "alarms, %"]
    yield table(head, (_case_cells(case, names) for case in section["cases"]))
    yield (
        f"Gains: every electrode off by {100 * GAIN_OFF:g} % rms, another draw for every press. Pretension: "
        f"{PRETENSION_OFF:g} MPa more than the models assume. Force and intervals are the released model's."
    )


def _case_cells(case: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    positions = [_number(case["errors"][name]["position_rms_mm"]) for name in names]
    force, inside = _number(case["errors"][names[0]]["force_rms_percent"]), f"{100 * case['coverage_68']:.1f}"
    return [f"{case['group']}: {case['case']}", *positions, force, inside, _number(case["alarms_percent"])]


def _choices(records: Sequence[MethodRecord]) -> Iterator[str]:
    yield "### Choices"
    rows = [[record.compared.name, record.compared.choice, _number(record.fit_seconds)] for record in records]
    yield table(["method", "chosen", "fitting, s"], rows, left=2)


def _how(record: Mapping[str, Any]) -> Iterator[str]:
    settings = record["settings"]
    yield "## How it was measured"
    yield (
        f"One prediction and a batch of {settings['batch']} by every method, in turns, after a turn to warm up: median "
        "and 99th percentile of all calls, presses over time. A method that takes longer than 0.1 s for a batch has a "
        "smaller one. Memory: serialised size. "
        "Test charges, noise, splits and subsets follow from the seed."
    )
    yield f"Machine: {', '.join(f'{name} {value}' for name, value in record['machine'].items())}."
    if record["command"]:
        yield f"```sh\n{record['command']}\n```"


CAPTIONS = {
    "latency": "Position error (rms, mm) against the time of one prediction (median, us). Dashed: the front that "
    "nothing beats. Hollow: the true force given, or not all presses answered.",
    "throughput": "The same against predictions per second in batches (more to the left).",
    "memory": "The same against the bytes a method needs to predict.",
    "maps": "Errors of the released model over the film: rms over forces and several draws of the noise. Squares: "
    "electrodes; dotted: working area.",
    "force": "Position error (rms, mm) against force (N).",
    "calibration": "Share of true contacts inside the released model's central intervals, less the nominal level; "
    "shaded: 2 percentage points.",
    "noise": "Position error (rms, mm) when the noise is not the one that the methods were fitted for.",
    "effects": "Left: position error (rms, mm) when the probe, the pretension or gains are not as the methods "
    f"assume; answers beyond {FARTHEST:g} mm or N are cut there. Right: share of presses whose misfit gives an alarm, "
    f"at {100.0 * FALSE_ALARM_RATE:g} % false alarms (dashed).",
}


def _picture(section: Section, name: str) -> str:
    return f"![{name}]({section['pictures'][name][0]})\n\n*{CAPTIONS[name]}*"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """A table in Markdown; columns behind the first `left` are aligned to the right."""
    rule = "|" + "---|" * left + "--:|" * (len(head) - left)
    first, *others = (f"| {' | '.join(row)} |" for row in (head, *rows))
    return "\n".join([first, rule, *others])


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
