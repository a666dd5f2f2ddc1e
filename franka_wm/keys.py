"""Keys of what steps hold, where several rooms read them and some of these may import nothing heavy."""

LOST = "overflow"
"""The flag of a step in which contacts were lost, where there is a scene."""

CONTEXT = "context"
"""The last latent that a policy saw, of a model with memory: it carries it from step to step."""
