"""Replay on the training device; LeRobot datasets written and read."""
