"""The columns of a car's state: the last axis of the array (worlds, cars, N_STATE).

The origin of the car frame is the centre of gravity, x forward, y left. A state is one row of these:
arrays hold it as float32, the scalar functions of `dynamics` pass it as a tuple in the same order.
"""

from __future__ import annotations

X = 0  # [m] map frame, centre of gravity
Y = 1  # [m]
STEER = 2  # [rad] angle of the front wheels, left positive
SPEED = 3  # [m/s] of the centre of gravity along its direction of travel, negative in reverse
YAW = 4  # [rad] heading of the car's x axis, in (-pi, pi]
YAW_RATE = 5  # [rad/s]
SLIP = 6  # [rad] angle from the car's x axis to its direction of travel (turned by pi in reverse)
WHEEL_SPEED_FRONT = 7  # [rad/s]
WHEEL_SPEED_REAR = 8  # [rad/s]
N_STATE = 9
