"""The three ROS 2 nodes and the message conversions; nothing else of the package imports rclpy."""

import os

# NumPy is imported after this. The networks' products are small: more threads than one only wait
# for each other, ten times as long on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
