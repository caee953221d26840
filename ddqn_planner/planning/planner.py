"""The planner: a network, a Q field a goal, and a walk a start."""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path

from ddqn_planner.grid import Cell, GridMap, MoveRule, connected_cells, legal_moves
from ddqn_planner.model import ModelMetadata, QNetwork, load_model
from ddqn_planner.planning.plan import Plan, PlanStatus
from ddqn_planner.planning.q_field import QField

MAX_FIELDS = 8
MAX_FIELD_BYTES = 2**29
"""How many Q fields a planner keeps, the last ones used; one is kept whatever its size."""


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
        self.network = network
        self.metadata = metadata
        self._fields: OrderedDict[tuple[str, Cell, MoveRule], QField] = OrderedDict()
        self._lock = threading.Lock()

    @classmethod
    def load(cls, model: str | Path) -> Planner:
        """Load a shipped model by its name (``"any_map"``), or a model file by its path.

        Raises
        ------
        ModelFileError
            If there is no such model, or its file cannot be used.
        """
        return cls(*load_model(model))

    def q_field(self, grid: GridMap, goal: Cell, move_rule: MoveRule | None = None) -> QField:
        """Return the Q field of a map toward a goal; asked again, it is looked up.

        Parameters
        ----------
        grid : GridMap
        goal : (x, y)
            A free cell.
        move_rule : MoveRule, optional
            The rule that the model was trained for by default.

        Raises
        ------
        ValueError
            If the goal is not a free cell of the map, or the model cannot plan on this size.
        """
        if not grid.is_free(goal):
            raise ValueError(f"the goal {goal} is not a free cell of the map; give another")
        if not self.network.supports((grid.height, grid.width)):
            raise ValueError(
                f"the model was not trained for maps of {grid.width} x {grid.height} cells; "
                "train one on such a map"
            )
        field = self.known_field(grid, goal, move_rule)
        if field is None:
            rule = move_rule or self.metadata.move_rule
            q = self.network.q_values(grid, goal, rule)
            field = QField(goal, q, legal_moves(grid.occupancy, rule))
            self._remember(grid, rule, field)
        return field

    def known_field(
        self, grid: GridMap, goal: Cell, move_rule: MoveRule | None = None
    ) -> QField | None:
        """Return the Q field of a map toward a goal if it was computed lately, else None."""
        key = (grid.fingerprint, goal, move_rule or self.metadata.move_rule)
        with self._lock:
            if key in self._fields:
                self._fields.move_to_end(key)
            return self._fields.get(key)

    def needs_field(
        self, grid: GridMap, start: Cell, goal: Cell, move_rule: MoveRule | None = None
    ) -> bool:
        """Say whether `plan` takes its time: no field is known, and nothing rules a path out."""
        return (
            grid.is_free(start)
            and grid.is_free(goal)
            and self.network.supports((grid.height, grid.width))
            and self.known_field(grid, goal, move_rule) is None
        )

    def _remember(self, grid: GridMap, rule: MoveRule, field: QField) -> None:
        with self._lock:
            self._fields[grid.fingerprint, field.goal, rule] = field
            while len(self._fields) > 1 and (
                len(self._fields) > MAX_FIELDS
                or sum(known.q.nbytes for known in self._fields.values()) > MAX_FIELD_BYTES
            ):
                self._fields.popitem(last=False)

    def plan(
        self, grid: GridMap, start: Cell, goal: Cell, move_rule: MoveRule | None = None
    ) -> Plan:
        """Plan a path.

        Parameters
        ----------
        grid : GridMap
        start, goal : (x, y)
        move_rule : MoveRule, optional
            The rule that the model was trained for by default.

        Returns
        -------
        Plan
            Every move of its path is legal under the rule, whatever the network says.
        """
        rule = move_rule or self.metadata.move_rule
        if not grid.contains(start):
            return Plan(PlanStatus.START_OUTSIDE_MAP)
        if not grid.contains(goal):
            return Plan(PlanStatus.GOAL_OUTSIDE_MAP)
        if not grid.is_free(start):
            return Plan(PlanStatus.START_OCCUPIED)
        if not grid.is_free(goal):
            return Plan(PlanStatus.GOAL_OCCUPIED)
        if not self.network.supports((grid.height, grid.width)):
            return Plan(PlanStatus.MAP_SIZE_UNSUPPORTED)
        # Where no path leads, there is no need to compute a field to say so.
        known = self.known_field(grid, goal, rule) is not None
        if not known and not _joined(grid, start, goal, rule):
            return Plan(PlanStatus.NO_PATH)
        plan = self.q_field(grid, goal, rule).rollout(start)
        if plan.status is PlanStatus.WALK_TRAPPED and not _joined(grid, start, goal, rule):
            return Plan(PlanStatus.NO_PATH)
        return plan


def _joined(grid: GridMap, start: Cell, goal: Cell, move_rule: MoveRule) -> bool:
    return bool(connected_cells(grid.occupancy, goal, move_rule)[start[1], start[0]])
