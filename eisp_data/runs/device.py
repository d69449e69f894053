"""Where the networks run."""

from __future__ import annotations

import torch

from eisp_data.errors import ConfigError
from eisp_data.runs import DeviceName


def choose_device(device: DeviceName) -> str:
    """Return what torch calls the device; ``auto`` takes CUDA where there is one.

    Raises:
        ConfigError: CUDA is asked for and there is none.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device cuda: this torch sees no CUDA device; choose auto or cpu")
    return "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"
