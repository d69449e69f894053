"""Several datasets of one spec into one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eisp_data.errors import DataError
from eisp_data.storage.episodes import check_cameras, read_index
from eisp_data.storage.reader import read_blocks, read_recipe, read_spec
from eisp_data.storage.rewrite import Source, rewrite
from eisp_data.storage.video_checks import check_frame_counts


def merge(roots: Sequence[Path], to: Path) -> int:
    """Write all episodes of ``roots``, in order, into the new dataset ``to``; return how many.

    A single root is allowed: its small files are packed into large ones. The recipe of the result
    is the roots' common one, or ``{"merged": [recipe, …]}``, each recipe once.

    Raises:
        DataError: a root cannot be read whole, the specs differ (names the field and both
            values), or ``to`` exists.
    """
    if not roots:
        raise DataError("nothing to merge: name at least one dataset")
    spec = read_spec(roots[0])
    sources, recipes = [], list[dict[str, Any]]()
    for root in roots:
        other = read_spec(root).to_json()
        for name, value in spec.to_json().items():
            if other[name] != value:
                raise DataError(
                    f"{root}: {name} is {other[name]!r}; in {roots[0]} it is {value!r}: "
                    "datasets of different specs cannot be merged"
                )
        for _ in read_blocks(root, spec):  # every row is looked at before anything is written
            pass
        index = read_index(root)
        check_cameras(index, spec)
        check_frame_counts(index, spec)  # videos are copied unseen, so damage would go along
        sources.append(Source(index, range(len(index))))
        recipe = read_recipe(root)
        for one in recipe["merged"] if list(recipe) == ["merged"] else [recipe]:
            recipes += [] if one in recipes else [one]
    recipe = recipes[0] if len(recipes) == 1 else {"merged": recipes}
    rewrite(sources, to, spec, recipe)
    return sum(len(source.keep) for source in sources)
