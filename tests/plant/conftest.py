from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import coldloop
from coldloop.lti_model import LtiModel, load
from plant.cold_box import REFERENCE, ColdBox, derivative, outputs
from plant.helium.properties import Helium, load_helium
from plant.integrator import advance
from plant.numeric import RealArray


@dataclass(frozen=True)
class Plant:
    """The nonlinear reference plant at its operating point."""

    model: LtiModel
    helium: Helium
    box: ColdBox = REFERENCE

    def rates(self, x: RealArray, u: RealArray, w: float) -> RealArray:
        return derivative(x, u, w, self.box, self.helium)

    def outputs(self, x: RealArray, u: RealArray, w: float) -> dict[str, float]:
        values = outputs(x, u, w, self.box, self.helium)
        return dict(zip(self.model.output_names, values.tolist(), strict=True))

    def simulate(self, x: RealArray, u: RealArray, w: float, seconds: float, dt: float = 0.25) -> RealArray:
        for _ in range(round(seconds / dt)):
            x = advance(x, u, w, dt, self.box, self.helium)
        return x


@pytest.fixture(scope="session")
def model_path() -> Path:
    return Path(coldloop.__file__).parent / "data" / "cold_box_model.json"


@pytest.fixture(scope="session")
def model(model_path: Path) -> LtiModel:
    return load(model_path)


@pytest.fixture(scope="session")
def helium() -> Helium:
    return load_helium()


@pytest.fixture(scope="session")
def plant(model: LtiModel, helium: Helium) -> Plant:
    return Plant(model, helium)


@pytest.fixture
def rest(model: LtiModel) -> tuple[RealArray, RealArray, float]:
    """State, inputs and load at the operating point, free to change."""
    return np.array(model.x0), np.array(model.u0), model.w0
