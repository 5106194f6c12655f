"""The model card: what a model is for, what it reaches, what it cannot do, and how to make it again."""

from collections.abc import Mapping

from isocharge.serve.model.metadata import ModelMetadata
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.model_release.evaluate import HELD_PRESSES
from isocharge.train.training.fit import Fitted

SIMULATED_TRUTH = """\
- The truth behind these figures is the simulator, not a film. On a real film, pretension and gains that
  nobody has measured matter more.
"""

MEASURED_TRUTH = """\
- The model was fitted to measurements of one film. The errors are those of that film and its rig on the day of the
  measurement; another film, or this one after months, can differ by far more. `isocharge serve check` says so from a
  few presses.
"""

LIMITS = """\
- One press at a time. Outside the working area and forces the answer is finite and wrong; the misfit is then large in
  many cases, not in all.
- The deviations hold for the noise named above; gains that are off by 1 % add more than all of it.
"""


def model_card(metadata: ModelMetadata, fitted: Fitted) -> str:
    """The text of `card.md`."""
    if fitted.test.measured:
        errors, truth = fitted.provenance.card + _measured_errors(metadata.errors), MEASURED_TRUTH
    else:
        errors, truth = _errors(metadata.errors, len(fitted.test)), SIMULATED_TRUTH
    cautions = "".join(f"- {caution}.\n" for caution in fitted.cautions)
    return f"""{_interface(metadata, fitted)}
{errors}
{_misfit(metadata, fitted)}
## Limits

{truth}{cautions}{LIMITS}
## Make it again

```bash
{metadata.made_with["command"] or "(made by a program, see metadata)"}
```
"""


def _interface(metadata: ModelMetadata, fitted: Fitted) -> str:
    (low, high), noise, teacher = metadata.force_range_N, metadata.noise, metadata.made_with.get("teacher")
    electrodes = ", ".join(metadata.electrodes)
    taught = f"\nA small network that learned the answers of `{teacher}`." if teacher else ""
    folded = f" (of {fitted.asked.radius:g} mm asked for: beyond, two contacts give the same charges)"
    unknown_probe = "; which of them presses is not known to the model" if len(metadata.probes) > 1 else ""
    return f"""# {metadata.name}, version {metadata.version}

Touch charges of the sensor `{metadata.sensor["name"]}` in, place and force of one press out.{taught}

| | |
|---|---|
| input | `charge_pC`, float32 [n, {len(metadata.electrodes)}], touch charges of {electrodes} in pC |
| outputs | `contact` (x_mm, y_mm, force_N), `contact_std` (one standard deviation of each), `misfit` |
| working area | within {fitted.domain.radius:g} mm of the centre{folded if fitted.asked != fitted.domain else ""} |
| forces | {low:g} to {high:g} N |
| probes | {", ".join(metadata.probes)}{unknown_probe} |
| trained for the noise | {noise["name"]}: {noise["white_pC"]:g} pC and {100 * float(noise["gain"]):g} % |
"""


def _errors(errors: Mapping[str, float], presses: int) -> str:
    return f"""## Measured on {presses} presses that training never saw

Forces log-uniform, positions uniform over the working area.

| error | with that noise | clean charges |
|---|---|---|
| position, median | {errors["position_median_mm"]:g} mm | {errors["clean_position_median_mm"]:g} mm |
| position, rms | {errors["position_rms_mm"]:g} mm | |
| position, 95 % | {errors["position_p95_mm"]:g} mm | {errors["clean_position_p95_mm"]:g} mm |
| position, 99 % | {errors["position_p99_mm"]:g} mm | |
| force, median | {errors["force_median_percent"]:g} % | |
| force, rms | {errors["force_rms_percent"]:g} % | |
| force, 99 % | {errors["force_p99_percent"]:g} % | |
| coverage of the 68 % intervals | {100 * errors["coverage_68"]:.3g} % | |
| coverage of the 95 % intervals | {100 * errors["coverage_95"]:.3g} % | |
"""


def _measured_errors(errors: Mapping[str, float]) -> str:
    return f"""## Errors on {errors[HELD_PRESSES]:.0f} measured presses that training never saw

The presses as they were measured: no noise was added, and what the rig does not know of places and forces is in the
errors.

| error | on measured presses |
|---|---|
| position, median | {errors["position_median_mm"]:g} mm |
| position, rms | {errors["position_rms_mm"]:g} mm |
| position, 95 % | {errors["position_p95_mm"]:g} mm |
| force, median | {errors["force_median_percent"]:g} % |
| force, rms | {errors["force_rms_percent"]:g} % |
| coverage of the 68 % intervals | {100 * errors["coverage_68"]:.3g} % |
| coverage of the 95 % intervals | {100 * errors["coverage_95"]:.3g} % |
"""


def _misfit(metadata: ModelMetadata, fitted: Fitted) -> str:
    errors, unit, shares = metadata.errors, misfit_noise(fitted.noise), ""
    simulated = "simulated good presses" if fitted.test.measured else "good presses"
    good = "measured presses" if fitted.good.measured else simulated
    of_unit = f" `{unit.name}` (1 pC and 0.2 %)" if unit != fitted.noise else ""
    rare = f",\n0.1 % exceed {errors['misfit_p999']:g}" if "misfit_p999" in errors else ""
    if "found_dead_electrode" in errors:
        shares = (
            f"Of presses of about 1 N the former finds {100 * errors['found_gain_20_percent']:.3g} % where one gain\n"
            f"is off by 20 %, and {100 * errors['found_dead_electrode']:.3g} % where one electrode is dead."
        )
    sees = "Charges that disagree with each other (a wrong gain, a dead electrode, two presses) raise it."
    if len(metadata.electrodes) == 3:
        sees = (
            "Three charges and three unknowns: nearly every triple fits some contact, so it sees only what leads out\n"
            "of the working area or the forces."
        )
    return f"""\
The misfit is the distance, in units of the noise{of_unit}, of the charges from the nearest single contact that the
model knows; a network gives it, learned from exact searches. 1 % of {good} exceed {errors["misfit_p99"]:g}{rare}.
{sees}
{shares}
"""
