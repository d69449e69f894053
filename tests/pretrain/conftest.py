"""Fixtures of the learning tests."""

import pytest
import torch


@pytest.fixture(autouse=True)
def fp32_products():
    """Undo what a run allows: it sets the precision of products for the whole process."""
    yield
    torch.backends.mkldnn.matmul.fp32_precision = "ieee"
