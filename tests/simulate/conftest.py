"""What the simulator's tests share: films, random fields, the independent reference cases."""

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from isocharge.simulate import (
    STANDARD,
    Circle,
    Equilibrium,
    Film,
    ForwardMap,
    Resolution,
    Sensor,
    Sweep,
    load_sensor,
    write_sweep,
)
from isocharge.simulate.membrane import Groups
from isocharge.simulate.template import Placement, Template, template

REFERENCE = json.loads((Path(__file__).parents[1] / "data/film_cases.json").read_text())


@dataclass(frozen=True)
class ReferenceCase:
    """A press that an independent solver solved, with bending."""

    film: Film
    probe: Circle
    at: tuple[float, float]
    force: float
    deflection: float
    charges: dict[str, np.ndarray]

    def sensor(self, key: str) -> Sensor:
        """The sensor of a key such as "three-biaxial-area"."""
        layout, kind, readout = key.split("-")
        return replace(load_sensor(f"{layout}-25um-{kind}"), film=self.film, readout=readout)


def read_cases(thickness_um: float) -> list[ReferenceCase]:
    """The cases with circular probes on films of one thickness."""
    film = REFERENCE["film"]
    return [
        ReferenceCase(
            film=Film(
                film["radius_mm"] * 1e-3,
                thickness_um * 1e-6,
                film["young_GPa"] * 1e9,
                film["poisson"],
                case["pretension_MPa"] * 1e6,
            ),
            probe=Circle(case["probe"]["radius_mm"] * 1e-3),
            at=(case["at_mm"][0] * 1e-3, case["at_mm"][1] * 1e-3),
            force=case["force_N"],
            deflection=case["deflection_mm"] * 1e-3,
            charges={key: 1e-12 * np.array(list(q.values())) for key, q in case["touch_charge_pC"].items()},
        )
        for case in REFERENCE["cases"]
        if case["thickness_um"] == thickness_um and case["probe"]["shape"] == "circle"
    ]


def name_case(case: ReferenceCase) -> str:
    """A test id."""
    x, y = (round(1e3 * value) for value in case.at)
    return (
        f"{case.film.thickness * 1e6:.0f}um-{case.film.pretension * 1e-6:g}MPa-R{case.probe.radius * 1e3:g}"
        f"-at({x},{y})-{case.force:g}N"
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """`case` runs over the reference cases of the 25 um film, `thicker_case` over those of the 110 um film."""
    for argument, thickness_um in (("case", 25.0), ("thicker_case", 110.0)):
        if argument in metafunc.fixturenames:
            metafunc.parametrize(argument, read_cases(thickness_um), ids=name_case)


@pytest.fixture(scope="session")
def reference_cases() -> Callable[[float], list[ReferenceCase]]:
    """The reference cases of a thickness in um."""
    return read_cases


@pytest.fixture(scope="session")
def film() -> Film:
    """The film of the built-in sensors."""
    return load_sensor("three-25um-biaxial").film


@pytest.fixture(scope="session")
def coarse() -> Template:
    """A small template."""
    return template(Resolution(order=4, around=8, rings=2))


@pytest.fixture(scope="session")
def off_centre() -> Placement:
    """A placement far from any symmetry: a footprint of 0.11 film radii at 0.4."""
    return Placement.of_circle(0.4, 0.11)


@pytest.fixture(scope="session")
def random_field() -> Callable[[Template, int], np.ndarray]:
    """A field of random nodal values, zero on the rim: as rough as the mesh can carry."""

    def draw(mesh: Template, seed: int) -> np.ndarray:
        field = 0.1 * np.random.default_rng(seed).standard_normal((mesh.n_node, 3))
        field[mesh.n_free :] = 0.0
        return field

    return draw


@pytest.fixture(scope="session")
def linear_equilibrium(film: Film) -> Callable[..., Equilibrium]:
    """A made-up equilibrium whose field is linear over the film: gradient[a, i] = d(U1, U2, W)_i / dX_a, scaled."""

    def make(
        gradient: np.ndarray, at: tuple[float, float] = (0.0, 0.0), amplitude2: float = 0.1, of: Film = film
    ) -> Equilibrium:
        mesh, placement = template(STANDARD), Placement.of_circle(np.hypot(*at) / of.radius, 1e-3 / of.radius)
        points = placement.to_film(mesh.node_points(placement.rho))
        field = np.stack([points.real, points.imag], axis=1) @ gradient
        groups = Groups(amplitude2, 1.0, 0.0, of.poisson)
        return Equilibrium(of, Circle(1e-3), at, 1.0, STANDARD, field, groups, "converged", "made up", 0, 0.0, 0.0)

    return make


@pytest.fixture(scope="session")
def three_map() -> ForwardMap:
    """The forward map of the released model's sensor."""
    return ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1e-3))


@pytest.fixture(scope="session")
def small_dataset(three_map: ForwardMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 500 samples; not to be written to."""
    return write_sweep(tmp_path_factory.mktemp("data") / "presses", (three_map,), Sweep(samples=500, seed=7))


@pytest.fixture(scope="session")
def two_processes() -> Iterator[ProcessPoolExecutor]:
    """Workers that share nothing with this process."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool
