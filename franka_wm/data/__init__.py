"""Policies that gather data, and the replay buffer that keeps it."""
