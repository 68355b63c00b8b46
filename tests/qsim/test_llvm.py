"""Tests the search for LLVM: the user's first, then the environment's, then the system's newest; and its loading."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from qsim import llvm


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine whose LLVM lies below `tmp_path`; the environment and the system have folders of their own."""
    monkeypatch.setattr(llvm, "system_folders", lambda: [f"{tmp_path}/system/*", f"{tmp_path}/brew/opt/llvm*/lib"])
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "environment"))
    monkeypatch.setattr(llvm, "PACKAGE", "no-such-package")
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    return tmp_path


def put(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"")
    return path


def found() -> list[str]:
    return [os.path.basename(path) for path, _ in llvm.candidates()]


def test_the_users_library_is_first_then_the_environments_then_the_systems_newest(machine, monkeypatch):
    for number in (16, 19, 104, 22):
        put(machine / "system" / "lib" / f"libLLVM.so.{number}.1")
    put(machine / "environment" / "lib" / "libLLVM-17.so")
    put(machine / "conda" / "lib" / "libLLVM-18.so.1")
    monkeypatch.setenv("CONDA_PREFIX", str(machine / "conda"))
    monkeypatch.setenv(llvm.VARIABLE, str(put(machine / "mine.so")))
    names = ["mine.so", "libLLVM-17.so", "libLLVM-18.so.1"]
    names += [f"libLLVM.so.{number}.1" for number in (104, 22, 19, 16)]
    assert found() == names
    origins = [origin for _, origin in llvm.candidates()]
    assert origins == [f"named by {llvm.VARIABLE}", *["of this environment"] * 2, *["of the system"] * 4]


@pytest.mark.parametrize(
    ("name", "taken"),
    [
        ("system/x/libLLVM.so.23.1", True),
        ("system/x/libLLVM-19.so.1", True),
        ("system/x/libLLVM-17.0.6.so", True),
        ("system/x/libLLVM.19.1.dylib", True),
        ("brew/opt/llvm@19/lib/libLLVM.dylib", True),
        ("brew/opt/llvm/lib/libLLVM.dylib", True),
        ("system/x/libLLVM-15.so.1", False),
        ("system/x/libLLVM.so.14.0.6", False),
        ("brew/opt/llvm@15/lib/libLLVM.dylib", False),
        ("system/x/libLLVMSupport.so.19", False),
        ("system/x/libLLVM-C.so.19", False),
    ],
)
def test_names_of_all_systems_are_read(machine, name, taken):
    put(machine / name)
    assert found() == ([os.path.basename(name)] if taken else [])


def test_a_file_with_two_names_is_one_candidate(machine):
    real = put(machine / "system" / "x" / "libLLVM.so.19.1")
    (machine / "system" / "x" / "libLLVM-19.so").symlink_to(real.name)
    (machine / "system" / "x" / "libLLVM-20.so").symlink_to("missing")
    assert len(found()) == 1


def install(site: Path, lines: list[str]) -> None:
    """A package as an installer leaves it: its files are named relative to `site`."""
    info = site / "some_llvm-23.1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: some-llvm\nVersion: 23.1\n")
    (info / "RECORD").write_text("".join(f"{line},,\n" for line in lines))


def test_the_package_is_found_where_its_installer_put_it(machine, monkeypatch):
    """In a virtual environment, in a user's home, in a folder of `pip install --target`: its record tells."""
    site = machine / "home" / "lib" / "python3" / "site-packages"
    install(site, ["../../libLLVM.so.23.1", "../../libLTO.so.23.1", "../../x86_64-unknown-linux-gnu/libc++.so.1.0"])
    library = put(machine / "home" / "lib" / "libLLVM.so.23.1")
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr(llvm, "PACKAGE", "some-llvm")
    put(machine / "system" / "x" / "libLLVM.so.24.1")
    assert llvm.candidates()[0] == llvm.Library(str(library), "of the package some-llvm 23.1")
    library.unlink()  # a record without its file
    assert found() == ["libLLVM.so.24.1"]


def test_what_the_packages_library_needs_is_loaded_first_without_links(tmp_path):
    folder = tmp_path / "x86_64-unknown-linux-gnu"
    for name in ("libc++.so.1.0", "libunwind.so.1.0", "libc++abi.so.1.0", "libc++.modules.json"):
        put(folder / name)
    needed = [os.path.basename(path) for path in llvm.companions(str(put(tmp_path / "libLLVM.so.23.1")))]
    assert needed == ["libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0"]
    assert llvm.companions(str(put(tmp_path / "other" / "libLLVM.so.19.1"))) == []


@pytest.mark.parametrize(
    ("system", "machine", "wanted"),
    [
        ("linux", "x86_64", "pip install karellen-llvm-core"),
        ("linux", "aarch64", "(Debian, Ubuntu: apt install libllvm19)"),
        ("darwin", "arm64", "(brew install llvm)"),
    ],
)
def test_the_hint_is_that_of_the_machine(monkeypatch, system, machine, wanted):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(llvm.platform, "machine", lambda: machine)
    assert wanted in llvm.install_hint()


def test_the_package_renders_without_the_systems_llvm_and_without_its_links(tmp_path):
    """The links are made when the environment's Python first starts as somebody who may write there."""
    installed = [path for path, origin in llvm.candidates() if llvm.PACKAGE in origin]
    if not installed:
        pytest.skip(f"{llvm.PACKAGE} is not installed: `make setup` installs it where it exists")
    alone = tmp_path / "lib" / Path(installed[0]).name
    (alone.parent / "x86_64-unknown-linux-gnu").mkdir(parents=True)
    for path in [installed[0], *llvm.companions(installed[0])]:  # without links: each file under its own name only
        real = Path(os.path.realpath(path))
        shutil.copy(real, alone.parent / real.relative_to(Path(installed[0]).parent))
    code = (
        "from qsim import backend, llvm; llvm.system_folders = lambda: []\n"
        "chosen = backend.choose('llvm'); print(chosen.reason)\n"
        "from qsim import QIS, Key\n"
        "import numpy as np\n"
        "sensor, light = QIS(0.8, 1.6, 0.2, bits=3), np.full((2, 9, 7), 3.25)\n"
        "codes = [sensor.sample(light, 1 / 2000, key=Key(seed=0, clip=0), engine=e) for e in ('fast', 'reference')]\n"
        "assert (codes[0] == codes[1]).all()\n"
    )
    variables = os.environ | {llvm.VARIABLE: str(alone), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    ended = subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert str(alone) in ended.stdout


def test_a_program_that_imported_drjit_first_draws_with_what_it_has_loaded(tmp_path):
    """Another library was believed to be in use, and the process ended by SIGABRT on a processor with AVX-512."""
    code = (
        "import warnings; warnings.simplefilter('ignore')\n"
        "import drjit\n"
        "from qsim import backend, llvm\n"
        "held, chosen = llvm._held(), backend.choose()\n"
        "assert chosen.llvm_path in (None, held) or held is None, (chosen, held)\n"
        "assert chosen.llvm_path or held is None or 'set DRJIT_LIBLLVM_PATH' in chosen.reason, chosen\n"
        "from qsim import QIS, Key\n"
        "import numpy as np\n"
        "sensor, light = QIS(0.8, 1.6, 0.2, bits=3), np.full((2, 9, 7), 3.25)\n"
        "codes = [sensor.sample(light, 1 / 2000, key=Key(seed=0, clip=0), engine=e) for e in ('auto', 'reference')]\n"
        "assert (codes[0] == codes[1]).all()\n"
        "print(chosen.backend)\n"
    )
    variables = {name: value for name, value in os.environ.items() if name != llvm.VARIABLE}
    variables["XDG_CACHE_HOME"] = str(tmp_path)
    ended = subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.strip() in ("llvm", "scalar", "cuda")
