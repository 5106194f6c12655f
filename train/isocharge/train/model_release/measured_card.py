"""Card of a model that was trained on measured presses alone, and the section of a card about measured errors."""

from collections.abc import Mapping

import numpy as np

from isocharge.serve.model.metadata import ModelMetadata
from isocharge.train.model_release.evaluate import HELD_PRESSES


def measured_errors_section(errors: Mapping[str, float], heading_end: str, explanation: str) -> str:
    """Return the section of a card that lists the errors on measured presses.

    Args:
        errors: Errors of the model by name.
        heading_end: Last words of the heading, after "measured presses".
        explanation: Paragraph about the meaning of the figures.
    """
    force_rows = ""
    if "force_rms_percent" in errors:
        force_rows = f"""\
| force, median | {errors["force_median_percent"]:g} % |
| force, rms | {errors["force_rms_percent"]:g} % |
"""
    return f"""## Errors on {errors[HELD_PRESSES]:.0f} measured presses {heading_end}

{explanation}
| error | on measured presses |
|---|---|
| position, median | {errors["position_median_mm"]:g} mm |
| position, rms | {errors["position_rms_mm"]:g} mm |
| position, 95 % | {errors["position_p95_mm"]:g} mm |
{force_rows}| coverage of the 68 % intervals | {100 * errors["coverage_68"]:.3g} % |
| coverage of the 95 % intervals | {100 * errors["coverage_95"]:.3g} % |
"""


def measured_card(metadata: ModelMetadata) -> str:
    """Return the text of `card.md` for a model that was trained on measured presses alone.

    Args:
        metadata: Metadata of the model.
    """
    min_force, max_force = metadata.force_range_N
    measured = metadata.made_with["measured"]
    width, height = np.ptp(np.array(metadata.working_area_mm), axis=0)
    channels = ", ".join(metadata.electrodes)
    white_noise, gain_noise = metadata.noise.for_each_electrode(len(metadata.electrodes))
    noise_rows = "\n".join(
        f"| noise of {name} | {white:g} and {100 * gain:.3g} % of the charge |"
        for name, white, gain in zip(metadata.electrodes, white_noise, gain_noise, strict=True)
    )
    position_factor, force_factor = measured["std_factors"]
    forces = f"{min_force:g} to {max_force:g} N"
    constant_force = metadata.made_with.get("constant_force")
    if constant_force is not None:
        reason = "all presses had this force" if constant_force["is_known"] else "the forces were not measured"
        forces = (
            f"not estimated: every answer is {constant_force['force_N']:g} N with a standard deviation of "
            f"{100 * constant_force['force_std']:.3g} %, because {reason}"
        )
    error_source = f"""\
The errors are those of {measured["folds"]} networks, each on the places on which it was not trained. The model
learned the mean of their answers, whose errors are slightly smaller. The standard deviations were multiplied by
{position_factor:g} for positions and {force_factor:g} for forces, so that the 68 % intervals contain 68 % of these \
presses.
"""
    return f"""# {metadata.name}, version {metadata.version}

Estimates the position and the force of one press from the charges of the sensor `{metadata.sensor["name"]}`. The model
was fitted to measured presses alone, without a simulator.

| | |
|---|---|
| input | `charge_pC`, float32 [n, {len(metadata.electrodes)}], of {channels}, in the unit in which they were measured |
| outputs | `contact` (x_mm, y_mm, force_N), `contact_std` (one standard deviation of each), `misfit` |
| fitted to | {measured["presses"]} presses at {measured["places"]} places, in `presses.csv` |
| working area | {width:.4g} mm x {height:.4g} mm, the outline of the presses; corners in the metadata |
| forces | {forces} |
| probes | {", ".join(metadata.probes)} |
{noise_rows}

{measured_errors_section(metadata.errors, "at places that were left out", error_source)}
The misfit is the distance, in units of that noise, of the charges from those of the nearest press, with planes through
its neighbours between presses; a network gives it. 1 % of the presses are farther from those at other places than
{metadata.errors["misfit_p99"]:g}.

## Limits

- The model is valid for this sensor on its rig on the day of the measurement. Another sensor, or the same sensor after
  months, can have far larger errors. `isocharge serve check` measures them with a few presses.
- One press at a time. Outside the working area and forces the answer is finite and wrong; the misfit is then large in
  many cases, not in all.
- The answer is a posterior mean for presses with the distribution of the measured ones. Where the charges carry little
  information, it is therefore close to the centre of the measured presses.

## Make it again

```bash
{metadata.made_with["command"] or "(made by a program, see metadata)"}
```
"""
