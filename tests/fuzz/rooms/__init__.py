"""Rooms of the fuzz tests: each damages something valid in one to three places and lets the package read it."""
