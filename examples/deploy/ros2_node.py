"""Skeleton of a ROS 2 node around an exported agent. It was never run: there was no ROS where it was written.

It subscribes to `/camera/image_raw` (sensor_msgs/Image, rgb8, of the size that the agent was trained on), publishes the action on `/cmd`
(std_msgs/Float32MultiArray) and the verdict on `/verdict` (std_msgs/String). When the proof does not apply it publishes zeros:
whether that is a safe thing to do is for you to say. See run_onnx.py for the same loop on a film, which is tested.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import rclpy
from rclpy.node import Node
from run_onnx import OnnxAgent
from sensor_msgs.msg import Image
from std_msgs.msg import Float32MultiArray, String


class SafeAgentNode(Node):
    """Acts once per picture."""

    def __init__(self, path: Path) -> None:
        super().__init__("sspl_agent")
        self.agent = OnnxAgent(path)
        self.taken: np.ndarray | None = None  # the last command
        self.actions = self.create_publisher(Float32MultiArray, "/cmd", 1)
        self.verdicts = self.create_publisher(String, "/verdict", 1)
        self.create_subscription(Image, "/camera/image_raw", self.on_image, 1)

    def on_image(self, message: Image) -> None:
        """One step of the agent."""
        frame, stamp = None, message.header.stamp
        if message.encoding == "rgb8":
            frame = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)[:, : 3 * message.width]
            frame = frame.reshape(message.height, message.width, 3)
        else:
            self.get_logger().error(f"expected rgb8, received {message.encoding}")
        # A frame that the queue of one has dropped shows in the time of the next.
        action, verdict, _ = self.agent.step(frame, self.taken, stamp.sec + 1e-9 * stamp.nanosec)
        taken = action if verdict == "proof applies" else np.zeros_like(action)
        self.taken = taken
        self.actions.publish(Float32MultiArray(data=taken.tolist()))
        self.verdicts.publish(String(data=verdict))


def main() -> None:
    """Run until it is interrupted."""
    rclpy.init()
    node = SafeAgentNode(Path(sys.argv[1]))
    rclpy.spin(node)


if __name__ == "__main__":
    main()
