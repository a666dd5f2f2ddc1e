"""Watching one arm: a page in the browser that plans while you drag its goal, and recordings for Rerun.

`stage` builds the world for `franka-wm view`; `session` simulates and knows nothing of browsers; `viser_scene` and
`page` show a session with viser; `rerun_recording` writes an episode for the Rerun viewer.
"""
