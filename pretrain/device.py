"""Where and with how many threads the networks run."""

from __future__ import annotations

import torch

from eisp_data.runs.device import choose_device
from eisp_data.sim.physics import default_threads
from pretrain.config import DeviceName


def set_up(device: DeviceName, threads: int) -> str:
    """Choose the device and the threads for the networks; return what torch calls the device.

    Products of fp32 matrices may take bf16 passes where the processor has them: twice as fast.

    Args:
        device: ``auto`` takes CUDA where there is one.
        threads: of each operation of the networks, on a processor.
    """
    chosen = choose_device(device)
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision("medium")
    return chosen


def describe(device: str, threads: int) -> str:
    """Return one line that says what is used."""
    if device == "cuda":
        return f"networks on {torch.cuda.get_device_name()}, physics on {default_threads()}"
    return f"networks on {threads} thread(s), physics on {default_threads()}"
