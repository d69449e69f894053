"""A progress bar of episodes, for commands that learn how many there are only on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

_DELAY_S = 1.0
"""What is done, or refused, sooner needs no bar."""


@contextmanager
def counting(what: str) -> Iterator[Callable[[int], None]]:
    """Yield a function to be told, every now and then, how many episodes there are by then."""
    from tqdm import tqdm

    with tqdm(desc=what, unit="ep", delay=_DELAY_S) as bar:

        def show(episodes: int) -> None:
            bar.update(episodes - bar.n)

        yield show
