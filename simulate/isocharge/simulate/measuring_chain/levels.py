"""The named levels of the measuring chain: clean, reference, bench, surgery, as noise and as amplifier."""

from dataclasses import replace

from isocharge.simulate.measuring_chain.amplifier import Amplifier
from isocharge.simulate.measuring_chain.noise import NoiseModel

NOISE_LEVELS = {
    "clean": NoiseModel("clean", 0.0, 0.0),
    "reference": NoiseModel("reference", 1.0, 2e-3),
    "bench": NoiseModel("bench", 0.3, 0.0),
    "surgery": NoiseModel("surgery", 1.0, 0.0),
}
"""Noise levels by name. For `bench` and `surgery` this is the memoryless part of their amplifiers below."""

BENCH = Amplifier(
    noise=NOISE_LEVELS["bench"],
    tau=10.0,
    tau_mismatch=0.05,
    gain_mismatch=0.01,
    hum=1.0,
    offset=2.0,
    bias=0.5,
    temperature_rms=0.05,
    limit=1500.0,
    bits=16,
)

AMPLIFIER_LEVELS = {
    "clean": Amplifier(noise=NOISE_LEVELS["clean"]),
    "reference": Amplifier(noise=NOISE_LEVELS["reference"]),
    "bench": BENCH,
    "surgery": replace(BENCH, noise=NOISE_LEVELS["surgery"], hum=5.0, step=0.5),
}
