"""The page that shows a design: one HTML file with everything in it."""

import base64
from collections.abc import Mapping
from html import escape
from typing import Any

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1b2a41; max-width: 68rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; margin: 1rem 0; display: block; overflow-x: auto; }
th, td { border-bottom: 1px solid #d7dde3; padding: .3rem .8rem; text-align: right; }
th:first-child, td:first-child { text-align: left; }
img, svg { max-width: 100%; height: auto; }
pre { background: #f3f5f7; padding: 1rem; overflow-x: auto; }
.layout svg { width: 30rem; }
"""

LEADS = (
    "Leads collect charge like electrodes where both sides of the film carry them: let the leads of the two sides not "
    "lie over each other."
)

LEVELS = {
    "noise_alone": "everything known",
    "probe_and_pretension_unknown": "probe radius and pretension unknown",
    "nuisances_of_the_task": "all that nobody knows",
}
"""Levels of knowledge in the numbers, and their names on the page."""


def design_page(numbers: Mapping[str, Any], toml: str, svg: str, leads: str, pictures: Mapping[str, bytes]) -> str:
    """The page.

    Args:
        numbers: As in design.json.
        toml: The sensor's file.
        svg: The layout to scale.
        leads: How the leads run.
        pictures: PNG files by their captions, in their order.
    """
    task = numbers["task"]
    title = f"{task['electrodes']} electrodes over {task['radius_mm']:g} mm"
    figures = "\n".join(_figure(caption, png) for caption, png in pictures.items())
    drawing = svg[svg.index("<svg") :]
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<h1>{escape(title)}</h1>
<p>{escape(_summary(numbers))}</p>
<h2>Errors</h2>
{_errors(numbers)}
{figures}
<h2>Layout</h2>
<p>Electrodes seen from the side that is touched, to scale, with a ruler of 50 mm.
{escape(leads[:1].upper() + leads[1:])}. {LEADS}</p>
<div class="layout">{drawing}</div>
<h2>Places</h2>
{_places(numbers)}
<h2>Placement</h2>
<p>Every electrode off by up to the tolerance along x and along y.</p>
{_tolerances(numbers)}
<h2>The sensor's file</h2>
<pre>{escape(toml)}</pre>
<h2>What was asked</h2>
<pre>{escape(_lines(task))}</pre>
</body>
</html>
"""


def _summary(numbers: Mapping[str, Any]) -> str:
    task, scene = numbers["task"], numbers["scenes"][0]
    errors = scene["after"]["nuisances_of_the_task"]
    x, y = errors["worst_at_mm"]
    sentence = (
        f"Least position error of a press of {scene['force_N']:g} N with {scene['probe']} anywhere within "
        f"{task['radius_mm']:g} mm: {errors['worst_mm']:.3f} mm at worst, at ({x:.1f}, {y:.1f}) mm, and "
        f"{errors['rms_mm']:.3f} mm root mean square. Goal: {task['goal']}. "
    )
    checked = "No folds and no twins." if numbers["unambiguous"] else "Not every press is determined: "
    return sentence + checked + ("" if numbers["unambiguous"] else f"{numbers['folds_and_twins']}.")


def _errors(numbers: Mapping[str, Any]) -> str:
    head = ["scene", "what is known", "before: worst", "rms", "after: worst", "rms, mm"]
    rows = []
    for scene in numbers["scenes"]:
        name = f"{scene['force_N']:g} N, {scene['probe']}, pretension {scene['pretension_MPa']:g} MPa"
        for level, words in LEVELS.items():
            before, after = (scene["before"] or {}).get(level), scene["after"][level]
            cells = [f"{before[key]:.3f}" if before else "" for key in ("worst_mm", "rms_mm")]
            rows.append([name, words, *cells, *(f"{after[key]:.3f}" for key in ("worst_mm", "rms_mm"))])
    return _table(head, rows)


def _places(numbers: Mapping[str, Any]) -> str:
    rows = [[name, f"{x:.3f}", f"{y:.3f}"] for name, (x, y) in numbers["electrodes_mm"].items()]
    return _table(["electrode", "x, mm", "y, mm"], rows)


def _tolerances(numbers: Mapping[str, Any]) -> str:
    rows = [
        [f"{row['tolerance_mm']:g}", f"{row['worst_if_measured_mm']:.3f}", f"{row['added_rms_if_not_mm']:.3f}"]
        for row in numbers["placement"]
    ]
    return _table(
        ["tolerance, mm", "worst error if the places are measured, mm", "added error (rms) if they are not, mm"], rows
    )


def _table(head: list[str], rows: list[list[str]]) -> str:
    cells = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return f"<table><tr>{cells}</tr>\n" + "\n".join(lines) + "</table>"


def _figure(caption: str, png: bytes) -> str:
    data = base64.b64encode(png).decode()
    image = f'<img alt="{escape(caption)}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def _lines(task: Mapping[str, Any]) -> str:
    return "\n".join(f"{key}: {value}" for key, value in task.items())
