"""Sizes and poses of the arm that everything shares."""

NUM_JOINTS = 7
NUM_FINGERS = 2
MOST_OPEN = 0.04
"""Largest distance of a finger from the closed position [m]: the hand opens to twice that."""

STATE_DIM = 20
"""Numbers of ``state`` without a gripper: joints 7, velocities 7, tool 3, tool − goal 3."""
HAND_DIM = 8
"""What a gripper adds to them: fingers 2 [m], their speeds 2 [m/s], the tool's quaternion x y z w."""

HOME = (0.0, -0.4, 0.0, -2.0, 0.0, 1.6, 0.8)
"""Home pose of the seven arm joints [rad]."""

OBJECT_DIM = 13
"""Numbers of each object: position 3 [m], quaternion x y z w, velocity 3 [m/s], angular velocity 3 [rad/s]."""

JOINT_DIM = 2
"""Numbers of each articulated body's joint: how far it is open [m or rad], and its speed [m/s or rad/s]."""
