"""The planner: one network, one Q field per goal, one rollout per start."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import as_cell, as_flag, as_number, as_pose, listed
from ddqn_planner.grid.grid_map import check_grid
from ddqn_planner.model import ModelMetadata, QNetwork, load_model, save_model
from ddqn_planner.planning.cell_planner import CellPlanner
from ddqn_planner.planning.field import QField
from ddqn_planner.planning.path_finder import PathFinder, last_step
from ddqn_planner.planning.plan import (
    Plan,
    PlanMethod,
    PlanRequest,
    PlanStatus,
    Pose,
    PosePlan,
    PoseRequest,
    explained,
    joined,
)
from ddqn_planner.planning.pose_planner import PosePlanner

if TYPE_CHECKING:
    from ddqn_planner.model.robot_network import RobotNetwork

HAS_BODY = "the model plans poses of a body"


class Planner:
    """Plans paths with a trained Q-network, by greedy steps in its Q field.

    Several threads may use one planner.

    Parameters
    ----------
    network : QNetwork
    metadata : ModelMetadata
        Its move rule is the default of `plan` and `q_field`.

    Examples
    --------
    >>> from ddqn_planner import Planner, load_map
    >>> planner = Planner.load("any_map")
    >>> planner.plan(load_map("dilemma"), start=(6, 6), goal=(17, 19))
    Plan(23 cells from (6, 6) to (17, 19), length 25.31)
    """

    def __init__(self, network: QNetwork, metadata: ModelMetadata) -> None:
        """Make a planner of cells, or of poses for a network that knows a body.

        A ValueError if these are no network and no metadata of a model.
        """
        if not (hasattr(network, "move_costs") and hasattr(metadata, "move_rule")):
            values = f"network is {network!r}, metadata is {metadata!r}"
            raise ValueError(f"{values}; give what load_model returns")
        self.network = network
        self.metadata = metadata
        self.cell_planner = CellPlanner(network)
        self.fields = self.cell_planner.fields
        self.pose_planner = None
        if hasattr(network, "motions"):
            self.pose_planner = PosePlanner(cast("RobotNetwork", network))
        # Here alone is the space of paths chosen: poses for a model that knows a body.
        self._finder: PathFinder[Any, Any] = self.pose_planner or self.cell_planner

    def __repr__(self) -> str:
        """Return the network and its training in one line."""
        model = self.metadata
        return (
            f"Planner(network {model.network}, {model.move_rule.value}, trained for "
            f"{model.steps:,} steps with seed {model.seed})"
        )

    @classmethod
    def load(cls, model: str | Path) -> Planner:
        """Load a shipped model by its name (``"any_map"``), or a file by its path.

        A ModelFileError says that there is none, or why it cannot be used.
        """
        return cls(*load_model(model))

    def save(self, path: str | Path) -> None:
        """Save the model to a file for `load`.

        A name without a folder must end in .safetensors, as `load` takes another one
        for a shipped model's; otherwise it is a ValueError. After an OSError, a file
        that was there is unchanged.
        """
        save_model(path, self.network, self.metadata)

    def q_field(
        self, grid: GridMap, goal: Cell, move_rule: MoveRule | str | None = None
    ) -> QField:
        """Return the Q field of a map toward a goal: a kept, a repaired or a new one.

        The move rule is by default the one that the model was trained for. A goal that
        is not free, or a map of a size that the model cannot plan on, is a ValueError.

        Examples
        --------
        >>> from ddqn_planner import Planner, load_map
        >>> grid = load_map("dilemma")
        >>> field = Planner.load("any_map").q_field(grid, (17, 19), "corner_cutting")
        >>> field.q.shape, field.value.shape
        ((8, 20, 20), (20, 20))
        """
        check_grid(grid)
        goal = as_cell(goal, "the goal")
        rule = self._rule(move_rule)
        if self.pose_planner is not None:
            raise ValueError(
                f"{HAS_BODY}: there is no Q field of cells; use plan_poses"
            )
        if not grid.is_free(goal):
            raise ValueError(
                f"the goal {goal} is not a free cell of the map; give another"
            )
        if not self.network.supports((grid.height, grid.width)):
            size = f"{grid.width} x {grid.height} cells"
            raise ValueError(
                f"the model was not trained for maps of {size}; train one on such a map"
            )
        return self.cell_planner.field(grid, (goal,), rule)

    def _rule(self, move_rule: MoveRule | str | None) -> MoveRule:
        """Return the move rule that is named; for None that of the model."""
        return self.metadata.move_rule if move_rule is None else MoveRule(move_rule)

    def plan(
        self,
        grid: GridMap,
        start: Cell,
        goal: Cell,
        move_rule: MoveRule | str | None = None,
        method: PlanMethod | str = PlanMethod.GREEDY,
        tolerance: float = 0.0,
        simplified: bool = False,
        start_clearing_radius: float = 0.0,
    ) -> Plan:
        """Plan a path.

        Parameters
        ----------
        grid : GridMap
        start, goal : (x, y)
        move_rule : MoveRule, optional
            By default the rule that the model was trained for.
        method : PlanMethod
            Whether to search where the greedy steps are trapped.
        tolerance : float
            How far a goal that is occupied or cut off may move, in cells: to the
            nearest free cell that a path reaches.
        simplified : bool
            Whether to leave out cells, see `simplify`.
        start_clearing_radius : float
            For a start on an obstacle: obstacles within this distance of the start, in
            cells, do not count until the path has reached its first free cell, which is
            the one nearest to the start. With 0, all obstacles count.

        Returns
        -------
        Plan
            Every move of its path is legal under the rule, whatever the network says.
            The cells are free, except the first ones of a start that is too near to an
            obstacle, or on one.

        Raises
        ------
        ValueError
            If the tolerance or the radius is negative or NaN, the start or the goal is
            no pair of whole numbers, or there is no such move rule or method.

        Examples
        --------
        >>> from ddqn_planner import Planner, load_map
        >>> planner, grid = Planner.load("any_map"), load_map("dilemma")
        >>> plan = planner.plan(grid, (6, 6), (17, 19), "corner_cutting")
        >>> plan.cells[:3], round(plan.length, 2)
        (((6, 6), (5, 7), (4, 8)), 22.97)
        >>> planner.plan(grid, (6, 6), (99, 19)).reason
        'the goal lies outside the map'
        """
        return self._answer(
            grid,
            start,
            goals=(as_cell(goal, "the goal"),),
            move_rule=move_rule,
            method=method,
            tolerance=tolerance,
            simplified=simplified,
            start_clearing_radius=start_clearing_radius,
        )

    def plan_nearest(
        self,
        grid: GridMap,
        start: Cell,
        goals: Sequence[Cell],
        move_rule: MoveRule | str | None = None,
        method: PlanMethod | str = PlanMethod.GREEDY,
        simplified: bool = False,
        start_clearing_radius: float = 0.0,
    ) -> Plan:
        """Plan a path to the goal that the cheapest path reaches.

        `Plan.goal` tells which that is.

        Goals that are occupied or outside the map are left out. If all are, the status
        says so: GOAL_OCCUPIED if any lies on the map.

        Parameters
        ----------
        grid, start, move_rule, method, simplified, start_clearing_radius
            As for `plan`.
        goals : sequence of (x, y)
            At least one, in any order. No goal moves: there is no tolerance.

        Examples
        --------
        >>> from ddqn_planner import Planner, load_map
        >>> planner, grid = Planner.load("any_map"), load_map("dilemma")
        >>> planner.plan_nearest(grid, (6, 6), [(17, 19), (8, 11)]).goal
        (8, 11)
        """
        return self._answer(
            grid,
            start,
            goals=_cells_of_goals(goals),
            move_rule=move_rule,
            method=method,
            tolerance=0.0,
            simplified=simplified,
            start_clearing_radius=start_clearing_radius,
        )

    def plan_through(
        self,
        grid: GridMap,
        start: Cell,
        goals: Sequence[Cell],
        move_rule: MoveRule | str | None = None,
        method: PlanMethod | str = PlanMethod.GREEDY,
        tolerance: float = 0.0,
        simplified: bool = False,
        start_clearing_radius: float = 0.0,
    ) -> Plan:
        """Plan a path through all goals in their order, see `joined`.

        Parameters
        ----------
        grid, start, move_rule, method, tolerance, simplified, start_clearing_radius
            As for `plan`. The tolerance holds for each goal. A simplified path keeps
            all goals.
        goals : sequence of (x, y)
            At least one. If no path leads to one of them, the plan's goal is that one,
            and its status tells why there is no path.

        Examples
        --------
        >>> from ddqn_planner import Planner, load_map
        >>> planner, grid = Planner.load("any_map"), load_map("dilemma")
        >>> plan = planner.plan_through(grid, (6, 6), [(8, 11), (17, 19)])
        >>> plan.cells.index((8, 11)), plan.goal
        (10, (17, 19))
        """
        plans: list[Plan] = []
        cells = _cells_of_goals(goals)
        for number, goal in enumerate(cells, 1):
            # What a reason begins with.
            name = f"goal {number} of {len(cells)}: " if len(cells) > 1 else ""
            plan = self.plan(
                grid,
                start,
                goal,
                move_rule=move_rule,
                method=method,
                tolerance=tolerance,
                simplified=simplified,
                start_clearing_radius=start_clearing_radius,
            )
            if plan.status is not PlanStatus.SUCCEEDED or plan.goal is None:
                why = plan.explanation
                why = why._replace(cause=f"{name}{why.cause}")
                return explained(replace(plan, goal=goal), why)
            plans.append(plan)
            start = plan.goal
        return joined(plans)

    def plan_poses(
        self,
        grid: GridMap,
        start: Pose,
        goal: Pose | Sequence[Pose],
        tolerance: tuple[float, float] = (0.0, 0.0),
        bound: float = 1.2,
        start_clearing_radius: float = 0.0,
        either_direction: bool = False,
        prove: bool = True,
    ) -> PosePlan:
        """Plan a path for a robot with a body and a heading, by a model of that robot.

        Parameters
        ----------
        grid : GridMap
            With cells of the size that the robot learned.
        start : (x, y, yaw)
            Metres and radians in the map frame. The path begins there, or, where the
            body has no room to drive on from there, in the middle of the start's cell,
            with one of the headings: the nearest one, or else the next, where the body
            has room. A planner keeps its last path to each of the goals
            used last: if the start lies within half a cell and 11.25 degrees of that
            path, the plan is the rest of it.
        goal : (x, y, yaw), or several
            Likewise; of several, the one that the cheapest path reaches.
        tolerance : (float, float)
            Metres and radians by which a goal may move if the body has no room there,
            or if no path leads to it. With pi radians or more, goals have no heading:
            the path ends in the heading that costs least.
        bound : float
            The factor by which the cost of a path may exceed the least cost, 1 or more.
            With 1 a path of the least cost is found, which takes longer; with
            `math.inf` any path.
            `PosePlan.bound` tells what is proved of the path.
        start_clearing_radius : float
            For a start without room for the body: occupied cells that the body covers
            there do not count until the first free pose, if their centres are no
            farther than this from that of the start's cell, in metres. With 0, all
            cells count; with `math.inf`, none of those under the body.
        either_direction : bool
            Whether the robot may also arrive with the opposite of the goal's heading.
        prove : bool
            Whether the bound is proved before the path is returned. Without, it is the
            first path that is found, and `PosePlan.bound` is what is proved of it by
            then: so a robot drives off early, and the same request with a proof goes on
            from there.

        Returns
        -------
        PosePlan
            From pose number `PosePlan.escape` on, its path touches no occupied cell.
            The number is 0 unless the path leads out of obstacles at the start.

        Raises
        ------
        ValueError
            If the model knows no body, the map's resolution is another, or an argument
            is wrong.
        """
        check_grid(grid)
        request = PoseRequest(
            grid,
            as_pose("the start", start),
            _poses_of_goals(goal),
            tolerance=_tolerance_of_poses(tolerance),
            bound=as_number("the bound", bound, 1, math.inf, "1 or more"),
            start_clearing_radius=as_number(
                "start_clearing_radius",
                start_clearing_radius,
                0,
                math.inf,
                "0 metres or more",
            ),
            either_direction=as_flag("either_direction", either_direction),
            is_bound_proved=as_flag("prove", prove),
        )
        if self.pose_planner is None:
            raise ValueError(
                "the model knows no body; give one of ddqn-planner train-robot"
            )
        return last_step(self.pose_planner.steps(request))

    def steps(self, request: PlanRequest | PoseRequest) -> Iterator[Plan | None]:
        """Yield None before each slow step (a part of a field, a search).

        Last of all, yield the plan. The request is for the space of the model: cells,
        or the poses of a body.
        """
        return self._finder.steps(request)

    def rest_of_path(self, request: PlanRequest | PoseRequest) -> NDArray[Any]:
        """Return the rest of the path under way, cells (N, 2) or poses (N, 3).

        It is empty if the start is far from that path, or the rest is not free.
        """
        return self._finder.rest_of_path(request)

    def _answer(
        self,
        grid: GridMap,
        start: Cell,
        *,
        goals: tuple[Cell, ...],
        move_rule: MoveRule | str | None,
        method: PlanMethod | str,
        tolerance: float,
        simplified: bool,
        start_clearing_radius: float,
    ) -> Plan:
        """Check the arguments and return the plan to the nearest of one or more goals.

        The goals, (x, y) each, are checked already. All other arguments are those of
        `plan`; a ValueError says what is wrong with them.
        """
        rule = self._rule(move_rule)
        check_grid(grid)
        if self.pose_planner is not None:
            raise ValueError(f"{HAS_BODY}; use plan_poses, or a planner_node")
        at_least_zero = 0, math.inf, "0 cells or more"  # the range, and its words
        request = PlanRequest(
            grid,
            as_cell(start, "the start"),
            goals,
            move_rule=rule,
            method=PlanMethod(method),
            tolerance=as_number("the tolerance", tolerance, *at_least_zero),
            simplified=as_flag("simplified", simplified),
            start_clearing_radius=as_number(
                "start_clearing_radius", start_clearing_radius, *at_least_zero
            ),
        )
        return last_step(self.cell_planner.steps(request))


def _tolerance_of_poses(tolerance: Any) -> tuple[float, float]:
    """Return a tolerance (metres, radians), each 0 or more; a ValueError for others."""
    two_numbers = "two numbers (metres, radians), each 0 or more"
    remedy = f"give {two_numbers}"
    wrong = ValueError(f"the tolerance is {tolerance!r}; {remedy}")
    if isinstance(tolerance, str):
        raise wrong
    values = listed(tolerance, "the tolerance", remedy)
    if len(values) != 2:
        raise wrong
    metres, radians = (
        as_number("the tolerance", value, 0, math.inf, two_numbers) for value in values
    )
    return metres, radians


def _poses_of_goals(goal: Any) -> tuple[Pose, ...]:
    """Return the poses of one goal (x, y, yaw), or of a sequence of goals.

    A ValueError if a goal is no pose, or if there is none.
    """
    values = listed(goal, "the goal", "give a pose (x, y, yaw), or several")
    if not values:
        raise ValueError("there is no goal; give at least one pose (x, y, yaw)")
    # The values are poses if one of them is a sequence, else the numbers of one pose.
    are_poses = any(isinstance(value, (Sequence, np.ndarray)) for value in values)
    poses = values if are_poses else [values]
    return tuple(as_pose("the goal", pose) for pose in poses)


def _cells_of_goals(goals: Sequence[Cell]) -> tuple[Cell, ...]:
    """Return the cells of one or more goals, checked."""
    numbered = enumerate(listed(goals, "goals"), 1)
    cells = tuple(as_cell(goal, f"goal {number}") for number, goal in numbered)
    if not cells:
        raise ValueError("there is no goal; give at least one cell")
    return cells
