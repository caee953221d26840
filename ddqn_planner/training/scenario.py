"""The task of a training: a map with a start and a goal."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ddqn_planner.grid import Cell, GridMap, MoveRule, read_map_file
from ddqn_planner.grid.arguments import as_cell
from ddqn_planner.grid.grid_map import check_grid
from ddqn_planner.grid.map_file import map_path


@dataclass(frozen=True)
class Scenario:
    """A map with a start and a goal; a ValueError unless a path joins them.

    Examples
    --------
    >>> from ddqn_planner import load_map
    >>> from ddqn_planner.training import Scenario
    >>> Scenario(load_map("dilemma"), start=(6, 6), goal=(17, 19)).move_rule.value
    'corner_cutting'
    >>> Scenario(load_map("dilemma"), start=(6, 6), goal=(6, 6))
    Traceback (most recent call last):
    ValueError: start and goal are both (6, 6); give two different cells
    """

    grid: GridMap
    start: Cell
    goal: Cell
    move_rule: MoveRule = MoveRule.CORNER_CUTTING  # the paper's, likely

    def __post_init__(self) -> None:
        """Check the fields, and that a path leads from the start to the goal."""
        check_grid(self.grid)
        start = as_cell(self.start, "the start")
        goal = as_cell(self.goal, "the goal")
        # The dataclass is frozen.
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "goal", goal)
        object.__setattr__(self, "move_rule", MoveRule(self.move_rule))
        for name, cell in (("start", start), ("goal", goal)):
            if not self.grid.is_free(cell):
                raise ValueError(
                    f"the {name} {cell} is not a free cell of the map; give another"
                )
        if start == goal:
            raise ValueError(
                f"start and goal are both {start}; give two different cells"
            )
        if not self._leads_to_goal(self.move_rule):
            rules = [rule.value for rule in MoveRule if self._leads_to_goal(rule)]
            remedy = f"give the move rule {rules[0]}" if rules else "open the map"
            raise ValueError(
                f"no path leads from the start {start} to the goal {goal} under the "
                f"move rule {self.move_rule.value}; give other cells, or {remedy}"
            )

    def _leads_to_goal(self, move_rule: MoveRule) -> bool:
        """Return whether a path of legal moves leads from the start to the goal."""
        reached = self.grid.reachable([self.start], move_rule)
        return bool(reached[self.goal[1], self.goal[0]])


def paper_scenario() -> Scenario:
    """Return the paper's map with its start and goal."""
    return map_scenario("dilemma")


def map_scenario(name: str | Path) -> Scenario:
    """Return a map with the start and the goal that its file names.

    `name` is a shipped map's, or a path, as of `load_map`, which names the
    errors. A ValueError if the file names no start or no goal.
    """
    map_file = read_map_file(map_path(name))
    if map_file.start is None or map_file.goal is None:
        raise ValueError(
            f"the map {name} names no start and goal; give Scenario(grid, start, goal)"
        )
    return Scenario(map_file.grid(), map_file.start, map_file.goal)


def check_scenarios(scenarios: Sequence[Scenario]) -> None:
    """Raise a ValueError unless there are scenarios, all with maps of one size."""
    if not scenarios:
        raise ValueError(f"the scenarios are {scenarios!r}; give at least one Scenario")
    for item in scenarios:
        if not isinstance(item, Scenario):
            raise ValueError(
                f"the scenarios hold a {type(item).__name__}; give "
                "Scenario(grid, start, goal)"
            )
    shapes = {scenario.grid.occupancy.shape for scenario in scenarios}
    if len(shapes) != 1:
        raise ValueError(
            f"the maps have the sizes {sorted(shapes)}; give maps of one size"
        )
