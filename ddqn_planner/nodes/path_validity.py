"""Nav2's IsPathValid: which poses of a path are not free for the robot."""

from typing import Any, NamedTuple

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from std_msgs.msg import Header

from ddqn_planner.nodes.conversions import frame_of, in_outer_frame, pose_of, poses_of
from ddqn_planner.nodes.outcome import RequestError
from ddqn_planner.nodes.reasons import THE_START
from ddqn_planner.nodes.requests import (
    PlanInputs,
    Requests,
    clearing_radius,
    clearing_radius_of_body,
)
from ddqn_planner.planning.path_check import LETHAL, Float64, invalid_poses
from ddqn_planner.planning.pose_paths import points_of
from ddqn_planner.robot.footprint import read_footprint


class PathCheck(NamedTuple):
    """The fields of a request IsPathValid; releases of Nav2 have added most of them."""

    path: Path
    footprint: str  # as Nav2 writes it; empty: the model's body, or a disc
    layer_name: str  # of a costmap
    is_unknown_invalid: bool
    max_cost: int  # Nav2's cost, 0 to 255: a cell that costs as much is not free
    distance: float  # metres along the path to look at; 0: all
    only_first: bool  # return the first invalid pose alone

    @classmethod
    def of_message(cls, message: Any) -> "PathCheck":
        """Return the check that a message of any release asks for."""
        return cls(
            path=message.path,
            footprint=getattr(message, "footprint", ""),
            layer_name=getattr(message, "layer_name", ""),
            is_unknown_invalid=getattr(message, "consider_unknown_as_obstacle", False),
            max_cost=getattr(message, "max_cost", LETHAL),
            distance=getattr(message, "max_lookahead_distance", 0.0),
            only_first=getattr(message, "stop_at_first_collision", True),
        )


async def check_path(
    requests: Requests, check: PathCheck, needs_robot: bool
) -> list[int]:
    """Return the indices of a path's poses that are not free, from the robot's pose on.

    Parameters
    ----------
    requests : Requests
        Of the node: it waits for the map, the model and poses.
    check : PathCheck
    needs_robot : bool
        Whether an unknown pose of the robot is an error. Otherwise all poses of the
        path are checked then.

    Raises
    ------
    ValueError
        If the path cannot be judged.
    """
    inputs = await requests.inputs()
    grid, planner = inputs.grid, inputs.planner
    body = None  # for a disc the cell of each pose has to be free
    if check.footprint:
        body = points_of(read_footprint(check.footprint), grid.resolution)
    elif planner.pose_planner is not None:
        body = planner.pose_planner.points
    if check.layer_name:
        problem = f"layer_name is {check.layer_name!r}"
        raise ValueError(
            f"{problem}, and the planner has one map without layers; leave it empty"
        )
    poses = await poses_in_map(requests, inputs, check.path, has_body=body is not None)
    radius = clearing_radius(requests.settings, grid)  # cells
    if body is not None:
        radius = clearing_radius_of_body(requests.settings) / grid.resolution
    robot = None
    try:
        robot = await robot_in_map(requests, inputs)
    except RequestError:
        if needs_robot:
            raise
    invalid: list[int] = invalid_poses(
        poses,
        grid,
        robot=robot,
        body=body,
        unknown=requests.map.unknown if check.is_unknown_invalid else None,
        max_cost=check.max_cost,
        distance=check.distance,
        clearing_radius=radius,
    ).tolist()
    return invalid[:1] if check.only_first else invalid


async def poses_in_map(
    requests: Requests, inputs: PlanInputs, path: Path, has_body: bool
) -> Float64:
    """Return the N poses of a path in the map's frame, (N, 3): metres and radians.

    `inputs` has the map. Without a body the headings do not count: they are taken for 0
    in the frame of the path. The transform of another frame is waited for.
    """
    poses = poses_of(path, with_yaw=has_body)
    map_frame: str = inputs.header.frame_id
    frame = frame_of(path) or map_frame
    if frame == map_frame:
        return poses
    origin = PoseStamped(header=Header(frame_id=frame))
    origin.pose.orientation.w = 1.0
    origin_in_map = await requests.in_map(inputs, "the path", origin)
    return in_outer_frame(poses, pose_of(origin_in_map.message))


async def robot_in_map(requests: Requests, inputs: PlanInputs) -> tuple[float, float]:
    """Return where the robot is in the map's frame, (x, y) in metres."""
    stamped = await requests.robot()
    start = await requests.in_map(inputs, THE_START, stamped)
    x, y, _ = pose_of(start.message)
    return x, y
