#!/usr/bin/env python3
"""A ROS 2 node that drives an F1TENTH car with an exported policy.

    python3 outlap_driver.py --ros-args -p policy:=/path/to/policy.onnx -p speed_limit:=3.0

Subscribes to /scan (sensor_msgs/LaserScan) and /odom (nav_msgs/Odometry), and publishes /drive
(ackermann_msgs/AckermannDriveStamped) at the policy's own rate. On a simulator's topics: remap them, for example
`-r /odom:=/ego_racecar/odom`. On the car it needs rclpy, NumPy, onnxruntime and outlap (`pip install --no-deps .`).

When a sensor fails, the car stops, and the reason is logged. Keep a finger on the dead man's switch all the same, and
begin with a low `speed_limit`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import rclpy
from ackermann_msgs.msg import AckermannDriveStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

from outlap.deploy import CarDriver, Command


class Loop:
    """The newest messages, and what to do about them. Knows nothing of ROS but the messages' fields."""

    def __init__(self, driver: CarDriver, speed_limit: float) -> None:
        """Drive no faster than `speed_limit` [m/s]; raises ValueError where that is negative or NaN."""
        if not speed_limit >= 0.0:
            raise ValueError(f"speed_limit is {speed_limit}; must be 0 m/s or more")
        self.driver, self.speed_limit = driver, speed_limit
        self.scan: Any = None
        self.odometry: Any = None

    def command(self, now: float) -> Command:
        """What to do at a time [s] of the messages' clock."""
        if self.scan is None or self.odometry is None:
            return Command(0.0, 0.0, f"no {'scan' if self.scan is None else 'odometry'} yet")
        twist = self.odometry.twist.twist
        command = self.driver.drive(
            self.scan.ranges,
            self.scan.angle_min,
            self.scan.angle_increment,
            (twist.linear.x, twist.linear.y, twist.angular.z),
            scan_age=now - _seconds(self.scan.header.stamp),
            odometry_age=now - _seconds(self.odometry.header.stamp),
        )
        if not (math.isfinite(command.steering_angle) and math.isfinite(command.speed)):  # min and max let NaN through
            return Command(0.0, 0.0, f"the command is {command.steering_angle} rad, {command.speed} m/s")
        return replace(command, speed=max(-self.speed_limit, min(self.speed_limit, command.speed)))


class OutlapDriver(Node):
    def __init__(self) -> None:
        super().__init__("outlap_driver")
        path = self.declare_parameter("policy", "policy.onnx").value
        self._loop = Loop(CarDriver(path), float(self.declare_parameter("speed_limit", 3.0).value))
        self._reason = ""
        self.create_subscription(LaserScan, "/scan", self._on_scan, qos_profile_sensor_data)
        self.create_subscription(Odometry, "/odom", self._on_odometry, 10)
        self._drive = self.create_publisher(AckermannDriveStamped, "/drive", 10)
        self.create_timer(self._loop.driver.interval, self._on_time)

    def _on_scan(self, message: LaserScan) -> None:
        self._loop.scan = message

    def _on_odometry(self, message: Odometry) -> None:
        self._loop.odometry = message

    def _on_time(self) -> None:
        now = self.get_clock().now()
        command = self._loop.command(now.nanoseconds * 1e-9)
        if command.reason != self._reason:
            self._reason = command.reason
            self.get_logger().warning(f"stopped: {command.reason}" if command.reason else "driving")
        message = AckermannDriveStamped()
        message.header.stamp = now.to_msg()
        message.drive.steering_angle = command.steering_angle
        message.drive.speed = command.speed
        self._drive.publish(message)


def _seconds(stamp: Any) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec


def main() -> None:
    rclpy.init()
    node = OutlapDriver()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
