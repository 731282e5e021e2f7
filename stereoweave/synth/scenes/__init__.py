"""Registry of scenes: functions that each build a random stage."""

from collections.abc import Callable

import numpy as np

from stereoweave.synth.scenes.antenna import antenna
from stereoweave.synth.scenes.bridge import bridge
from stereoweave.synth.scenes.crane import crane
from stereoweave.synth.scenes.figures import figures
from stereoweave.synth.scenes.plain_boards import plain_boards
from stereoweave.synth.scenes.propeller import propeller
from stereoweave.synth.scenes.pylon import pylon
from stereoweave.synth.scenes.refinery import refinery
from stereoweave.synth.scenes.rooms import rooms
from stereoweave.synth.scenes.ship import ship
from stereoweave.synth.scenes.street import street
from stereoweave.synth.scenes.wind_turbine import wind_turbine
from stereoweave.synth.stage import Stage

SCENES: dict[str, Callable[[np.random.Generator], Stage]] = {
    "antenna": antenna,
    "boards": plain_boards,
    "bridge": bridge,
    "crane": crane,
    "figures": figures,
    "propeller": propeller,
    "pylon": pylon,
    "refinery": refinery,
    "rooms": rooms,
    "ship": ship,
    "street": street,
    "wind_turbine": wind_turbine,
}
