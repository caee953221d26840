import numpy as np
import pytest

from ddqn_planner import GridMap, MoveRule, Planner
from ddqn_planner.grid import UNKNOWN
from ddqn_planner.grid.noise import random_costs
from ddqn_planner.model.certificate import MOVE_RULES
from ddqn_planner.training.any_map import ANY_MAP, MAPS, random_scenarios
from ddqn_planner.training.evaluation import Evaluation, evaluate
from ddqn_planner.training.trainer import Trainer

BRIEF = 96_000
"""Environment steps that are enough to learn every move, and the cost multipliers
roughly.
"""


@pytest.fixture(scope="module")
def planner() -> Planner:
    trainer = Trainer(random_scenarios(seed=0), ANY_MAP, seed=0)
    for _ in trainer.run(BRIEF):
        pass
    return trainer.planner()


def evaluation_of(planner: Planner, grid: GridMap, rule: MoveRule) -> Evaluation:
    """How good the network is on a map, without action masking."""
    goal = grid.free_cells()[-1]
    return evaluate(planner.q_field(grid, goal, rule).unmasked(), grid, rule)


@pytest.mark.slow(seconds=20)
@pytest.mark.parametrize("rule", MOVE_RULES)
def test_training_on_random_maps_learns_moves_and_costs(
    planner: Planner, rule: MoveRule
) -> None:
    random = np.random.default_rng(2)
    rooms = np.zeros((24, 30), dtype=bool)
    rooms[::8] = rooms[:, ::10] = True
    rooms[4::8, ::10] = rooms[::8, 5::10] = False  # doors
    rooms |= random.random((24, 30)) < 0.05
    evaluation = evaluation_of(planner, GridMap(rooms), rule)
    assert evaluation.solved == evaluation.starts > 100
    assert evaluation.worst_ratio < 1.3

    cost = np.where(random.random((24, 30)) < 0.2, UNKNOWN, random_costs(rooms, random))
    with_costs = GridMap(rooms, cost=cost.astype(np.int8))
    evaluation = evaluation_of(planner, with_costs, rule)
    assert evaluation.solved == evaluation.starts > 100
    # A planner that does not see the costs takes the shortest path, which costs more.
    goal = with_costs.free_cells()[-1]
    blind = evaluate(planner.q_field(GridMap(rooms), goal, rule), with_costs, rule)
    assert evaluation.mean_ratio < (1 + blind.mean_ratio) / 2


def test_the_maps_to_train_on_are_those_of_the_seed_and_have_costs_of_every_sort() -> (
    None
):
    scenarios, *others = (random_scenarios(seed) for seed in (3, 3, 4))
    said, same, other = (
        [(each.grid.fingerprint, each.start, each.goal) for each in some]
        for some in (scenarios, *others)
    )
    assert said == same
    assert said[0] != other[0]
    for scenario in scenarios:
        joined = scenario.grid.reachable([scenario.goal], scenario.move_rule)
        assert joined[scenario.start[1], scenario.start[0]]
    assert {scenario.move_rule for scenario in scenarios} == set(MOVE_RULES)
    grids = [scenario.grid for scenario in scenarios]
    assert len(grids) == MAPS
    filled = [grid.occupancy.mean() for grid in grids]
    assert min(filled) < 0.15 < 0.55 < max(filled)
    costs = [grid.cost[~grid.occupancy] for grid in grids if grid.cost is not None]
    alike = [int(cost[0]) for cost in costs if len(np.unique(cost)) == 1]
    assert MAPS / 8 < len(alike) < len(costs) < MAPS
    assert min(alike) < 10 < 90 < max(alike)
    assert any((cost == UNKNOWN).any() for cost in costs)
    assert any(len(np.unique(cost)) > 20 for cost in costs)
