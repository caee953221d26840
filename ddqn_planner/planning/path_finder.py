"""The flow of a request for a path: the same for cells and for poses."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from dataclasses import replace
from typing import Any, Generic, TypeVar

from numpy.typing import NDArray

from ddqn_planner.grid.grid_map import Exploration
from ddqn_planner.planning import unknown_space
from ddqn_planner.planning.exploration import error_of_difference
from ddqn_planner.planning.plan import (
    AnyPlan,
    Explanation,
    PathRequest,
    explained,
)

Request = TypeVar("Request", bound="PathRequest[Any]")
Result = TypeVar("Result")
# A part of the flow: a generator that yields None before each slow step, so that
# whoever iterates `PathFinder.steps` may do other work first, and returns its result.
PausingGenerator = Generator[None, None, Result]


class Clock:
    """The time that a request takes, without the pauses between its steps."""

    def __init__(self) -> None:
        self._seconds_before = 0.0  # until the last pause
        self._began = time.perf_counter()
        self._seconds_of_field = 0.0

    def pause(self) -> None:
        """Stop until `resume`."""
        self._seconds_before = self._seconds()

    def resume(self) -> None:
        """Go on after a pause."""
        self._began = time.perf_counter()

    def end_field(self) -> None:
        """Count all that follows as the time of the rollout."""
        self._seconds_of_field = self._seconds()

    @property
    def field_ms(self) -> float:
        """The time until the field was known, in milliseconds."""
        return 1e3 * self._seconds_of_field

    @property
    def rollout_ms(self) -> float:
        """The time since then, in milliseconds."""
        return 1e3 * (self._seconds() - self._seconds_of_field)

    def _seconds(self) -> float:
        """Return the time until now, without the pauses."""
        return self._seconds_before + time.perf_counter() - self._began


class PathFinder(ABC, Generic[Request, AnyPlan]):
    """Finds paths of a space, those of cells or those of poses.

    Several threads may use it.
    """

    def steps(self, request: Request) -> Iterator[AnyPlan | None]:
        """Yield None before each slow step (a part of a field, a search).

        Last of all, yield the plan.
        """
        clock = Clock()
        for plan_or_none in _with_plan_last(self._answer(request, clock)):
            clock.pause()
            yield plan_or_none
            clock.resume()

    def _answer(self, request: Request, clock: Clock) -> PausingGenerator[AnyPlan]:
        """Return the plan of a request, after pauses.

        If it has no path, its reason may say more than its status: whether unknown
        space is in the way, or what stops each of several goals.
        """
        plan = yield from self._find(request, clock)
        if plan.path.size:
            return plan
        has_several_goals = len(request.goals) > 1
        if unknown_space.has_more_to_say(request.grid, plan, has_several_goals):
            yield  # a pause: a slow step follows
            explanation = yield from self._explanation(request, plan)
            plan = explained(plan, explanation)
        return plan

    def _find(self, request: Request, clock: Clock) -> PausingGenerator[AnyPlan]:
        """Return the plan, whose reason is its status in words."""
        exploration = request.grid.exploration
        if exploration is None:
            return (yield from self._find_on_map(request, clock))
        return (yield from self._explore(request, exploration, clock))

    def _explore(
        self, request: Request, exploration: Exploration, clock: Clock
    ) -> PausingGenerator[AnyPlan]:
        """Return the best plan, or the shortest one if the best is not surely quicker.

        The shortest path is left only if another one is expected to be quicker by more
        than the standard error of the difference, or by more than the share
        `exploration.share` of its own time: whoever leaves it for less follows errors,
        and learns nothing of it. The path under way is kept on the same terms. The cost
        of the plan is the expected one, in seconds. `clock` measures the time of the
        request, without its pauses.
        """
        best = yield from self._find_on_map(request, clock)
        is_kept = best.extra_cost is not None
        if is_kept or best.cost is None:
            return best
        untimed = exploration.untimed
        if request.grid.turn_cost > 0:
            untimed = untimed.with_layers(turn_cost=request.grid.turn_cost)
        shortest_request = replace(request, grid=untimed)
        shortest = yield from self._find_on_map(shortest_request, clock)
        if not shortest.path.size:
            return best
        shortest = self.expected(shortest, request)
        assert shortest.cost is not None
        error = error_of_difference(
            shortest.path, best.path, request.grid, exploration.deviation
        )
        greatest_loss = min(error, exploration.share * best.cost)
        is_as_quick = shortest.cost <= best.cost + greatest_loss
        return shortest if is_as_quick else best

    @abstractmethod
    def _find_on_map(self, request: Request, clock: Clock) -> PausingGenerator[AnyPlan]:
        """Return the plan on a map without an exploration."""

    @abstractmethod
    def expected(self, plan: AnyPlan, request: Request) -> AnyPlan:
        """Return a plan on the map without times with its expected cost, in seconds.

        The map of the request has the expected times.
        """

    @abstractmethod
    def _explanation(
        self, request: Request, plan: AnyPlan
    ) -> PausingGenerator[Explanation]:
        """Return why there is no path, in words."""

    @abstractmethod
    def rest_of_path(self, request: Request) -> NDArray[Any]:
        """Return the rest of the path under way, from the start on.

        It is empty if the start is far from that path, or the rest is not free.
        """


def _with_plan_last(
    generator: PausingGenerator[AnyPlan],
) -> Iterator[AnyPlan | None]:
    """Yield None for each pause of a generator, and then the plan that it returns."""
    plan = yield from generator
    yield plan


def last_step(steps: Iterator[AnyPlan | None]) -> AnyPlan:
    """Run the rest of `PathFinder.steps` without pauses, and return the plan."""
    *_, plan = steps
    assert plan is not None
    return plan
