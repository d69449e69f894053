"""Where the robots' URDFs and meshes are."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from eisp_data.errors import ConfigError

_PACKAGE = "example-robot-data"


def models_folder() -> Path:
    """Return the folder that ``package://example-robot-data/robots`` stands for.

    Raises:
        ConfigError: the ``robot`` extra is not installed.
    """
    try:
        # It has no Python module to import, only files under its prefix.
        installed = distribution(_PACKAGE)
    except PackageNotFoundError:
        raise ConfigError(
            f"the robots' models need {_PACKAGE}: pip install 'eisp[robot]'"
        ) from None
    return Path(str(installed.locate_file("cmeel.prefix/share/example-robot-data/robots")))
