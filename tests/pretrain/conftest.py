"""Fixtures of the learning tests."""

import pytest
import torch


@pytest.fixture(autouse=True)
def fp32_products():
    """Undo what a run allows, before and after: it sets the precision for the whole process."""
    torch.backends.mkldnn.matmul.fp32_precision = "ieee"
    yield
    torch.backends.mkldnn.matmul.fp32_precision = "ieee"
