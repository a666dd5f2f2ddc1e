"""``franka-wm publish``: a dataset or a trained model to the Hugging Face Hub."""

from __future__ import annotations

from typing import Any

from franka_wm.commands.arguments import FLAG, verb, word
from franka_wm.errors import UserError


@verb("publish")
@word("repo_id", "where it goes", metavar="USER/NAME", required=True)
@word("root", "a LeRobot dataset on disk", metavar="DATASET")
@word(
    "checkpoint", "a run's folder, or a checkpoint in it: weights, configuration, evaluation", metavar="RUN"
)
@word("private", "whether only you can see it", FLAG, True)
@word("license", "as the Hub names licenses", default="apache-2.0")
@word("update", "the repository exists already: replace what is in it", FLAG, False)
@word("dry_run", "show what would be sent, write the card to outputs/publish, and send nothing", FLAG, False)
def publish(root: str | None, checkpoint: str | None, repo_id: str, **shared: Any) -> None:
    """Send a dataset or a model to the Hugging Face Hub.

    Give root=DATASET or checkpoint=RUN. A token that may write is needed: hf auth login, or the variable HF_TOKEN.
    """
    if bool(root) == bool(checkpoint):
        raise UserError("publish: give root=DATASET or checkpoint=RUN, one of them")
    if root:
        from franka_wm.data.lerobot.publish import publish_dataset

        publish_dataset(root, repo_id, **shared)
    else:
        from franka_wm.training.publish import publish_model

        publish_model(str(checkpoint), repo_id, **shared)
