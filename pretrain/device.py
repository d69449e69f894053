"""Where and with how many threads the networks run."""

from __future__ import annotations

import torch

from eisp_data.runs.device import choose_device
from eisp_data.sim.physics import default_threads
from pretrain.config import DeviceName


def set_up(device: DeviceName, threads: int) -> str:
    """Choose the device and the threads for the networks; return what torch calls the device.

    It allows bf16 in hidden layers on a processor that multiplies it, and TF32 on a GPU.

    Args:
        device: ``auto`` takes CUDA where there is one.
        threads: of each operation of the networks, on a processor.
    """
    chosen = choose_device(device)
    torch.set_num_threads(threads)
    # By back end: libraries that set them all at once and ours would be in each other's way.
    torch.backends.mkldnn.matmul.fp32_precision = "bf16"  # type: ignore[attr-defined]
    torch.backends.cuda.matmul.fp32_precision = "tf32"
    return chosen


def describe(device: str, threads: int) -> str:
    """Return one line that says what is used."""
    if device == "cuda":
        return f"networks on {torch.cuda.get_device_name()}, physics on {default_threads()}"
    return f"networks on {threads} thread(s), physics on {default_threads()}"
