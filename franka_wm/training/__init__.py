"""The training loop and what it keeps: checkpoints, logs, several processes."""
