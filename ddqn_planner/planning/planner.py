"""The planner: one network, one Q field per goal, one rollout per start."""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import (
    Cells,
    as_cell,
    as_flag,
    as_number,
    as_pose,
    listed,
)
from ddqn_planner.grid.grid_map import check_grid
from ddqn_planner.model import ModelMetadata, QNetwork, load_model, save_model
from ddqn_planner.planning import unknown_space
from ddqn_planner.planning.field import DistanceField, FieldCache, Goals, QField
from ddqn_planner.planning.paths import keep_or_switch, search, way_and_ends
from ddqn_planner.planning.plan import (
    Plan,
    PlanMethod,
    PlanRequest,
    PlanStatus,
    PosePlan,
    joined,
)
from ddqn_planner.planning.pose_paths import cost_of_poses
from ddqn_planner.planning.pose_planner import Pose, PosePlanner, PoseRequest
from ddqn_planner.planning.segments import SAME_COST, cost_along, straightened

AnyPlan = TypeVar("AnyPlan", bound=Plan)

HAS_BODY = "the model plans poses of a body"
VISITS = 2**18  # about how many cells a field visits in one step of a plan: some 30 ms


class Planner:
    """Plans paths with a trained Q-network, by greedy steps in its Q field.

    Several threads may use one planner.

    Parameters
    ----------
    network : QNetwork
    metadata : ModelMetadata
        Its move rule is the default of `plan` and `q_field`.
    """

    def __init__(self, network: QNetwork, metadata: ModelMetadata) -> None:
        if not (hasattr(network, "move_costs") and hasattr(metadata, "move_rule")):
            given = f"network is {network!r}, metadata is {metadata!r}"
            raise ValueError(f"{given}; give what load_model returns")
        self.network = network
        self.metadata = metadata
        self.fields = FieldCache(network)
        self.pose_planner = (
            PosePlanner(network) if hasattr(network, "motions") else None
        )

    @classmethod
    def load(cls, model: str | Path) -> Planner:
        """Load a shipped model by its name (``"any_map"``), or a model file by its path.

        A ModelFileError says that there is none, or why it cannot be used.
        """
        return cls(*load_model(model))

    def save(self, path: str | Path) -> None:
        """Save the model to a file for `load`; after an OSError, an old file is unchanged."""
        save_model(path, self.network, self.metadata)

    def q_field(
        self, grid: GridMap, goal: Cell, move_rule: MoveRule | str | None = None
    ) -> QField:
        """Return the Q field of a map toward a goal, a free cell, computed or from the cache.

        The move rule is by default the one that the model was trained for. A goal that is not free,
        or a map of a size that the model cannot plan on, is a ValueError.
        """
        check_grid(grid)
        goal, rule = as_cell(goal, "the goal"), self._rule(move_rule)
        if self.pose_planner is not None:
            raise ValueError(
                f"{HAS_BODY}: there is no Q field of cells; use plan_poses"
            )
        if not grid.is_free(goal):
            raise ValueError(
                f"the goal {goal} is not a free cell of the map; give another"
            )
        if not self.network.supports((grid.height, grid.width)):
            problem = f"the model was not trained for maps of {grid.width} x {grid.height} cells"
            raise ValueError(f"{problem}; train one on such a map")
        return self.fields.get(grid, (goal,), rule)

    def _rule(self, move_rule: MoveRule | str | None) -> MoveRule:
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
            How far a goal that is occupied or cut off may move, in cells: to the nearest free cell
            that a path reaches.
        simplified : bool
            Whether to leave out cells, see `simplify`.
        start_clearing_radius : float
            Where the start is an obstacle, those within so many cells of it do not count until the
            path has reached its first free cell, the nearest one. With 0 they count.

        Returns
        -------
        Plan
            Every move of its path is legal under the rule, whatever the network says. The cells
            are free, except the first ones of a start that is too near to an obstacle, or on one.

        Raises
        ------
        ValueError
            If the tolerance or the radius is negative or NaN, the start or a goal is no pair of
            whole numbers, or there is no goal or no such move rule or method.
        """
        how = move_rule, method, tolerance, simplified, start_clearing_radius
        return self._answer(grid, start, [as_cell(goal, "the goal")], how)

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
        """Plan a path to the goal that the cheapest path reaches; `Plan.goal` tells which.

        Goals that are occupied or outside the map are left out. If all are, the status says so:
        GOAL_OCCUPIED if any lies on the map.

        Parameters
        ----------
        grid, start, move_rule, method, simplified, start_clearing_radius
            As for `plan`.
        goals : sequence of (x, y)
            At least one, in any order. No goal moves: there is no tolerance.
        """
        how = move_rule, method, 0.0, simplified, start_clearing_radius
        return self._answer(grid, start, _cells_of_goals(goals), how)

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
            As for `plan`. The tolerance holds for each goal. A simplified path keeps all goals.
        goals : sequence of (x, y)
            At least one. If one has no path, the plan's status tells why, and its goal which.
        """
        plans: list[Plan] = []
        how = move_rule, method, tolerance, simplified, start_clearing_radius
        cells = _cells_of_goals(goals)
        for number, goal in enumerate(cells, 1):
            name = f"goal {number} of {len(cells)}: " if len(cells) > 1 else ""
            plan = self.plan(grid, start, goal, *how)
            if plan.status is not PlanStatus.SUCCEEDED or plan.goal is None:
                return replace(plan, goal=goal, reason=f"{name}{plan.reason}")
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
    ) -> PosePlan:
        """Plan a path for a robot with a body and a heading, with a model that learned it.

        Parameters
        ----------
        grid : GridMap
            With cells of the size that the robot learned.
        start : (x, y, yaw)
            Metres and radians in the map frame. The path begins in the middle of its cell, with one
            of 16 headings: the nearest one, or else the next, where the body has room. Where at
            most half a cell and 11.25 degrees part it from the path planned last, the plan is the
            rest of that path.
        goal : (x, y, yaw), or several
            Likewise; of several, the one that the cheapest path reaches.
        tolerance : (float, float)
            Metres and radians by which a goal without room or without a way may move.
        bound : float
            How many times the least cost a path may have at most, 1 or more: with 1 it is the
            least, and takes longer. `PosePlan.bound` tells what is proved of the path.

        Returns
        -------
        PosePlan
            No pose of its path touches an occupied cell.

        Raises
        ------
        ValueError
            If the model knows no body, the map's resolution is another, or an argument is wrong.
        """
        check_grid(grid)
        metres, radians = _tolerance_of_poses(tolerance)
        least = as_number("the bound", bound, 1, math.inf, "1 or more")
        goals = _poses_of_goals(goal)
        request = PoseRequest(
            grid, as_pose("the start", start), goals, (metres, radians), least
        )
        return last_step(self.pose_steps(request))

    def pose_steps(self, request: PoseRequest) -> Iterator[PosePlan | None]:
        """Yield None before each slow step, and last the plan of `plan_poses`."""
        if self.pose_planner is None:
            raise ValueError(
                "the model knows no body; give one of ddqn-planner train-robot"
            )
        hopes = request.grid.exploration
        used = request.grid if hopes is None else hopes.safe
        for plan in self.pose_planner.steps(replace(request, grid=used)):
            if plan is not None and hopes is not None and len(plan.poses) > 1:
                # What is expected, not what is hoped for.
                seconds, hoped = (
                    cost_of_poses(plan.poses, grid) * (grid.seconds_per_cell or 1.0)
                    for grid in (request.grid, used)
                )
                plan = replace(plan, cost=(plan.cost or 0.0) * seconds / hoped)
            yield plan

    def _answer(
        self, grid: GridMap, start: Cell, goals: list[Cell], how: tuple[Any, ...]
    ) -> Plan:
        """Check what a user asks for, and plan."""
        move_rule, method, tolerance, simplified, radius = how
        check_grid(grid)
        if self.pose_planner is not None:
            raise ValueError(f"{HAS_BODY}; use plan_poses, or a planner_node")
        limits = 0, math.inf, "0 cells or more"
        request = PlanRequest(
            grid,
            as_cell(start, "the start"),
            tuple(goals),
            self._rule(move_rule),
            PlanMethod(method),
            as_number("the tolerance", tolerance, *limits),
            as_flag("simplified", simplified),
            start_clearing_radius=as_number("start_clearing_radius", radius, *limits),
        )
        return last_step(self.steps(request))

    def steps(self, request: PlanRequest) -> Iterator[Plan | None]:
        """Yield None before each slow step (a part of a field, a search), and last the plan."""
        ms, began = 0.0, time.perf_counter()
        for plan in _with_plan_last(self._explain(request)):
            ms += 1e3 * (time.perf_counter() - began)
            if plan is not None:
                vars(plan)["field_ms"] = (
                    ms - plan.rollout_ms
                )  # frozen, but nobody else has it yet
            yield plan
            began = time.perf_counter()

    def _explain(self, request: PlanRequest) -> Generator[None, None, Plan]:
        """Return a plan; without a path, it says why, of several goals for each."""
        find = self._explore if request.grid.exploration else self._find
        plan = yield from find(request)
        if unknown_space.has_more_to_say(request.grid, plan, len(request.goals) > 1):
            yield
            plan = replace(plan, reason=unknown_space.reason_of(request, plan))
        return plan

    def _explore(self, request: PlanRequest) -> Generator[None, None, Plan]:
        """Do the work of `_find` on a map with hopes: a bold plan if it keeps the share."""
        grid, rule, hopes = request.grid, request.move_rule, request.grid.exploration
        assert hopes is not None
        plan = yield from self._find(replace(request, grid=hopes.bold))
        if (
            plan.path.size and plan.extra_cost is None
        ):  # one under way was judged when it was new
            best = yield from self._find(replace(request, under_way=()))
            longest = (1 + hopes.share) * (best.cost or math.inf) * SAME_COST
            if _cost(plan.path, grid, rule) > longest:
                plan = yield from self._find(replace(request, grid=hopes.safe))
        return (
            replace(plan, cost=_cost(plan.path, grid, rule)) if plan.path.size else plan
        )

    def _refusal(self, request: PlanRequest, free: Goals) -> PlanStatus | None:
        """Return why there is no path, where one look at start and free goals says so."""
        grid = request.grid
        if not grid.contains(request.start):
            return PlanStatus.START_OUTSIDE_MAP
        if not free and not any(map(grid.contains, request.goals)):
            return PlanStatus.GOAL_OUTSIDE_MAP
        if grid.is_obstacle(request.start) and request.start_clearing_radius == 0:
            return PlanStatus.START_OCCUPIED
        if not free and request.reach < 1:
            return PlanStatus.GOAL_OCCUPIED
        if not self.network.supports((grid.height, grid.width)):
            return PlanStatus.MAP_SIZE_UNSUPPORTED
        return None

    def _find(self, request: PlanRequest) -> Generator[None, None, Plan]:
        """Return a plan without the time that its field took, after None before each slow step."""
        grid, start, rule = request.grid, request.start, request.move_rule
        goals = tuple(sorted({goal for goal in request.goals if grid.is_free(goal)}))
        status = self._refusal(request, goals)
        if status is not None:
            return Plan(status, move_rule=rule)
        # A field that is known answers at once; else it is computed, or grown as far as the start.
        field = self.fields.find(grid, goals, rule) if grid.is_free(start) else None
        costs = None
        if field is None or not field.is_known(start):
            yield
            costs = self.fields.costs(grid, rule)
            if costs is None and len(goals) > 1:
                goals = self._nearest_alone(request, goals)
            elif costs is not None and goals and grid.is_free(start):
                field = self.fields.get(grid, goals, rule, start, costs)
                while isinstance(field, DistanceField) and not field.grow(
                    start, VISITS
                ):
                    yield
        way_out: tuple[Cell, ...] = (start,)
        began = time.perf_counter()
        plan = field.rollout(start, request.simplified) if field is not None else None
        if plan is None or not plan.path.size:
            if plan is not None and request.reach >= 1:
                yield
            elif plan is not None and plan.status is PlanStatus.NO_PATH:
                return plan
            # A look at the whole map finds a way out and goals in reach, or why there are none.
            found = way_and_ends(request, goals)
            if isinstance(found, PlanStatus):
                return Plan(found, move_rule=rule)
            way_out, goals = found
            field = self.fields.get(grid, goals, rule, way_out[-1], costs)
            began = time.perf_counter()
            plan = field.rollout(way_out[-1], request.simplified)
            if not plan.path.size and request.method is PlanMethod.ASTAR_FALLBACK:
                yield
                began = time.perf_counter()
                cells = np.array(
                    search(way_out[-1], field.goal, grid, rule, field.value)
                )
                plan = Plan(PlanStatus.SUCCEEDED, cells, PlanMethod.ASTAR_FALLBACK)
        if plan.path.size:
            return _dressed(request, plan, way_out, began)
        return replace(plan, goal=goals[0])

    def _nearest_alone(self, request: PlanRequest, goals: Goals) -> Goals:
        """Return the nearest of several goals, by a field toward each."""
        each = [replace(request, goals=(goal,), under_way=()) for goal in goals]
        plans = [plan for one in each if (plan := last_step(self.steps(one))).path.size]
        nearest = min(plans, key=lambda plan: plan.cost or plan.length, default=None)
        return nearest.cells[-1:] if nearest else goals[:1]


def _dressed(
    request: PlanRequest, found: Plan, way_out: tuple[Cell, ...], began: float
) -> Plan:
    """Return the plan by a path that was found: straight, or by the one under way."""
    grid, rule = request.grid, request.move_rule
    path, cost, extra_cost = found.path, None, None
    if request.simplified:
        path = straightened(path, grid, rule)
    if len(request.under_way):
        path, extra_cost = keep_or_switch(request, path)
    goal = (int(path[-1, 0]), int(path[-1, 1]))
    if len(way_out) > 1:
        path = np.concatenate([way_out[:-1], path], dtype=np.int32)
        if not np.array_equal(path, np.asarray(request.under_way)[-len(path) :]):
            extra_cost = None  # only from the first free cell on it is the one kept
    if grid.has_costs:
        cost = _cost(path, grid, rule)
    ms = 1e3 * (time.perf_counter() - began)
    return Plan(found.status, path, found.method, rule, cost, goal, extra_cost, 0.0, ms)


def _cost(path: Cells, grid: GridMap, rule: MoveRule) -> float:
    """Return what a path costs: seconds, on a map of expected times."""
    return cost_along(path, grid, rule) * (grid.seconds_per_cell or 1.0)


def _with_plan_last(finding: Generator[None, None, Plan]) -> Iterator[Plan | None]:
    """Yield what a generator yields, and then what it returns."""
    yield (yield from finding)


def last_step(steps: Iterator[AnyPlan | None]) -> AnyPlan:
    """Take all steps that are left of `Planner.steps`, and return the plan."""
    *_, plan = steps
    assert plan is not None
    return plan


def _tolerance_of_poses(tolerance: Any) -> tuple[float, float]:
    remedy = "give two numbers (metres, radians), each 0 or more"
    if (
        isinstance(tolerance, str)
        or len(values := listed(tolerance, "the tolerance", remedy)) != 2
    ):
        raise ValueError(f"the tolerance is {tolerance!r}; {remedy}")
    metres, radians = (
        as_number("the tolerance", one, 0, math.inf, remedy[5:]) for one in values
    )
    return metres, radians


def _poses_of_goals(goal: Any) -> tuple[Pose, ...]:
    """Return the poses of one goal, or of several."""
    values = listed(goal, "the goal", "give a pose (x, y, yaw), or several")
    if not values:
        raise ValueError("there is no goal; give at least one pose (x, y, yaw)")
    is_one = not any(isinstance(value, (Sequence, np.ndarray)) for value in values)
    return tuple(as_pose("the goal", pose) for pose in ([values] if is_one else values))


def _cells_of_goals(goals: Sequence[Cell]) -> list[Cell]:
    named = enumerate(listed(goals, "goals"), 1)
    cells = [as_cell(goal, f"goal {number}") for number, goal in named]
    if not cells:
        raise ValueError("there is no goal; give at least one cell")
    return cells
