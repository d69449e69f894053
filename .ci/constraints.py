"""Print constraints.txt: what the project and its extras resolved to in this environment."""

from __future__ import annotations

import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

_HEADER = """\
# The versions that are known to work together, one for each package that the project or one of its
# extras needs. Written by `make constraints` from what is installed in .venv; to move to newer
# versions: .venv/bin/pip install --upgrade PACKAGE, make test, make constraints.
"""


def declared_requirements(pyproject: Path) -> list[Requirement]:
    """Return what pyproject.toml asks for, with and without extras."""
    project = tomllib.loads(pyproject.read_text())["project"]
    groups = [project["dependencies"], *project.get("optional-dependencies", {}).values()]
    return [Requirement(text) for group in groups for text in group]


def resolved_versions(requirements: list[Requirement]) -> dict[str, str]:
    """Return name to version of all that the requirements lead to and that is installed here."""
    versions: dict[str, str] = {}
    seen: set[tuple[str, str]] = set()
    queue = [(requirement, "") for requirement in requirements]
    while queue:
        requirement, extra = queue.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(requirement.name)
        for wanted in ("", *requirement.extras):
            if (name, wanted) in seen:
                continue
            seen.add((name, wanted))
            try:
                installed = distribution(name)
            except PackageNotFoundError:
                raise SystemExit(f"error: {name} is missing; use make constraints") from None
            versions[name] = installed.version
            queue += [(Requirement(text), wanted) for text in installed.requires or []]
    return versions


if __name__ == "__main__":
    needed = resolved_versions(declared_requirements(Path("pyproject.toml")))
    print(_HEADER + "\n".join(f"{name}=={needed[name]}" for name in sorted(needed)))
