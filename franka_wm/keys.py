"""Keys that several rooms read, of which some may import nothing heavy."""

LOST = "overflow"
"""Of a step: contacts were lost in it, where there is a scene."""

DERIVED = "derived"
"""Of a checkpoint's configuration: what of ``model`` the model had found itself, since nothing was asked for."""
