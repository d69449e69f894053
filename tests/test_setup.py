"""The set-up script and the pinned versions."""

import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PIN = re.compile(r"[a-z0-9-]+==[^;@ ]+")
PINS = dict(
    line.split("==")
    for line in (ROOT / "constraints.txt").read_text().splitlines()
    if not line.startswith("#")
)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
REQUIREMENTS = {
    extra: [Requirement(text) for text in texts]
    for extra, texts in {
        "": PROJECT["dependencies"],
        **PROJECT["optional-dependencies"],
    }.items()
}
TOOLS = ("sh", "dirname", "cat")
"""All that the script needs besides a Python."""


@pytest.fixture
def bare_machine(tmp_path):
    """An environment whose PATH has no Python at all, and an empty home."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in TOOLS:
        path = subprocess.run(["which", tool], capture_output=True, text=True, check=True).stdout
        (folder / tool).symlink_to(path.strip())
    return {"PATH": str(folder), "HOME": str(tmp_path / "home")}


def find_python(environment):
    return subprocess.run(
        [ROOT / "setup.sh", "--find-python"], env=environment, capture_output=True, text=True
    )


def put_python(folder: Path, name: str) -> Path:
    """Make an interpreter of that name that is the one of these tests."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(f'#!/bin/sh\nexec {getattr(sys, "_base_executable", sys.executable)} "$@"\n')
    path.chmod(0o755)
    return path


def put_broken(folder: Path, name: str) -> None:
    """Make what pyenv puts on PATH for a version that is not active."""
    (folder / name).write_text("#!/bin/sh\nexit 127\n")
    (folder / name).chmod(0o755)


def test_a_python_on_path_is_found(bare_machine):
    python = put_python(Path(bare_machine["PATH"]), "python3.12")
    done = find_python(bare_machine)
    assert (done.returncode, done.stdout.strip()) == (0, str(python)), done.stderr


def test_pyenvs_version_is_found_though_it_is_not_active(bare_machine):
    put_broken(Path(bare_machine["PATH"]), "python3.12")
    put_broken(Path(bare_machine["PATH"]), "python3")
    python = put_python(Path(bare_machine["HOME"]) / ".pyenv/versions/3.12.1/bin", "python3")
    done = find_python(bare_machine)
    assert (done.returncode, done.stdout.strip()) == (0, str(python)), done.stderr


def test_uv_is_asked_where_it_is_there(bare_machine, tmp_path):
    python = put_python(tmp_path / "elsewhere", "python3")
    uv = Path(bare_machine["PATH"]) / "uv"
    uv.write_text(f"#!/bin/sh\necho {python}\n")
    uv.chmod(0o755)
    assert find_python(bare_machine).stdout.strip() == str(python)


def test_without_any_python_it_says_what_to_install(bare_machine):
    put_broken(Path(bare_machine["PATH"]), "python3")
    done = find_python(bare_machine)
    assert done.returncode == 1
    assert done.stdout == ""
    assert "apt install python3.12" in done.stderr


def test_a_named_python_that_is_none_is_refused(bare_machine):
    done = find_python(bare_machine | {"PYTHON": "no-such-python"})
    assert done.returncode == 1
    assert done.stderr.startswith("error: PYTHON=no-such-python")


def test_constraints_are_pins_and_nothing_else():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    assert len(pins) > 50
    assert [pin for pin in pins if not PIN.fullmatch(pin)] == []
    assert pins == sorted(set(pins), key=lambda pin: pin.partition("==")[0])


def test_every_dependency_is_pinned_to_the_version_that_is_tested():
    closure = runpy.run_path(str(ROOT / ".ci/constraints.py"))["resolved_versions"]
    installed = closure([*REQUIREMENTS[""], *REQUIREMENTS["dev"]])
    assert {name: PINS.get(name) for name in installed} == installed, "run make constraints"


@pytest.mark.parametrize("extra", REQUIREMENTS)
def test_every_declared_dependency_allows_its_pin(extra):
    for requirement in REQUIREMENTS[extra]:
        assert requirement.specifier.contains(PINS[requirement.name]), requirement
