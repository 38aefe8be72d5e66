"""What a fresh clone relies on: commands, pins, types, and imports that cost nothing."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from importlib.metadata import distribution, packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
LOCKS = ("requirements.lock", "runtime.lock")
PIN = re.compile(r"(?P<name>[a-z0-9-]+)==(?P<version>[a-z0-9.]+)(?P<marker> ; [^/\\]+)? \\")
HASH = re.compile(r"    --hash=sha256:[0-9a-f]{64}(?: \\)?")


def pins(lock: str) -> dict[str, set[str]]:
    """Versions that a lock file allows, by package; two where they depend on Python's version."""
    found: dict[str, set[str]] = {}
    for line in (ROOT / "deploy" / lock).read_text().splitlines():
        if match := PIN.fullmatch(line):
            found.setdefault(match["name"], set()).add(match["version"])
    return found


def imported(file: Path) -> set[str]:
    """Top-level names of the packages that a source file imports anywhere."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split(".")[0])
    return names


def test_the_readme_opens_with_the_two_commands():
    opening = (ROOT / "README.md").read_text().splitlines()[:20]
    assert {"make demo", "make test"} <= {command for line in opening for command in re.findall(r"make \w+", line)}


@pytest.mark.parametrize("lock", LOCKS)
def test_locks_hold_pins_with_hashes_and_name_no_host(lock: str):
    lines = (ROOT / "deploy" / lock).read_text().splitlines()
    for number, line in enumerate(lines):
        assert line.lstrip().startswith("#") or PIN.fullmatch(line) or HASH.fullmatch(line), line
        assert "://" not in line
        if PIN.fullmatch(line):
            assert HASH.fullmatch(lines[number + 1])


def test_locks_fit_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for lock, wanted in (
        ("requirements.lock", [*project["dependencies"], *extras["dev"], *extras["build"]]),
        ("runtime.lock", [*project["dependencies"], *extras["build"]]),
    ):
        pinned = pins(lock)
        for requirement in map(Requirement, wanted):
            versions = pinned[requirement.name.lower()]
            assert all(requirement.specifier.contains(version) for version in versions), requirement


def test_what_runs_is_what_is_tested():
    tested = pins("requirements.lock")
    for name, versions in pins("runtime.lock").items():
        assert versions == tested[name], name


@pytest.mark.parametrize("package", ["elps_core", "worker", "service"])
def test_packages_say_that_they_are_typed(package: str):
    assert (ROOT / package / "py.typed").is_file()


def test_every_entry_point_resolves():
    entry_points = distribution("elps").entry_points
    assert {"elps", "service", "worker"} <= entry_points.names
    for entry_point in entry_points:
        assert callable(entry_point.load()), entry_point


def test_service_and_worker_start_without_loading_mitsuba():
    program = """
import pkgutil, sys
import service, worker
for package in (service, worker):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not module.name.endswith("__main__"):
            __import__(module.name)
print(sorted({"mitsuba", "drjit"} & sys.modules.keys()))
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert (result.stdout, result.stderr) == ("[]\n", "")


def test_the_set_up_can_ask_for_system_libraries_before_any_package_is_there():
    program = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from elps_core import device; device.missing_packages()"
    subprocess.run([sys.executable, "-I", "-S", "-c", program], check=True, timeout=60)


def test_the_set_up_refuses_an_old_python_in_one_line(tmp_path: Path):
    for name in ("deploy", "pyproject.toml"):
        (tmp_path / name).symlink_to(ROOT / name)
    result = subprocess.run(
        [str(tmp_path / "deploy" / "bootstrap.sh")],
        env={"PATH": "/usr/bin:/bin", "PYTHON": "python2.7"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.returncode == 1
    assert result.stderr.startswith("setup: Python 3.11 or later is needed")
    assert len(result.stderr.splitlines()) == 1


def test_every_import_is_a_declared_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {Requirement(line).name.lower() for line in project["dependencies"]}
    ours = {"elps_core", "worker", "service"}
    packages = packages_distributions()
    for file in [file for package in sorted(ours) for file in sorted((ROOT / package).rglob("*.py"))]:
        for name in imported(file) - ours - sys.stdlib_module_names:
            assert declared & {owner.lower() for owner in packages.get(name, [])}, f"{file.relative_to(ROOT)}: {name}"
