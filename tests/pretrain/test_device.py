"""Who gets how many cores."""

import torch

from pretrain.device import set_up
from pretrain.learner import threads_of_half


def test_inference_gets_the_threads_it_asks_for_and_a_half_of_an_update_half_of_them():
    threads = torch.get_num_threads()
    try:
        assert set_up("cpu", 3) == "cpu"
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)
    assert [threads_of_half(count) for count in (1, 2, 3, 4)] == [1, 1, 1, 2]
