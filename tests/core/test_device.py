"""The LLVM library is chosen before Dr.Jit can pick a bad one.

Dr.Jit loads its library once in a process, so that each case runs in a process of its own.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from elps_core import device

RENDER = """
mi = device.use("llvm_ad_rgb")
import drjit as dr
with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
    total = float(dr.sum(dr.arange(mi.Float, 1000) * 2)[0])
    from_disk = [bool(k["cache_disk"]) for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    print(total, device.describe().llvm, any(from_disk))
"""


def run(body: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ``body`` in a fresh interpreter that knows no library unless ``environment`` says so."""
    program = "\n".join(
        (
            "from elps_core import device",
            "try:",
            textwrap.indent(textwrap.dedent(body), "    "),
            "except device.DeviceUnavailable as problem:",
            "    print(f'refused: {problem}')",
        )
    )
    inherited = {name: value for name, value in os.environ.items() if name != device.LIBRARY_VARIABLE}
    return subprocess.run(
        [sys.executable, "-c", program], env=inherited | environment, capture_output=True, text=True, timeout=120
    )


def only(*patterns: str) -> str:
    return f"device.LIBRARY_PATTERNS = {patterns!r}\n"


def refusal(result: subprocess.CompletedProcess[str]) -> str:
    """The one line that the process printed, which ended by itself and not by a signal."""
    assert result.returncode == 0, result.stderr
    (line,) = result.stdout.splitlines()
    assert line.startswith("refused: "), line
    return line.removeprefix("refused: ")


@pytest.fixture
def build_library(tmp_path: Path):
    """Builds a shared library that answers LLVM's version question as told."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")

    def build(name: str, major: int | None) -> Path:
        source = "void LLVMContextCreate(void) {}\n"
        if major is not None:
            source += f"void LLVMGetVersion(unsigned *a, unsigned *b, unsigned *c) {{ if (a) *a = {major}; }}\n"
        path = tmp_path / name
        command = [compiler, "-shared", "-fPIC", "-x", "c", "-", "-o", str(path)]
        subprocess.run(command, input=source, text=True, check=True)
        return path

    return build


def old_llvm(major: int) -> str:
    found = [*Path("/usr/lib").glob(f"*/libLLVM-{major}.so.1"), *Path("/usr/lib64").glob(f"libLLVM-{major}.so")]
    if not found:
        pytest.skip(f"LLVM {major} is not installed")
    return str(found[0])


def test_finds_a_library_and_computes_with_it():
    result = run(RENDER)
    assert result.stderr == ""
    total, version, _ = result.stdout.split()
    assert float(total) == 999000.0
    assert int(version.split(".")[0]) >= device.OLDEST_LLVM


@pytest.mark.parametrize(
    ("manager", "command"),
    [
        ("apt-get", "apt-get install libllvm19"),
        ("dnf", "dnf install llvm-libs"),
        ("brew", "brew install llvm@19"),
        ("none", "install with your package manager: libLLVM-19"),
    ],
)
def test_a_missing_library_is_named_with_the_command_to_type(tmp_path: Path, manager: str, command: str):
    program = tmp_path / manager
    program.touch(mode=0o755)
    line = refusal(run(only() + 'device.use("llvm_ad_rgb")', PATH=str(tmp_path)))
    assert line.startswith("no LLVM library of version 17 or later found: type '")
    assert line.endswith(f"{command}'")


def test_what_a_minimal_system_lacks_is_listed_for_the_set_up(tmp_path: Path):
    (tmp_path / "apt-get").touch(mode=0o755)
    body = "device._open = lambda library: None\nprint(device.install_command(device.missing_packages()))"
    assert run(body, PATH=str(tmp_path)).stdout.endswith("apt-get install libatomic1 libllvm19\n")


def test_scalar_variants_need_no_library():
    result = run(only() + 'print(device.use("scalar_rgb").variant())')
    assert result.stdout.strip() == "scalar_rgb"


@pytest.mark.parametrize("major", [14, 15])
def test_a_real_library_that_is_too_old_is_refused_not_loaded_to_crash(major: int):
    library = old_llvm(major)
    assert "no LLVM library of version 17 or later" in refusal(run(only(library) + 'device.use("llvm_ad_rgb")'))
    line = refusal(run('device.use("llvm_ad_rgb")', DRJIT_LIBLLVM_PATH=library))
    assert line == "DRJIT_LIBLLVM_PATH names an LLVM older than 17: unset it, or let it name libLLVM 19"


def test_a_library_that_drjit_took_by_itself_is_refused_when_too_old():
    result = run('import drjit\ndevice.use("llvm_ad_rgb")', DRJIT_LIBLLVM_PATH=old_llvm(15))
    assert refusal(result) == "LLVM 15 was loaded with drjit: call elps_core.device.use() before importing it"


@pytest.mark.parametrize("major", [16, None])
def test_the_library_is_asked_where_its_name_does_not_tell(build_library, major: int | None):
    library = build_library("libLLVM.so", major)
    assert "no LLVM library of version 17" in refusal(run(only(str(library)) + 'device.use("llvm_ad_rgb")'))


def test_a_bad_choice_of_the_user_is_refused_in_one_line_without_its_path(tmp_path: Path):
    text = tmp_path / "libLLVM-19.so"
    text.write_text("secret content")
    for bad in (str(text), str(tmp_path / "missing.so")):
        line = refusal(run('device.use("llvm_ad_rgb")', DRJIT_LIBLLVM_PATH=bad))
        assert line == "DRJIT_LIBLLVM_PATH names no LLVM library: unset it, or let it name libLLVM 19"


def test_the_version_nearest_to_the_tested_one_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("libLLVM-14.so.1", "libLLVM-17.so.1", "libLLVM.so.18.1", "libLLVM.so.19.1", "libLLVM.so.20.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    homebrew = tmp_path / "Cellar" / "llvm" / "21.1.0" / "lib" / "libLLVM.dylib"
    homebrew.parent.mkdir(parents=True)
    homebrew.touch()
    monkeypatch.setattr(device, "LIBRARY_PATTERNS", (f"{tmp_path}/libLLVM[-.]*", f"{homebrew.parent}/libLLVM*.dylib"))
    names = [Path(path).name for path in device._candidates()]
    assert names == ["libLLVM.so.19.1", "libLLVM.so.18.1", "libLLVM.so.20.1", "libLLVM-17.so.1", "libLLVM.dylib"]


def test_variants_are_those_that_work_here():
    info = device.describe()
    assert "scalar_rgb" in info.variants
    assert "llvm_ad_rgb" in info.variants
    assert info.threads >= 1
    assert (info.device_class == "cuda") == ("cuda_ad_rgb" in info.variants)
    for variant in ("llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_rgb"):
        assert device.use(variant).variant() == variant
    with pytest.raises(device.DeviceUnavailable, match=r"unknown variant: choose one of scalar_rgb, .*llvm_ad_rgb"):
        device.use("llvm_ad_infrared")


def test_cuda_without_a_device_is_refused_and_leaves_the_variant():
    if device.describe().device_class == "cuda":
        pytest.skip("there is a CUDA device")
    mitsuba = device.use("llvm_ad_rgb")
    with pytest.raises(device.DeviceUnavailable, match="no CUDA device or driver here: choose an 'llvm_' variant"):
        device.use("cuda_ad_rgb")
    assert mitsuba.variant() == "llvm_ad_rgb"


def test_compiled_kernels_are_kept_for_the_next_process(tmp_path: Path):
    first, second = (run(RENDER, HOME=str(tmp_path)).stdout.split() for _ in range(2))
    assert (first[2], second[2]) == ("False", "True")
    assert list((tmp_path / ".drjit").glob("*.bin"))


@pytest.mark.parametrize("home", ["", "/nonexistent/home"])
def test_a_home_that_cannot_hold_the_kernel_cache_does_no_harm(home: str):
    assert run(RENDER, HOME=home).stdout.startswith("999000.0 ")
