"""The Q field: Q(s, a) of every cell toward one goal; growth, repair and rollouts."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import cell_inside, cells_inside, numbers
from ddqn_planner.model import PropagationQNetwork, QNetwork
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning import cell_space, turns, wavefront
from ddqn_planner.planning.cell_space import Known, step_costs
from ddqn_planner.planning.field_cache import Field, memory_of
from ddqn_planner.planning.plan import Plan, PlanStatus
from ddqn_planner.planning.segments import Path

# Different free cells, sorted: a path may end in any of them.
Goals: TypeAlias = tuple[Cell, ...]
ROWS_OF_PATHS = 2**16  # of many rollouts: cells of paths that are computed at once
REPAIRED = 100  # cells that a repair may take back before a new field is begun
# Visits of a new field per cell that a repair may take back, while both take turns: to
# take a cell back takes longer, and it is visited again. See docs/benchmarks.md.
VISITS = 8
REPAIRED_SHARE = 0.02  # of the map's cells that a repair may take back


class QField(Field[Known]):
    """Q(s, a) of every cell of one map toward one goal.

    Parameters
    ----------
    goal : (x, y)
        A free cell.
    q : (8, H, W) float32
        The network's value of each action in each cell; -inf where no path to the goal
        is known.
    legal : (8, H, W) bool
        Whether each action may leave each cell. A rollout takes no other.
    move_rule : MoveRule
        The rule by which they are legal.
    """

    # The status of a rollout without a path.
    failure: ClassVar[PlanStatus] = PlanStatus.ROLLOUT_TRAPPED

    def __init__(
        self,
        goal: Cell,
        q: NDArray[np.float32],
        legal: NDArray[np.bool_],
        move_rule: MoveRule = MoveRule.ROBOT_SAFE,
    ) -> None:
        """Check the arguments: `q` and `legal` (8, H, W), and the goal, a cell (x, y).

        A ValueError says what is wrong with them.
        """
        self.q: NDArray[np.float32] = numbers("q", q)
        if self.q.ndim != 3 or len(self.q) != len(MOVES) or not self.q.size:
            raise ValueError(f"q has shape {self.q.shape}; give (8, H, W)")
        self.legal: NDArray[np.bool_] = numbers("legal", legal, self.q.shape, "b")
        self.move_rule = MoveRule(move_rule)
        self.goal = cell_inside(goal, self.q.shape[1:], "the goal")
        self.goals: Goals = (self.goal,)

    def __repr__(self) -> str:
        """Return the size of the map, the goals and the move rule in one line."""
        height, width = self._shape
        goals = ", ".join(map(str, self.goals))
        name = "goal" if len(self.goals) == 1 else "goals"
        size = f"{width} x {height} cells"
        return f"QField({size}, {name} {goals}, {self.move_rule.value})"

    @property
    def _shape(self) -> tuple[int, ...]:
        """(H, W) of the map."""
        return self.q.shape[1:]

    @cached_property
    def value(self) -> NDArray[np.float32]:
        """(H, W) float32: the greatest Q of a legal move; at the goal, of all cells."""
        legal_q = np.where(self.legal, self.q, np.float32(-np.inf))
        value: NDArray[np.float32] = legal_q.max(axis=0)
        value[self.goal[1], self.goal[0]] = value.max()
        return value

    @cached_property
    def policy(self) -> NDArray[np.int8]:
        """(H, W) int8: the legal action of the greatest Q; -1 where that is -inf."""
        # False where Q is NaN.
        has_value = self.legal & (self.q > -np.inf)
        legal_q = np.where(has_value, self.q, np.float32(-np.inf))
        best = np.where(legal_q.max(axis=0) > -np.inf, legal_q.argmax(axis=0), -1)
        return best.astype(np.int8)

    def is_on(self, grid: GridMap) -> bool:
        """Return whether a map has the same cells as the field's, wherever it lies."""
        return grid.same_cells(self.grid)

    @property
    def nbytes(self) -> int:
        """Memory in bytes of its arrays, as far as they were computed."""
        state = vars(self)  # to which other threads add what they compute
        total = 0
        for name in ("q", "legal", "value", "policy"):
            if name in state:
                total += memory_of(state[name]).nbytes
        return total

    def unmasked(self) -> QField:
        """Return the field without action masking: an illegal move traps a rollout.

        Of each cell's actions, the one of the greatest Q alone counts as legal, if it
        is legal.
        """
        greedy_1HW = self.q.argmax(axis=0, keepdims=True)
        actions_A11 = np.arange(len(MOVES)).reshape(-1, 1, 1)
        legal = self.legal & (actions_A11 == greedy_1HW)
        return QField(self.goal, self.q, legal, self.move_rule)

    def is_known(self, start: Cell) -> bool:
        """Return whether the field is grown as far as a rollout from a start needs."""
        return True

    def rollout(self, start: Cell, straight: bool = False) -> Plan:
        """Return the plan of greedy steps from a free cell, (x, y), to a goal.

        Its path, or its status without one, is that of `greedy_path`. A start outside
        the map is a ValueError.

        Examples
        --------
        >>> from ddqn_planner import Planner, load_map
        >>> grid = load_map("dilemma")
        >>> field = Planner.load("any_map").q_field(grid, (17, 19), "corner_cutting")
        >>> field.rollout((6, 6))
        Plan(19 cells from (6, 6) to (17, 19), length 22.97)
        """
        outcome = self.greedy_path(start, straight)
        if isinstance(outcome, PlanStatus):
            return Plan(outcome, move_rule=self.move_rule)
        return Plan(PlanStatus.SUCCEEDED, outcome, move_rule=self.move_rule)

    def path_of_few_turns(self, start: Cell, turn_cost: float) -> Path | None:
        """Return the cells (N, 2) of a path that counts turns; None here.

        See `DistanceField.path_of_few_turns`.
        """
        return None

    def greedy_path(self, start: Cell, straight: bool = False) -> Path | PlanStatus:
        """Return the cells (N, 2) of greedy steps from a free cell (x, y) to the goal.

        Without a path, return why: ROLLOUT_TRAPPED if a step enters a cell again, as
        the steps would then repeat, or if a cell has no legal step. A start that is no
        cell of the map is a ValueError. `straight` is not used here, see
        `DistanceField.greedy_path`.
        """
        policy = self.policy  # (H, W): an action, or -1
        cell = cell_inside(start, policy.shape, "the start")
        cells = [cell]
        visited = {cell}
        while cell != self.goal:
            x, y = cell
            action = policy[y, x]
            dx, dy = MOVES[action].tolist()
            cell = (x + dx, y + dy)
            if action < 0 or cell in visited:
                return PlanStatus.ROLLOUT_TRAPPED
            visited.add(cell)
            cells.append(cell)
        return np.array(cells, np.int32)

    def rollouts(self, starts: ArrayLike) -> list[Plan]:
        """Return the plans of `rollout` from many starts, in the order of the starts.

        It takes less time than one rollout after another, but computes the policy of
        the whole map first.

        Parameters
        ----------
        starts : (N, 2) array of whole numbers, or sequence of (x, y)
            Cells of the map; another one is a ValueError.

        Examples
        --------
        >>> from ddqn_planner import Planner, load_map
        >>> grid = load_map("dilemma")
        >>> field = Planner.load("any_map").q_field(grid, (17, 19), "corner_cutting")
        >>> plans = field.rollouts([(6, 6), (2, 2)])
        >>> [round(plan.length, 2) for plan in plans]
        [22.97, 27.31]
        """
        policy = np.ascontiguousarray(self.policy)  # (H, W)
        cells = cells_inside(starts, policy.shape)  # (N, 2)
        is_goal = np.zeros(policy.shape, np.bool_)
        for x, y in self.goals:
            is_goal[y, x] = True
        # The number of the start, from 1 on, whose path entered each cell last.
        entered_by = np.zeros(policy.shape, np.int64)
        # Several paths one after another, and the row after the last cell of each.
        paths = np.empty((policy.size + ROWS_OF_PATHS, 2), np.int32)
        end = np.zeros(len(cells), np.int64)
        plans: list[Plan] = []
        while len(plans) < len(cells):
            first = len(plans)
            following = cell_space.follow(
                policy, is_goal, cells, first, entered_by, paths, end
            )
            begins = [0, *end[first : following - 1].tolist()]
            ends = end[first:following].tolist()
            for begin, row in zip(begins, ends, strict=True):
                plans.append(self._plan_of(paths[begin:row].copy()))
        return plans

    def _plan_of(self, path: Path) -> Plan:
        """Return the plan of a path (N, 2), which is empty if there is none."""
        status = PlanStatus.SUCCEEDED if len(path) else self.failure
        return Plan(status, path, move_rule=self.move_rule)


class DistanceField(QField):
    """The Q field that costs of moves give; it grows as far as a request needs.

    Parameters
    ----------
    goals : tuple of (x, y)
        Different free cells, sorted; it grows from all of them.
    grid : GridMap
    costs : MoveCosts
        Of the moves on this map.
    move_rule : MoveRule
    """

    costs: MoveCosts
    failure = PlanStatus.NO_PATH

    def __init__(
        self, goals: Goals, grid: GridMap, costs: MoveCosts, move_rule: MoveRule
    ) -> None:
        """Begin with the goals alone; `grow` does the work."""
        super(QField, self).__init__()
        self.grid = grid
        self.costs = costs
        self.move_rule = move_rule
        self.goal = goals[0]
        self.goals = goals

    def __reduce__(self) -> tuple[object, ...]:
        """Return how a copy is made: it grows anew."""
        return DistanceField, (self.goals, self.grid, self.costs, self.move_rule)

    @property
    def _shape(self) -> tuple[int, ...]:
        """(H, W) of the map; Q itself may not be computed yet."""
        return self.grid.occupancy.shape

    def _goals_alone(self) -> Known:
        """Return what is known before any growth: the goals alone are open."""
        cells = self.costs.patch_number.size  # of the padded map
        distance = np.zeros(cells)  # 0: not reached
        mark = np.zeros(cells, np.uint8)  # UNREACHED
        numbers = np.array([self._number(*goal) for goal in self.goals], np.int32)
        distance[numbers] = cell_space.AT_GOAL
        mark[numbers] = wavefront.OPEN
        return Known(distance, mark, opened=numbers)

    def _number(self, x: int, y: int) -> int:
        """Return the number of cell (x, y) on the padded map.

        The padded map has a border of one cell; its cells are numbered row by row.
        """
        return (y + 1) * self.costs.width + x + 1

    def grow(self, start: Cell | None = None, limit: int = 2**62) -> bool:
        """Grow until a start's distance is known; without a start, over all of the map.

        About `limit` cells are visited at most. Return whether the distance is known
        then, or known to be none.
        """
        # No path reaches cell 0 of the padded map, in the border: with cell 0 as the
        # start, all of the map is visited.
        number = 0 if start is None else self._number(*start)
        with self._lock:
            is_enough = _is_final(self.known, number)
            if not is_enough:
                self._known, is_enough = cell_space.grow(
                    self._take_known(), self.costs, number, limit
                )
        return is_enough

    def is_known(self, start: Cell) -> bool:
        """Return whether the field is grown as far as a rollout from a start needs."""
        known = self._known  # None while another thread computes it
        return known is not None and _is_final(known, self._number(*start))

    def greedy_path(self, start: Cell, straight: bool = False) -> Path | PlanStatus:
        """Return the cells (N, 2) of greedy steps from a start, (x, y), to a goal.

        The field grows as far as the start. The result is NO_PATH only if no path leads
        to a goal. Of steps on paths of the same cost, those are taken that stay nearest
        to the straight line from the start to the goal if `straight`, else the first
        one in the order of actions.
        """
        start = cell_inside(start, self.grid.occupancy.shape, "the start")
        number = self._number(*start)
        # A line from the start to itself has no direction: all steps are equally near.
        toward_x, toward_y = self.goal if straight else start
        with self._lock:
            self.grow(start)
            known = self.known
            if known.mark[number] != wavefront.CLOSED:
                return PlanStatus.NO_PATH
            # No move costs less than 1, but sums of costs are rounded.
            most_cells = 2 + int(1.01 * known.distance[number])
            path = np.empty((min(most_cells, known.distance.size), 2), np.int32)
            length = cell_space.roll_out(
                known.distance,
                number,
                path,
                toward_x,
                toward_y,
                step_costs(self.costs),
            )
        return path[:length]

    def path_of_few_turns(self, start: Cell, turn_cost: float) -> Path | None:
        """Return the path of cells (N, 2) that costs the least with its turns.

        The result is None without a path, or if the search takes too long. The field
        grows over all of the map.

        Parameters
        ----------
        start : (x, y)
        turn_cost : float
            Of turning, per radian. Moves to adjacent cells turn by multiples of 45
            degrees.
        """
        start = cell_inside(start, self.grid.occupancy.shape, "the start")
        number = self._number(*start)
        with self._lock:
            self.grow()
            known = self.known
            if known.mark[number] != wavefront.CLOSED:
                return None
            return turns.path_of_few_turns(
                known.distance, number, turn_cost, step_costs(self.costs)
            )

    def take_over(
        self,
        older: DistanceField,
        changed: NDArray[np.int64] | None,
        start: Cell | None = None,
    ) -> bool:
        """Repair what an older field knows and take it, where that is quicker.

        Return whether the cache should forget the older field. It should not if the
        maps cannot be compared: requests may take turns between them.

        Parameters
        ----------
        older : DistanceField
            With the same goals. It may hand over what it knows, and then begins anew.
        changed : (N, 2), optional
            The cells x, y in which the maps of both fields differ; None if they cannot
            be compared.
        start : (x, y), optional
            Where this field is needed; None for all of the map.
        """
        if changed is None:
            return False
        cells_to_judge = self._numbers_around(changed)
        # For one start, two attempts take turns, each time with four times the limit:
        # to repair the older field, and to grow this one. The first to succeed is used.
        # If that is the growth, the older field gets back what it knows. Without a
        # start, only the repair is tried, once.
        most_repaired = max(REPAIRED, int(REPAIRED_SHARE * self.grid.occupancy.size))
        limit = most_repaired if start is None else REPAIRED  # cells of a repair
        with older._lock:
            known = older._take_known()  # distances and open cells
            repaired = cell_space.take_back(known, self.costs, cells_to_judge, limit)
            while repaired is None:  # it would take back more cells than the limit
                limit *= 4
                is_repair_slower = start is None or limit > most_repaired
                if is_repair_slower or self.grow(start, VISITS * limit):
                    older._known = known
                    return True
                repaired = cell_space.take_back(
                    known, self.costs, cells_to_judge, limit
                )
            self._known = repaired
        return True

    def _numbers_around(self, cells: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the numbers of some cells (N, 2) and of their neighbours, sorted.

        They are (K,) numbers on the padded map, each of them once. Numbers in its first
        and last row, where there are no moves, are left out.
        """
        width = self.costs.width
        steps = np.arange(-1, 2)
        # What leads from a cell's number to those of the 9 cells around it.
        offsets = (steps[:, None] * width + steps).reshape(9, 1)
        number = self._number(0, 0) + cells[:, 1] * width + cells[:, 0]  # (N,)
        numbers = (offsets + number).astype(np.int32)  # (9, N)
        # Without the first and the last row, and so without number 0.
        end = self.costs.patch_number.size - width - 1
        inside = np.sort(numbers[(numbers > width) & (numbers < end)])
        # In a fifth of the time of `np.unique`.
        is_new = np.diff(inside, prepend=0) > 0
        return inside[is_new]

    def _layer(self, write: Callable[..., None], layer: NDArray[Any]) -> NDArray[Any]:
        """Grow over all of the map and return a layer of the field, (..., H, W).

        The kernel `write` computes it from the distances, and writes it to `layer`
        (..., C), for the C cells of the padded map.
        """
        with self._lock:
            self.grow()
            write(self.known.distance, layer, step_costs(self.costs))
        padded_map = layer.reshape(*layer.shape[:-1], -1, self.costs.width)
        return padded_map[..., 1:-1, 1:-1]

    @cached_property
    def q(self) -> NDArray[np.float32]:  # type: ignore[override]
        """(8, H, W) float32: Q(s, a); -inf if no path begins with a in s."""
        return self._layer(
            cell_space.write_q,
            np.full((8, self.costs.patch_number.size), -np.inf, np.float32),
        )

    @cached_property
    def legal(self) -> NDArray[np.bool_]:  # type: ignore[override]
        """(8, H, W) bool: the legal moves."""
        return self.grid.legal_moves(self.move_rule)

    @cached_property
    def value(self) -> NDArray[np.float32]:
        """(H, W) float32: the greatest Q of a legal move; at the goal, of all cells."""
        value = self._layer(
            cell_space.write_value,
            np.full(self.costs.patch_number.size, -np.inf, np.float32),
        )
        greatest = value.max()
        for x, y in self.goals:
            value[y, x] = greatest
        return value

    @cached_property
    def policy(self) -> NDArray[np.int8]:
        """(H, W) int8: the action of a rollout in each cell; -1 without one."""
        return self._layer(
            cell_space.write_policy, np.full(self.costs.patch_number.size, -1, np.int8)
        )

    @property
    def nbytes(self) -> int:
        """Memory, bytes: 9 per cell for what is known, and that of its arrays."""
        known = self._known  # None while another thread computes it
        opened = 0 if known is None else known.opened.nbytes
        return 9 * self.costs.patch_number.size + opened + super().nbytes


def _is_final(known: Known, number: int) -> bool:
    """Return whether the distance of a cell will not change any more.

    `number` is the cell's on the padded map. A cell without a path counts, too, once
    the field has grown over all of the map.
    """
    if known.closed_is_final and known.mark[number] == wavefront.CLOSED:
        return True
    is_whole = known.opened.size == 0
    return is_whole or number == known.settled_start


def network_field(
    network: QNetwork, grid: GridMap, goal: Cell, move_rule: MoveRule
) -> QField:
    """Return the field of a network that gives no proved costs of moves.

    Either its predicted costs may be wrong, as for a propagation network, or it
    computes Q toward the goal (x, y) from the whole map at once.
    """
    if isinstance(network, PropagationQNetwork):
        costs = network.believed_costs(grid, move_rule)
        q = DistanceField((goal,), grid, costs, move_rule).q
    else:
        q = network.q_values(grid, goal, move_rule)
    return QField(goal, q, grid.legal_moves(move_rule), move_rule)
