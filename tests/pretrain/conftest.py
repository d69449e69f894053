"""Fixtures of the learning tests."""

import pytest
import torch


@pytest.fixture(autouse=True)
def fp32_products():
    """Undo what a run allows: it sets the precision of products for the whole process."""
    yield
    torch.set_float32_matmul_precision("highest")
