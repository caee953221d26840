"""Pictures of the pages about the network, its guarantees, and measurements.

doc_pictures.py saves them.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import bodies
import numpy as np
from beside import CELL_OF_MAP, CELLS_OF_MAP, inflated_as_nav2
from figures import COLOURS, draw_path, frame_of, plt
from numpy.typing import NDArray
from PIL import Image
from random_maps import KINDS, generate_map

from ddqn_planner import GridMap, MoveRule, Planner
from ddqn_planner.cli import main as run_command
from ddqn_planner.grid import OCCUPIED, Cell
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.model import PaperQNetwork, PropagationQNetwork, RobotNetwork
from ddqn_planner.model.move_costs import every_patch, legal_in_patches
from ddqn_planner.model.networks import (
    FREE,
    GOAL,
    OBSTACLE,
    ROBOT,
    observation_background,
)
from ddqn_planner.pictures import (
    VALUE_COLOURS,
    BodyPicture,
    draw_body,
    draw_obstacles,
    view_of_body,
)
from ddqn_planner.pictures import save_film as save_frames
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.plan import PoseRequest
from ddqn_planner.planning.pose_paths import in_cells
from ddqn_planner.robot.driving_costs import DrivingCosts
from ddqn_planner.robot.footprint import placed, read_footprint
from ddqn_planner.training import paper_scenario

BENCHMARKS: Final = Path(__file__).resolve().parents[1] / "docs" / "benchmarks.md"
RATIO: Final = re.compile(r"^\| `([\w-]+)` \| (\d+)x\d+ \|((?: [\d.]+ \|){4})", re.M)
MAP_KINDS: Final = ("random_20", "rooms", "office", "maze")  # columns of that table
NARROW: Final = 6.4  # inches, so that the letters are large on a narrow screen
SIDE: Final = 32  # cells, of a generated map
SHOWN_FILTERS: Final = 4  # those with the most outputs above 0
# What the values of an observation mean, and their colours.
OBSERVED: Final = (
    (OBSTACLE, "#22223B", "obstacle"),
    (FREE, "#e9ecef", "free"),
    (GOAL, COLOURS[2], "end"),
    (ROBOT, COLOURS[1], "robot"),
)
ARROWS: Final = "→↗↑↖←↙↓↘"
CAR: Final = "--model car --start 430 97 --goal 495 200 --yaws 0 1.57"
HALL_WIDTH: Final = 360  # cells
HALL_HEIGHT: Final = 180
HALL_ENDS: Final = ((2.5, 2.5, math.pi), ((15.5, 6.5, 0.5),))  # start, and goals
LENGTHS_ALONE: Final = DrivingCosts(bend=1.0, cusp=0.0)
COSTS_OF_DRIVING: Final = {
    "where lengths alone count": LENGTHS_ALONE,
    "by default": DrivingCosts(),
}
LEGEND_OF_BODIES: Final = ("swept", "path", "in reverse", "cusp", "start", "goal")
BODY_COLOUR: Final = "#f4a259"
METRES_OF_FRAME: Final = 0.2  # that the bodies drive from one frame to the next
FRAME_MS: Final = 100
LAST_FRAME_MS: Final = 2500
# A request of `beside.py`, and the path of Smac Hybrid-A* for it, in metres.
SMAC_PATH: Final = Path(__file__).with_name("smac_hybrid_path.csv")
BESIDE_ENDS: Final = (
    (13.89563148322319, 6.207666988704605, -1.5067393994722427),
    (9.08231766120358, 12.837409056012099, -2.825320458597536),
)
VIA: Final[Cell] = (2, 16)
GOALS: Final[tuple[Cell, ...]] = ((17, 19), (11, 2), (13, 10))


def network() -> Any:
    """Draw what the paper's network sees, its filters, and its eight outputs."""
    scenario = paper_scenario()
    grid = scenario.grid
    planner = Planner.load("dilemma")
    x, y = scenario.start
    observation = observation_background(grid.occupancy, scenario.goal)
    observation = observation.reshape(grid.occupancy.shape)
    observation[y, x] = ROBOT
    figure = plt.figure(figsize=(NARROW, 5.4), layout="constrained")
    layout = figure.add_gridspec(2, 4, height_ratios=(2, 1.2))
    axes = figure.add_subplot(layout[0, :2])
    values = np.array([value for value, _, _ in OBSERVED], np.float32)
    colours = [colour for _, colour, _ in OBSERVED]
    number = np.searchsorted(values, observation)
    axes.imshow(
        number, origin="lower", cmap=plt.matplotlib.colors.ListedColormap(colours)
    )
    handles = [
        plt.Rectangle((0, 0), 1, 1, color=colour, label=f"{value:g}: {name}")
        for value, colour, name in OBSERVED
    ]
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=2
    )
    axes.set(xticks=[], yticks=[])
    axes.set_title("observation, 20 x 20", loc="left", fontsize=11)
    features = _features(planner.network, observation)  # (F, 10, 10)
    filters = layout[0, 2:].subgridspec(2, 2)
    most_active = np.argsort((features == 0).sum(axis=(1, 2)), kind="stable")
    for panel, number in enumerate(most_active[:SHOWN_FILTERS]):
        axes = figure.add_subplot(filters[divmod(panel, 2)])
        axes.imshow(features[number], origin="lower", cmap="magma")
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"filter {number + 1} of 16", loc="left", fontsize=10)
    q = planner.q_field(grid, scenario.goal).q[:, y, x]
    axes = figure.add_subplot(layout[1, :])
    is_best = np.arange(len(q)) == q.argmax()
    axes.bar(list(ARROWS), q, color=np.where(is_best, COLOURS[1], COLOURS[0]))
    axes.tick_params(axis="x", labelsize=14)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_ylabel("Q(s, a)")
    return figure


def _features(
    paper_network: Any, observation: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the outputs of the paper's convolution and its ReLU: (F, H / 2, W / 2)."""
    assert isinstance(paper_network, PaperQNetwork)
    padded = np.pad(observation, 1)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))[::2, ::2]
    kernel = paper_network.tensors["convolution.weight"][:, 0]  # (F, 3, 3)
    bias = paper_network.tensors["convolution.bias"][:, None, None]
    output = np.tensordot(kernel, windows, ((1, 2), (2, 3))) + bias
    features: NDArray[np.float32] = np.maximum(output, 0).astype(np.float32)
    return features


def kinds() -> Any:
    """Draw a map of each kind of generated map, with a path on it."""
    planner = Planner.load("any_map")
    rule = MoveRule.ROBOT_SAFE
    figure, panels = plt.subplots(3, 3, figsize=(NARROW, 6.9), layout="constrained")
    random = np.random.default_rng(3)
    for axes, kind in zip(panels.flat, KINDS, strict=True):
        occupancy = generate_map(kind, (SIDE, SIDE), random)
        requests = random_requests(occupancy, rule, 30, random)
        grid = GridMap(occupancy)
        plans = [planner.plan(grid, start, goal, rule) for start, goal in requests]
        plan = max(plans, key=lambda plan: plan.length)
        axes.imshow(~occupancy, origin="lower", cmap="gray", vmin=-0.2)
        draw_path(axes, plan.cells, 0, "path")
        axes.scatter(*plan.cells[0], 40, color="black", edgecolors="white", zorder=4)
        axes.scatter(
            *plan.cells[-1], 130, "black", marker="*", edgecolors="white", zorder=4
        )
        axes.set(xticks=[], yticks=[])
        axes.set_title(kind, loc="left", fontsize=11)
    return figure


def decisions() -> Any:
    """Draw the logits of all decisions of the network for any map, without costs."""
    any_map = Planner.load("any_map").network
    assert isinstance(any_map, PropagationQNetwork)
    patches = every_patch()
    patches = patches[patches[:, 4] != OCCUPIED]  # the robot stands in the centre
    legal_logits = []
    illegal_logits = []
    for rule in (MoveRule.CORNER_CUTTING, MoveRule.ROBOT_SAFE):
        logits = _logits(any_map, any_map.features(patches, rule))
        legal = legal_in_patches(patches, rule)
        legal_logits.append(logits[legal])
        illegal_logits.append(logits[~legal])
    figure, axes = plt.subplots(figsize=(NARROW, 3.4), layout="constrained")
    sides = (np.concatenate(illegal_logits), np.concatenate(legal_logits))
    labels = [
        f"{len(values):,} {name} moves"
        for values, name in zip(sides, ("illegal", "legal"), strict=True)
    ]
    axes.hist(sides, bins=80, stacked=True, label=labels, color=COLOURS[1::-1])
    axes.axvline(0, color="black")
    axes.set_xlabel("logit: the planner takes a move as possible right of 0")
    axes.set_ylabel("decisions")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def _logits(
    any_map: PropagationQNetwork, features: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the logit of each action for inputs (B, I): (B, 8)."""
    output = features
    for layer in ("convolution", "hidden", "moves"):
        weight = any_map.tensors[f"{layer}.weight"]
        output = np.maximum(output, 0) @ weight.T + any_map.tensors[f"{layer}.bias"]
    return output


def speed() -> Any:
    """Draw the table of requests on new maps of docs/benchmarks.md."""
    rows = RATIO.findall(BENCHMARKS.read_text(encoding="utf-8"))
    figure, axes = plt.subplots(figsize=(NARROW, 3.8), layout="constrained")
    places = np.arange(len(MAP_KINDS))
    width = 0.8 / len(rows)
    for number, (planner, side, cells) in enumerate(rows):
        ratios = [float(cell) for cell in cells.split("|")[:-1]]
        label = f"over {planner}, {side}x{side}"
        offset = (number - (len(rows) - 1) / 2) * width
        axes.bar(places + offset, ratios, width, label=label, color=COLOURS[number])
    axes.axhline(1, color="black", linewidth=1)
    axes.set_xticks(places, MAP_KINDS)
    axes.set_ylabel("time of a request, ratio")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def python_api() -> Any:
    """Draw a Q field, a path through two goals, and a path to the nearest goal."""
    scenario = paper_scenario()
    grid = scenario.grid
    planner = Planner.load("any_map")
    rule = scenario.move_rule
    field = planner.q_field(grid, scenario.goal, rule)
    figure, panels = plt.subplots(1, 3, figsize=(NARROW, 2.6), layout="constrained")
    colours = plt.matplotlib.colors.LinearSegmentedColormap.from_list(
        "value", VALUE_COLOURS
    )
    value = np.where(np.isfinite(field.value), field.value, np.nan)
    panels[0].imshow(value, origin="lower", cmap=colours)
    plans = {
        "rollout": field.rollout(scenario.start),
        "plan_through": planner.plan_through(
            grid, scenario.start, (VIA, scenario.goal), rule
        ),
        "plan_nearest": planner.plan_nearest(grid, scenario.start, GOALS, rule),
    }
    for axes, (name, plan) in zip(panels, plans.items(), strict=True):
        draw_obstacles(axes, grid)
        draw_path(axes, plan.cells, 0, name)
        axes.scatter(*scenario.start, 40, color="black", edgecolors="white", zorder=5)
        axes.set(xticks=[], yticks=[])
        axes.set_title(name, loc="left", fontsize=11)
    goals = [[scenario.goal], [VIA, scenario.goal], GOALS]
    for axes, cells in zip(panels, goals, strict=True):
        x, y = np.transpose(cells)
        axes.scatter(x, y, 90, "black", marker="*", edgecolors="white", zorder=4)
    return figure


def bends() -> Any:
    """Draw a car's path where lengths alone count, and where bends and cusps do."""
    grid = GridMap(np.zeros((HALL_HEIGHT, HALL_WIDTH), np.bool_), bodies.CELL)
    figure, panels = plt.subplots(2, 1, figsize=(7.2, 6.4), layout="constrained")
    costs_and_panels = zip(COSTS_OF_DRIVING.items(), panels, strict=True)
    for (name, costs), axes in costs_and_panels:
        footprint = bodies.FOOTPRINTS["car"]
        planner = bodies.robot(footprint, "ackermann", costs=costs)
        assert planner.pose_planner is not None
        is_finished = costs != LENGTHS_ALONE
        request = PoseRequest(grid, *HALL_ENDS, finished=is_finished)
        poses = last_step(planner.pose_planner.steps(request)).poses  # (N, 3)
        start, (goal,) = HALL_ENDS
        shape = bodies.shape_of(poses, start, goal)
        draw_body(axes, read_footprint(footprint), poses, np.array(poses[[0, -1]]))
        axes.set_aspect("equal")
        axes.set(
            xlim=(0, HALL_WIDTH * bodies.CELL), ylim=(0, HALL_HEIGHT * bodies.CELL)
        )
        words = f"{shape.turning:.0f} degrees and {shape.cusps:.1f} cusps per 10 m"
        axes.set_title(f"{name}: {words}", loc="left", fontsize=10)
    panels[1].set(xlabel="x [m]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    return figure


def save_beside_smac(path: Path) -> None:
    """Save a film of a car beside Nav2's Smac Hybrid-A*, both at the same speed."""
    grid = blocks()
    planner = Planner.load("car")
    assert isinstance(planner.network, RobotNetwork)
    footprint = planner.network.footprint
    with_costs = inflated_as_nav2(grid, bodies.inner_radius(footprint))
    plan = planner.plan_poses(with_costs, *BESIDE_ENDS)
    smac_path = np.loadtxt(SMAC_PATH, delimiter=",", skiprows=1)  # (N, 3)
    drives = {"ddqn_planner": plan.poses, "Smac Hybrid-A* (Nav2 1.3.13)": smac_path}
    longest = max(metres_along(poses)[-1] for poses in drives.values())
    frames = [
        _frame_beside_smac(grid, footprint, drives, metres)
        for metres in np.arange(0, longest + METRES_OF_FRAME, METRES_OF_FRAME)
    ]
    save_frames(path, frames, FRAME_MS, LAST_FRAME_MS)


def metres_along(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the metres (N,) from the first of N poses to each of them."""
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    metres: NDArray[np.float64] = np.append(0, np.cumsum(steps))
    return metres


def _frame_beside_smac(
    grid: GridMap,
    footprint: NDArray[np.float64],
    drives: Mapping[str, NDArray[np.float64]],
    metres: float,
) -> Image.Image:
    """Draw each path with the body where it is after some metres."""
    figure, panels = plt.subplots(1, 2, figsize=(8.4, 5.6), layout="constrained")
    start, goal = BESIDE_ENDS
    ends = in_cells(np.array(BESIDE_ENDS), grid)
    everything = in_cells(np.concatenate([*drives.values()]), grid)
    corners = footprint / grid.resolution
    view = view_of_body(grid, BodyPicture(corners, everything, ends))
    handles: dict[str, Any] = {}
    for axes, (name, poses) in zip(panels, drives.items(), strict=True):
        draw_obstacles(axes, grid)
        path = in_cells(poses, grid)
        draw_body(axes, corners, path, ends)
        driven = metres_along(poses)
        index = min(int(np.searchsorted(driven, metres)), len(poses) - 1)
        body = placed(corners, path[index])
        axes.fill(*body.T, color=BODY_COLOUR, alpha=0.75, zorder=6)
        axes.set(xlim=view.x, ylim=view.y, xticks=[], yticks=[], aspect="equal")
        shape = bodies.shape_of(poses, start, goal)
        title = f"{name}\n{driven[-1]:.1f} m, {shape.turning:.0f} degrees per 10 m"
        axes.set_title(title, loc="left", fontsize=10)
        drawn, labels = axes.get_legend_handles_labels()
        handles |= dict(zip(labels, drawn, strict=True))
    legend = {label: handles[label] for label in LEGEND_OF_BODIES}
    figure.legend(
        legend.values(),
        legend.keys(),
        loc="outside lower center",
        ncols=6,
        frameon=False,
    )
    # These colours cover all that are drawn, also the few points of a short stretch.
    few_colours = frame_of(figure).quantize(64, Image.Quantize.MAXCOVERAGE)
    return few_colours.convert("RGB")


def blocks() -> GridMap:
    """Return the map of the path beside Smac's: 18 x 18 m with blocks of 1.5 m."""
    cells = generate_map("random_10", CELLS_OF_MAP, np.random.default_rng(0))
    block = np.ones((CELL_OF_MAP, CELL_OF_MAP), np.bool_)
    return GridMap(np.kron(cells, block), bodies.CELL)


def save_command_line(path: Path) -> None:
    """Save the picture of a car's path that `ddqn-planner plan` draws."""
    run_command(["plan", "office", *CAR.split(), "--picture", str(path)])
