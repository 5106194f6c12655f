"""The card of a network for all films."""

from collections.abc import Mapping

import numpy as np

from isocharge.serve.model.metadata import ModelMetadata
from isocharge.train.films.films_model import FilmsModel

ROWS = (
    ("position, median", "position_median_mm", "mm"),
    ("position, rms", "position_rms_mm", "mm"),
    ("position, 95 %", "position_p95_mm", "mm"),
    ("position, rms of the median film", "position_rms_median_film_mm", "mm"),
    ("position, rms of the worst film", "position_rms_worst_film_mm", "mm"),
    ("force, median", "force_median_percent", "%"),
    ("force, rms", "force_rms_percent", "%"),
)
"""Lines of the table of errors: text, key, unit."""


def films_card(
    films: FilmsModel,
    about: ModelMetadata,
    known: Mapping[str, float],
    unknown: Mapping[str, float],
    exact: Mapping[str, float],
    assumed: str,
) -> str:
    """The text of `card.md`.

    Args:
        films: The network.
        about: Metadata of the served model.
        known: Errors on fresh films that the network is told.
        unknown: Errors of the served model on the same films.
        exact: Errors of the served model on the film that it assumes.
        assumed: Which film that is.
    """
    (low, high), spread = films.domain.force_range_N, films.prior.spread
    electrodes = ", ".join(about.electrodes)
    lines = [f"| {text} | {known[key]:g} {unit} | {unknown[key]:g} {unit} |" for text, key, unit in ROWS]
    lines += [
        f"| coverage of the {level} % intervals | {100 * known[f'coverage_{level}']:.3g} % | "
        f"{100 * unknown[f'coverage_{level}']:.3g} % |"
        for level in (68, 95)
    ]
    return f"""# {about.name}, version {about.version}

A network for every film that the sensor `{about.sensor["name"]}` may be. `films.npz` holds it; told a film, it gives a
plain model of that film in under a second. `isocharge train calibrate` does that after a few presses on a real film.

`model.onnx` is that plain model for {assumed}.
It serves before anything is calibrated, and errs as the right column says.

| | |
|---|---|
| input | `charge_pC`, float32 [n, {len(about.electrodes)}], touch charges of {electrodes} in pC |
| outputs | `contact` (x_mm, y_mm, force_N), `contact_std` (one standard deviation of each), `misfit` |
| working area | within {films.domain.radius_mm:g} mm of the centre |
| forces | {low:g} to {high:g} N |
| probe | {about.probes[0]} as described |
| trained for the noise | {films.noise.name}: {1e12 * films.noise.white:g} pC and {100 * films.noise.gain:g} % |

## The films

| | one standard deviation |
|---|---|
| pretension | anything from 0 to {1e-6 * spread.pretension:g} MPa |
| Young's modulus; thickness | {100 * spread.young:g} %; {100 * spread.thickness:g} % |
| d31 and d32, each; gains, each | {100 * spread.d31:g} %; {100 * spread.gain:g} % |
| shift along x and y, each; turn | {1e3 * spread.shift:g} mm; {np.rad2deg(spread.rotation):.3g} degrees |
| probe radius | {1e3 * films.prior.std[films.prior.names.index("probe_radius")]:g} mm |

## Measured on 64 films and 256 presses of each, none of them in the training

Forces log-uniform, positions uniform over the working area, noise as above.

| error | told the film | `model.onnx`, not told |
|---|---|---|
{chr(10).join(lines)}

On the very film that it assumes, `model.onnx` errs by {exact["position_rms_mm"]:g} mm rms (median
{exact["position_median_mm"]:g} mm) and {exact["force_rms_percent"]:g} % of the force. 1 % of good presses of that film
exceed a misfit of {exact["misfit_p99"]:g}, 0.1 % one of {exact["misfit_p999"]:g}.

## Limits

- The truth behind these figures is the simulator. A film that wrinkles, creeps or is not uniform is none of these.
- The tauter a film, the nearer to the centre its charges stop telling the place: the worst films above. A map that
  folds within the working area cannot be turned back there by any model.
- One press at a time. Outside the working area and forces the answer is finite and wrong; the misfit is then large in
  many cases, not in all.

## Make it again

```bash
{about.made_with.get("command") or "(made by a program, see metadata)"}
```
"""
