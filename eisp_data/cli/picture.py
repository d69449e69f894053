"""``eisp-data replay``, ``eisp-data render`` and ``eisp-data view``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Replay:
    """Options of ``eisp-data replay``."""

    path: tyro.conf.Positional[Path]
    """The dataset's folder."""
    episodes: tuple[int, ...] = ()
    """Numbers of the episodes; all if left out."""


@dataclass(frozen=True)
class Render:
    """Options of ``eisp-data render``."""

    path: tyro.conf.Positional[Path]
    """The dataset's folder; it is not changed."""
    to: Path
    """Folder of the copy with images."""
    cameras: tuple[str, ...] = ("front",)
    """Cameras of the scene: front, top, shoulder."""
    height: int = 48
    """Pixels, even."""
    width: int = 48
    """Pixels, even."""


@dataclass(frozen=True)
class View:
    """Options of ``eisp-data view``."""

    path: tyro.conf.Positional[Path]
    """The dataset's folder."""
    to: Path = Path("view")
    """Folder for the picture and the film."""
    episode: int = 0
    """Which episode."""
    camera: str = ""
    """A camera of the scene, or of the dataset if it was recorded on a robot."""
    rerun: bool = False
    """Write a Rerun recording too."""


def replay(options: tyro.conf.OmitArgPrefixes[Replay]) -> None:
    """Simulate recorded episodes again and print the largest deviation."""
    from eisp_data.replay import replay as simulate

    largest = 0.0
    for found in simulate(options.path, options.episodes):
        largest = max(largest, found.whole)
        print(
            f"episode {found.episode}: largest deviation {found.whole:.3g} (at step "
            f"{found.at_step}), {found.one_step:.3g} within one step"
        )
    print(f"largest deviation {largest:.3g}")


def render(options: tyro.conf.OmitArgPrefixes[Render]) -> None:
    """Write a copy of a dataset with camera images, drawn from its simulator states."""
    from eisp_data.cli.progress import counting
    from eisp_data.replay import render as draw

    cameras = {name: (options.height, options.width) for name in options.cameras}
    with counting("drawing") as show:
        count = draw(options.path, options.to, cameras, show)
    print(f"{count} episodes in {options.to}")


def view(options: tyro.conf.OmitArgPrefixes[View]) -> None:
    """Draw an episode with goal and current subgoal: a storyboard, a film, a Rerun recording."""
    from eisp_data.view import view as make

    found = make(options.path, options.to, options.episode, options.camera, options.rerun)
    print("\n".join(map(str, found)))
