import numpy as np
import pytest

from stereoweave.synth.props.deckhouses import ShipMaterials
from stereoweave.synth.props.ships import TRADES

PAINTS = ShipMaterials(house=0, roof=1, trim=2, white=3, dark=4, glass=5, steel=6, orange=7, rope=8)


@pytest.mark.parametrize("trade", TRADES)
def test_the_house_stands_on_deck_within_the_hull(trade):
    for seed in range(10):
        plan = TRADES[trade](np.random.default_rng(seed))
        foot, _ = plan.house.corners_m()
        for x, y, z in foot:
            inside = plan.hull.side_m(x / plan.hull.length_m + 0.5, z, 1)
            assert abs(y) < inside[1]
            assert z < plan.hull.deck_m(x)


@pytest.mark.parametrize("trade", TRADES)
def test_the_bridge_stands_on_the_house(trade):
    plan = TRADES[trade](np.random.default_rng(0))
    assert plan.bridge.z_m[0] == pytest.approx(plan.house.z_m[1] + 0.04)
    assert plan.house.x_m[0] <= plan.bridge.x_m[0]
    assert plan.bridge.x_m[1] <= plan.house.x_m[1] + 0.1


@pytest.mark.parametrize("trade", TRADES)
def test_the_gear_stands_above_the_deck_and_uses_the_given_materials(trade):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        plan = TRADES[trade](rng)
        gear = plan.build_gear(rng, plan, PAINTS, (9, 10, 11))
        assert gear.corners_m[..., 2].min() > plan.hull.deck_m(0.0) - 0.06
        assert set(np.unique(gear.material)) <= set(range(12))
        assert np.abs(gear.corners_m[..., 0]).max() < plan.hull.length_m / 2 + 0.6
