"""What a run is made of, resolved once from the configuration: types, ranges and what follows from several options.

Nothing below :func:`franka_wm.training.run.start` sees Hydra's configuration: parts take these settings or plain
values.
"""

from franka_wm.training.settings.groups import (
    CollectorSettings,
    EnvSettings,
    EvaluationSettings,
    ModelSettings,
    TrainerSettings,
)
from franka_wm.training.settings.run import RunSettings, plain

__all__ = [
    "CollectorSettings",
    "EnvSettings",
    "EvaluationSettings",
    "ModelSettings",
    "RunSettings",
    "TrainerSettings",
    "plain",
]
