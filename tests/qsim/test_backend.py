"""Tests the choice of the backend: no unusable LLVM ends the process, results are stored, fallbacks warn once."""

from __future__ import annotations

import glob
import os
import subprocess
import sys
from pathlib import Path

import pytest

from qsim import backend, llvm

RENDER = """
import warnings; warnings.simplefilter("ignore")
from qsim.rendering import engine
chosen = engine.select()
import mitsuba as mi, numpy as np
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "light": {"type": "constant"},
    "sensor": {"type": "perspective",
    "film": {"type": "hdrfilm", "width": 3, "height": 3, "pixel_format": "luminance"}}})
print(chosen.backend, float(np.mean(np.array(mi.render(scene, spp=1)))))
"""


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("QSIM_ENGINE", raising=False)


@pytest.mark.parametrize("number", [14, 15])
def test_an_old_llvm_is_refused_without_ending_the_process(number, tmp_path):
    """LLVM 14 raises in Dr.Jit, LLVM 15 aborts the process: neither may happen, another engine renders."""
    found = glob.glob(f"/usr/lib/*-linux-gnu/libLLVM-{number}.so*")
    if not found:
        pytest.skip(f"no LLVM {number} on this machine")
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": found[0], "XDG_CACHE_HOME": str(tmp_path)}
    child = subprocess.run([sys.executable, "-c", RENDER], env=environment, capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stderr
    chosen, mean = child.stdout.split()[-2:]
    assert chosen in backend.BACKENDS
    assert float(mean) == pytest.approx(1.0, rel=1e-4)


def ensure_llvm(python: str, tmp_path: Path, engine: str) -> subprocess.CompletedProcess[str]:
    """Run the script of `make setup` without a package manager."""
    words = ["/bin/sh", str(Path(__file__).parents[2] / ".ci" / "ensure-llvm"), python]
    environment = os.environ | {"QSIM_ENGINE": engine, "PATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=False)


def test_setup_says_that_llvm_is_missing(tmp_path):
    """It said nothing and installed nothing for weeks: the module that it asked had moved."""
    ended = ensure_llvm(sys.executable, tmp_path, "scalar")
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == "", "a library is looked for in a package manager that is not there"
    assert backend.INSTALL_HINT in ended.stderr


def test_setup_fails_if_the_backend_cannot_be_asked(tmp_path):
    ended = ensure_llvm("/bin/false", tmp_path, "scalar")
    assert ended.returncode == 1


def test_a_library_is_probed_once_until_it_changes(tmp_path, monkeypatch):
    library = tmp_path / "libLLVM.so.19.1"
    library.write_bytes(b"one")
    calls = []

    def probe(variant, path):
        calls.append(path)
        return backend.Probe("llvm", path, True, "LLVM 19")

    monkeypatch.setattr(backend, "run_probe", probe)
    for _ in range(3):
        assert backend.cached_probe("llvm_ad_mono", str(library)).works
    assert len(calls) == 1
    os.utime(library, ns=(1, 1))
    backend.cached_probe("llvm_ad_mono", str(library))
    assert len(calls) == 2


@pytest.mark.parametrize(
    ("variant", "detail", "tests"),
    [
        ("cuda", "jit_malloc(): out of memory", 2),
        ("cuda", "no frame after 180 s", 2),
        ("cuda", "OptiX is missing or too old (no libnvoptix); update the NVIDIA driver", 1),
        ("llvm", "no frame after 180 s", 2),
        ("llvm", "OSError: libatomic.so.1: cannot open shared object file: No such file or directory", 2),
        ("llvm", "older than LLVM 16, which Dr.Jit cannot use safely", 1),
    ],
)
def test_a_failure_that_may_pass_is_tested_again(tmp_path, monkeypatch, variant, detail, tests):
    """A GPU that another program filled for a moment must not be refused for ever."""
    calls = []

    def probe(name, path):
        calls.append(name)
        return backend.Probe(variant, path, False, detail)

    monkeypatch.setattr(backend, "run_probe", probe)
    library = tmp_path / "libLLVM.so.19.1"
    library.write_bytes(b"one")
    for _ in range(2):
        assert not backend.cached_probe(backend.VARIANTS[variant], str(library)).works
    assert len(calls) == tests


def test_the_report_tells_why_there_is_no_cuda(monkeypatch):
    full = backend.Probe("cuda", None, False, "jit_malloc(): out of memory")
    monkeypatch.setattr(backend, "probe_cuda", lambda: full)
    assert "jit_malloc(): out of memory" in [probe["detail"] for probe in backend.report()["probes"]]


def test_a_full_gpu_is_not_taken_for_one_without_optix(monkeypatch):
    said = "RuntimeError: jit_optix_check(): OPTIX_ERROR_DEVICE_OUT_OF_MEMORY"
    child = subprocess.CompletedProcess([], 1, stdout="", stderr=said)
    monkeypatch.setattr(backend.subprocess, "run", lambda *args, **options: child)
    probe = backend.run_probe(backend.VARIANTS["cuda"], None)
    assert not probe.works
    assert not backend.lasts(probe)


def test_hidden_gpus_have_their_own_probe(monkeypatch):
    """What was found with CUDA_VISIBLE_DEVICES empty says nothing about the GPU that a later command sees."""
    stamps = []
    monkeypatch.setattr(backend.ctypes.util, "find_library", lambda name: "libcuda.so.1")
    monkeypatch.setattr(backend, "cached_probe", lambda variant, library, stamp: stamps.append(stamp))
    for visible in ("", "0", "1"):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        backend.probe_cuda()
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    backend.probe_cuda()
    assert len(set(stamps)) == 4


def test_the_denoiser_of_a_gpu_has_a_probe_of_its_own(monkeypatch):
    """A GPU that renders may lack the file of its denoiser. Nothing of it runs here."""
    scripts = []

    def run(command, **options):
        scripts.append(command[command.index("-c") + 1])
        return subprocess.CompletedProcess([], int("OptixDenoiser" in scripts[-1]), "rendered\n", "no denoiser")

    monkeypatch.setattr(backend.ctypes.util, "find_library", lambda name: "libcuda.so.1")
    monkeypatch.setattr(backend.subprocess, "run", run)
    backend.gpu_denoises.cache_clear()
    try:
        assert backend.probe_cuda().works
        assert not backend.gpu_denoises()
    finally:
        backend.gpu_denoises.cache_clear()
    assert len(set(scripts)) == 2
    compile(scripts[1], "probe", "exec")


def test_a_file_that_is_no_library_fails_its_probe(tmp_path):
    library = tmp_path / "libLLVM.so.22.1"
    library.write_bytes(b"not a library")
    probe = backend.cached_probe("llvm_ad_mono", str(library))
    assert not probe.works
    assert probe.detail


def test_without_a_usable_llvm_the_scalar_engine_says_what_to_install(monkeypatch):
    failed = backend.Probe("llvm", "old.so", False, "older than LLVM 16")
    monkeypatch.setattr(llvm, "usable", lambda: [llvm.Library("old.so", "of the system")])
    monkeypatch.setattr(backend, "cached_probe", lambda *args: failed)
    monkeypatch.setattr(backend, "probe_cuda", lambda: backend.Probe("cuda", None, False, "no NVIDIA driver"))
    with pytest.warns(RuntimeWarning, match="apt install libllvm19"):
        chosen = backend.decide(None)
    assert chosen.variant == "scalar_rgb"
    with pytest.raises(ValueError, match=r"engine llvm does not work here .*older than LLVM 16.*install LLVM 16"):
        backend.decide("llvm")
    with pytest.raises(ValueError, match=r"engine cuda does not work here .*no NVIDIA driver"):
        backend.decide("cuda")


def test_a_gpu_without_optix_is_told_what_to_update(monkeypatch):
    """Dr.Jit's error for a driver without OptiX becomes one line with the cure; LLVM is chosen."""
    said = "Traceback ...\nRuntimeError: jit_optix_api_init(): optixQueryFunctionTable() failed: OptiX not found"

    def child(*args, **options):
        return subprocess.CompletedProcess(args, 1, stdout="", stderr=said)

    monkeypatch.setattr(backend.subprocess, "run", child)
    probe = backend.run_probe(backend.VARIANTS["cuda"], None)
    assert not probe.works
    assert probe.detail.startswith("OptiX is missing or too old")
    assert probe.detail.endswith("update the NVIDIA driver")
    works = backend.Probe("llvm", "new.so", True, "LLVM 19")
    monkeypatch.setattr(backend, "probe_cuda", lambda: probe)
    monkeypatch.setattr(llvm, "usable", lambda: [llvm.Library("new.so", "of the system")])
    monkeypatch.setattr(backend, "cached_probe", lambda *args: works)
    assert backend.decide(None).backend == "llvm"
    with pytest.raises(ValueError, match=r"engine cuda does not work here \(CUDA: OptiX is missing.*NVIDIA GPU"):
        backend.decide("cuda")


def test_a_working_gpu_is_taken_first_and_another_engine_can_be_asked_for(monkeypatch):
    """The choice of a device, with probes that answer as on a GPU machine."""
    cuda = backend.Probe("cuda", None, True, "CUDA with OptiX")
    works = backend.Probe("llvm", "new.so", True, "LLVM 19")
    monkeypatch.setattr(backend, "probe_cuda", lambda: cuda)
    monkeypatch.setattr(llvm, "usable", lambda: [llvm.Library("new.so", "of the system")])
    monkeypatch.setattr(backend, "cached_probe", lambda *args: works)
    variants = {name: backend.decide(name).variant for name in (None, *backend.BACKENDS)}
    assert variants == {None: "cuda_ad_mono", "cuda": "cuda_ad_mono", "llvm": "llvm_ad_mono", "scalar": "scalar_rgb"}


def test_an_unknown_engine_is_named(monkeypatch):
    monkeypatch.setenv("QSIM_ENGINE", "metal")
    with pytest.raises(ValueError, match="engine 'metal': expected one of cuda, llvm, scalar"):
        backend.choose()


def test_a_broken_cache_file_is_ignored(tmp_path, monkeypatch):
    (tmp_path / "qsim").mkdir()
    (tmp_path / "qsim" / "backend.json").write_text("{half a file")
    monkeypatch.setattr(backend, "run_probe", lambda variant, path: backend.Probe("llvm", path, True, "LLVM 19"))
    assert backend.cached_probe("llvm_ad_mono", sys.executable).works


def test_a_user_without_a_home_tests_in_every_process(monkeypatch):
    """Containers run as a number that no list of users has; `Path.home` raised a RuntimeError there."""
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 4_000_000_000)
    monkeypatch.setattr(backend, "run_probe", lambda variant, path: backend.Probe("llvm", path, True, "LLVM 19"))
    with pytest.warns(RuntimeWarning, match="this user has no home; set XDG_CACHE_HOME"):
        assert backend.cached_probe("llvm_ad_mono", sys.executable).works


@pytest.mark.parametrize(
    ("printed", "works"),
    [
        ("version 23\nWARN [HDRFilm] grey\n\x1b[0mrendered\n", True),
        ("version 23\nrendered\nWARN [HDRFilm] grey\n\x1b[0m", True),
        ("version 23\nrendered a mean of 0.0\n", False),
        ("version 23\n", False),
    ],
)
def test_the_lines_of_mitsuba_may_stand_before_or_after_the_answer(monkeypatch, printed, works):
    """Python keeps what it prints until it ends, unless PYTHONUNBUFFERED is set; the fast renderer seemed to fail."""
    child = subprocess.CompletedProcess([], 0, stdout=printed, stderr="")
    monkeypatch.setattr(backend.subprocess, "run", lambda *args, **options: child)
    assert backend.run_probe("llvm_ad_mono", "libLLVM.so.23.1").works == works
