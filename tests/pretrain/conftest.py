"""Fixtures of the learning tests."""

import pytest
import torch


@pytest.fixture(autouse=True)
def fp32_products():
    """Undo what a run before allowed: it sets the precision of products for the whole process."""
    torch.backends.mkldnn.matmul.fp32_precision = "ieee"
