"""Codes: the nearest is taken, gradients pass through, used codes follow and unused ones revive."""

from __future__ import annotations

import pytest
import torch

from vqvae.codebook import Codebook


def codebook(*codes: tuple[float, ...], decay: float = 0.9, revive_after: int = 3) -> Codebook:
    """Return a codebook that holds these codes, as if they had been assigned one vector each."""
    made = Codebook(len(codes), len(codes[0]), decay, revive_after)
    made.code.copy_(torch.tensor(codes))
    made._total.copy_(made.code)
    made._idle.zero_()
    return made


def test_the_nearest_code_is_taken():
    torch.manual_seed(0)
    book, vectors = codebook(*torch.randn(20, 3).tolist()), torch.randn(200, 3)
    expected = torch.cdist(vectors, book.code).argmin(1)
    codes, index = book(vectors)
    assert (index == expected).all() and torch.allclose(codes, book.code[expected], atol=1e-6)


def test_gradients_pass_straight_through_to_the_vectors():
    vectors = torch.tensor([[0.2, 0.1], [0.8, 0.9]], requires_grad=True)
    codes, _ = codebook((0.0, 0.0), (1.0, 1.0))(vectors)
    slope = torch.tensor([[1.0, -2.0], [3.0, 0.5]])
    (codes * slope).sum().backward()
    assert vectors.grad is not None and torch.equal(vectors.grad, slope)


def test_a_code_ends_in_the_mean_of_what_is_assigned_to_it():
    book = codebook((0.0, 0.0), (9.0, 9.0), revive_after=1000)
    vectors = torch.tensor([[1.0, 2.0], [3.0, 4.0], [9.0, 9.5]])
    for _ in range(200):
        book.follow(vectors, book.nearest(vectors))
    assert torch.allclose(book.code, torch.tensor([[2.0, 3.0], [9.0, 9.5]]), atol=1e-3)


def test_a_code_follows_no_faster_than_its_decay():
    book = codebook((0.0,), decay=0.9)
    book.follow(torch.ones(1, 1), torch.zeros(1, dtype=torch.int64))
    assert book.code.item() == pytest.approx(0.1, abs=1e-4)


def test_a_code_that_goes_unused_is_put_onto_a_vector_of_the_batch_and_not_before():
    book = codebook((0.0, 0.0), (50.0, 50.0), revive_after=3)
    vectors = torch.tensor([[0.1, 0.0], [0.0, 0.2]])
    revived = [book.follow(vectors, book.nearest(vectors)) for _ in range(4)]
    assert revived == [0, 0, 0, 1]
    assert any(torch.allclose(book.code[1], vector, atol=1e-4) for vector in vectors)


def test_used_codes_are_left_alone():
    torch.manual_seed(0)
    book, vectors = codebook((0.0,), (1.0,), revive_after=1), torch.tensor([[0.0], [1.0]])
    assert sum(book.follow(vectors, book.nearest(vectors)) for _ in range(50)) == 0
    assert torch.allclose(book.code, vectors, atol=1e-3)


def test_a_fresh_codebook_starts_on_its_data_and_comes_into_use():
    torch.manual_seed(0)
    book, vectors = Codebook(16, 2, 0.99, 5), 100.0 + torch.randn(400, 2)
    assert book.follow(vectors, book.nearest(vectors)) >= 15
    for _ in range(60):
        book.follow(vectors, book.nearest(vectors))
    assert len(book.nearest(vectors).unique()) >= 15
