"""Run a policy as a ROS 2 node. Not tested: no test of this repository has ROS.

    python robot_loop_ros2.py --ros-args -p policy:=walk.npz -p joints:="[FL_hip_joint, ...]"

Subscribes to `imu` (base frame), `joint_states` and `cmd_vel`. Publishes joint targets [rad] in the order of `joints`
to `/forward_position_controller/commands`; the gains of the policy belong in the controller of the motors.
"""

import numpy as np
import rclpy
from geometry_msgs.msg import Twist
from rclpy.node import Node
from robot_loop import PolicyLoop
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray


class PolicyNode(Node):
    """Calls the loop with the period of the policy, once IMU and joints have been heard."""

    def __init__(self):
        super().__init__("policy")
        self.joints = list(self.declare_parameter("joints", [""]).value)
        self.loop = PolicyLoop(self.declare_parameter("policy", "walk.npz").value, self.joints)
        self.imu, self.state, self.command = None, None, np.zeros(3)
        self.create_subscription(Imu, "imu", lambda message: setattr(self, "imu", message), 1)
        self.create_subscription(JointState, "joint_states", lambda message: setattr(self, "state", message), 1)
        self.create_subscription(Twist, "cmd_vel", self.hear_command, 1)
        self.targets = self.create_publisher(Float64MultiArray, "/forward_position_controller/commands", 1)
        self.create_timer(self.loop.spec["control_dt"], self.act)

    def hear_command(self, message):
        """Take a command: forward and sideways velocity [m/s], yaw rate [rad/s]."""
        self.command = np.array([message.linear.x, message.linear.y, message.angular.z])

    def act(self):
        """Publish targets for the newest measurements."""
        if self.imu is None or self.state is None:
            return
        rows = [list(self.state.name).index(name) for name in self.joints]
        turn, rate, stamp = self.imu.orientation, self.imu.angular_velocity, self.state.header.stamp
        targets = self.loop.step(
            stamp=stamp.sec + 1e-9 * stamp.nanosec,
            quaternion=[turn.w, turn.x, turn.y, turn.z],
            gyro=[rate.x, rate.y, rate.z],
            positions=np.array(self.state.position)[rows],
            velocities=np.array(self.state.velocity)[rows],
            command=self.command,
            now=self.get_clock().now().nanoseconds * 1e-9,
        )
        self.targets.publish(Float64MultiArray(data=targets.tolist()))
        if self.loop.steps % 500 == 0:
            self.get_logger().info(f"{self.loop.steps} steps, violations: {self.loop.counts}")


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(PolicyNode())
