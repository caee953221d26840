"""Clocks: a steady one for timers, and jumps of the node's own clock."""

from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration

STEADY = Clock(clock_type=ClockType.STEADY_TIME)  # for timers, without simulated time

# As tf2 has it. Another clock, by use_sim_time, counts as a jump, too.
JUMP_BACK = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-1))
