"""A model that is exact."""

from __future__ import annotations

import pytest

from franka_wm.models import WorldModel


class PointModel(WorldModel):
    """A model that is exact for points that move as their actions say: z' = z + a."""

    observation_sizes = {"position": 2}
    action_dim, latent_dim = 2, 2

    def encode(self, observation):
        return observation.get("position")

    def next(self, z, action):
        return z + action


@pytest.fixture
def point_model() -> PointModel:
    return PointModel()
