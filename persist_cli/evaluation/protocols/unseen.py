"""Revisits in houses and simulators that no training has seen, a table for each data set."""

from __future__ import annotations

import dataclasses

from persist_cli.evaluation.cases import Case
from persist_cli.evaluation.protocols.protocol import Selected, trajectories
from persist_cli.evaluation.protocols.revisit import Revisit
from persist_cli.world.errors import DataError


class Unseen(Revisit):
    """As ``revisit``, on data whose origin shows that it was not trained on."""

    name = "unseen"
    title = "Unseen houses and simulators"
    definition = (
        f"as revisit ({Revisit.definition}); no scene comes from the simulator's training split or from the model's "
        "training data, and each data set has a table of its own"
    )
    domains = True

    def find(self, asked: Selected) -> list[Case]:
        """The most clips of each data set."""
        for file in trajectories(asked.folders):
            source = file.info.source
            if source.get("split") == "train":
                raise DataError(f"{file.path}: its scene is of the training split; collect with --split test")
            if file.info.scene in asked.training_scenes:
                raise DataError(f"{file.path}: the model was trained on its scene {file.info.scene!r}")
        found: list[Case] = []
        for folder in asked.folders:
            found += super().find(dataclasses.replace(asked, folders=[folder]))
        return found
