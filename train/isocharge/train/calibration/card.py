"""The card of a calibrated film: what it is known to, what it cannot be known to, how to make it again."""

from collections.abc import Mapping

from isocharge.serve.model.metadata import ModelMetadata
from isocharge.train.calibration.calibrate import Calibration
from isocharge.train.calibration.quantities import Quantity


def calibration_card(calibration: Calibration, metadata: ModelMetadata, picture: str) -> str:
    """The text of `card.md`; `picture` is the file beside it."""
    sections = [
        _summary(calibration, metadata),
        f"![error left, quantities, misses]({picture})\n",
        _quantities(calibration.quantities),
        _errors(metadata.errors),
        LIMITS,
        _command(metadata),
    ]
    return "\n".join(sections)


def _summary(calibration: Calibration, metadata: ModelMetadata) -> str:
    sensor, probe = calibration.film
    low, high = metadata.force_range_N
    words = "\n".join(f"- {sentence}" for sentence in calibration.words)
    return f"""# {metadata.name}, version {metadata.version}: a calibrated film

The sensor `{sensor.name}`, calibrated on {len(calibration.presses)} presses with `{probe.notation}` (radius as found).
The model answers within {calibration.scene.domain.radius_mm:g} mm of the centre, {low:g} to {high:g} N.

{words}
"""


def _quantities(table: Mapping[str, Quantity]) -> str:
    rows = "\n".join(
        f"| `{quantity.name}` | {quantity.meaning} | {quantity.value:.4g} | {quantity.std:.2g} | "
        f"{quantity.before_std:.2g} | {'yes' if quantity.identified else 'no'} |"
        for quantity in table.values()
    )
    return f"""## The film

| quantity | what it is | value | standard deviation | before | identified |
|---|---|---|---|---|---|
{rows}

Identified: the presses at least halved its standard deviation. `sensor.toml` has single parameters, of which only the
combinations above are known; `calibration.json` has their correlations.
"""


def _errors(errors: Mapping[str, float]) -> str:
    return f"""## The model on this film

On fresh simulated presses of the film as calibrated, with noise:

| error | figure |
|---|---|
| position, median | {errors["position_median_mm"]:g} mm |
| position, rms | {errors["position_rms_mm"]:g} mm |
| force, rms | {errors["force_rms_percent"]:g} % |

What not knowing the film leaves comes on top; `contact_std` has it in, as a common factor.
"""


LIMITS = """## Limits

- The film's theory is the simulator's: clamped round its edge, flat, of even thickness. What a real film adds to that
  (a loose rim, wrinkles, a seam under an electrode) shows as misses above 1 in the picture, not in the errors here.
- Pretension creeps and coefficients age. Press a few times now and then and ask `isocharge serve check`; calibrate
  again with `--from` this folder.
- Positions refer to the rig's zero: an offset of the rig is taken for a shift of the electrodes.
"""


def _command(metadata: ModelMetadata) -> str:
    return f"""## Make it again

```bash
{metadata.made_with.get("command") or "(made by a program, see metadata)"}
```
"""
