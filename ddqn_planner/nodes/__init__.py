"""The three ROS 2 nodes and the message conversions; nothing else of the package imports rclpy."""
