"""What every training run needs: a folder, a device, metrics and checkpoints."""

from typing import Literal

DeviceName = Literal["auto", "cpu", "cuda"]
MODEL = "pretrained_model"
"""Folder of the model in a checkpoint, as in LeRobot."""
