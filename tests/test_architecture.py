"""What holds for the repository as a whole."""

import ast
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PACKAGES = ("eisp_data", "vqvae", "pretrain", "finetune")
HEAVY = {"torch", "lerobot", "cv2", "datasets"}
WITHOUT_METADATA = ("coal", "pinocchio", "rerun", "rtde_control", "rtde_receive")
"""Of ``pin``, which does not say what it provides, and of extras that need not be installed."""
COMMANDS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


def tracked_files() -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def imported_packages(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            names.add(node.module or "")
    return {name.partition(".")[0] for name in names}


@pytest.mark.parametrize("package", PACKAGES)
def test_data_flow_one_way(package):
    right_of_it = set(PACKAGES[PACKAGES.index(package) + 1 :])
    modules = sorted((ROOT / package).rglob("*.py"))
    assert modules
    for path in modules:
        wrong = imported_packages(path) & right_of_it
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def test_whatever_is_imported_is_declared():
    """A package that only another one brings may be gone, or older, with its next release."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    optional = project["optional-dependencies"].values()
    wanted = [*project["dependencies"], *(line for extra in optional for line in extra)]
    declared = {Requirement(line).name.lower() for line in wanted}
    modules = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    imported = set().union(*map(imported_packages, modules))
    of_others = imported - set(sys.stdlib_module_names) - set(PACKAGES) - set(WITHOUT_METADATA)
    provided = packages_distributions()
    for name in of_others:
        names = {one.lower().replace("_", "-") for one in provided.get(name, ())}
        assert names & declared, f"{name}, of {sorted(names)}, is not in pyproject.toml"


def test_datasets_is_no_package_for_it_would_hide_the_one_that_lerobot_imports():
    assert not list((ROOT / "datasets").rglob("__init__.py"))


def test_no_tracked_file_names_a_package_registry():
    # Put together here, or this file would be found.
    hosts = [
        f"{name}.{domain}"
        for name, domain in (
            ("pypi", "org"),
            ("pythonhosted", "org"),
            ("npmjs", "org"),
            ("deb.debian", "org"),
            ("download.pytorch", "org"),
        )
    ]
    for path in tracked_files():
        data = path.read_bytes().lower()
        found = [host for host in hosts if host.encode() in data]
        assert not found, f"{path.relative_to(ROOT)} names {found}"


def test_modules_stay_small():
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            lines = len(path.read_text().splitlines())
            assert lines <= 400, f"{path.relative_to(ROOT)} has {lines} lines"


@pytest.mark.parametrize("command", COMMANDS)
def test_help_needs_nothing_heavy(command):
    module, function = COMMANDS[command].split(":")
    script = (
        f"import sys; sys.argv = [{command!r}, '--help']\n"
        f"from {module} import {function}\n"
        f"try:\n    {function}()\nexcept SystemExit as stop:\n    assert not stop.code\n"
        f"print('LOADED', sorted({HEAVY!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "usage:" in done.stdout
    assert done.stdout.splitlines()[-1] == "LOADED []"
