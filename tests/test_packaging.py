"""What is installed is whole: a wheel works outside the checkout, with its presets, and a source archive makes the same wheel."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rangecheck.optics import PinholeCamera
from rangecheck.scan import RangeScan
from rangecheck.scan.readers import write_npz

ROOT = Path(__file__).resolve().parent.parent
BUILD = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"


def _build(source: Path, what: str, out: Path) -> Path:
    out.mkdir(exist_ok=True)
    said = subprocess.run(
        [sys.executable, "-c", BUILD, what, str(out)], cwd=source, capture_output=True, text=True, check=True
    ).stdout
    return out / said.splitlines()[-1]


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """What belongs to a release, without what tests and builds leave in a checkout."""
    source = tmp_path_factory.mktemp("source") / "rangecheck 0"
    source.mkdir()
    for name in ("rangecheck", "cli", "configs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        if (ROOT / name).exists():
            shutil.copy(ROOT / name, source)
    return source


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory):
    return _build(source, "build_wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A folder that holds the wheel and nothing of the checkout."""
    site = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    return site


def _files(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def test_the_wheel_holds_every_source_preset_and_page(source, wheel):
    wanted = {
        str(path.relative_to(source)).replace("cli/", "rangecheck_cli/", 1).replace("configs/", "rangecheck/presets/", 1)
        for name in ("rangecheck", "cli", "configs")
        for path in (source / name).rglob("*")
        if path.is_file()
    }
    assert wanted - _files(wheel) == set()
    assert not any("tests/" in name or "sample_data/" in name for name in _files(wheel))


def test_the_source_archive_makes_the_same_wheel(source, wheel, tmp_path):
    archive = _build(source, "build_sdist", tmp_path / "sdist")
    with tarfile.open(archive) as opened:
        # Debian's Python 3.11.2 has no filters yet
        opened.extractall(tmp_path, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
    (unpacked,) = tmp_path.glob("rangecheck-*")
    assert _files(_build(unpacked, "build_wheel", tmp_path / "again")) == _files(wheel)


def _run(installed: Path, folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    code = "import sys; sys.path.insert(0, sys.argv.pop(1)); from rangecheck_cli import main; main()"
    return subprocess.run(
        [sys.executable, "-I", "-c", code, str(installed), *arguments],
        cwd=folder,
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )


def test_the_wheel_works_outside_the_checkout(installed, tmp_path):
    where = "import sys; sys.path.insert(0, sys.argv[1]); import rangecheck, rangecheck_cli; print(rangecheck.__file__, rangecheck_cli.__file__)"
    said = subprocess.run(
        [sys.executable, "-I", "-c", where, str(installed)], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert all(path.startswith(str(installed)) for path in said.stdout.split())
    listed = _run(installed, tmp_path, "explain", "self-intersections")
    assert listed.returncode == 0 and "faces that run through each other" in listed.stdout
    use = "import sys; sys.path.insert(0, sys.argv[1]); from rangecheck.reflectance import load_material; print(load_material('plaster').name)"
    said = subprocess.run(
        [sys.executable, "-I", "-c", use, str(installed)], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert said.stdout == "plaster\n"
    # kernels are not all compiled once more for a folder of their own: of a few readings they are fast enough without
    write_npz(tmp_path / "few.npz", RangeScan(np.full((24, 32), 400.0), PinholeCamera(32, 24, 40.0, 40.0, 15.5, 11.5)))
    done = _run(installed, tmp_path, "run", "few.npz", "--dry-run", "--out", "out", "--config", "quick", NUMBA_DISABLE_JIT="1")
    assert done.returncode == 0, done.stderr


COMPILE = """
import numpy as np
from rangecheck.surface.normals import area_vectors_into
area_vectors_into(np.eye(3), np.array([[0, 1, 2]], np.int32), out := np.empty((1, 3)))
assert abs(out - 0.5).max() < 1e-12
"""


def test_nothing_stays_behind_when_it_is_uninstalled_after_use(wheel, tmp_path):
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", "env"], cwd=tmp_path, check=True)
    python, cache = tmp_path / "env" / "bin" / "python", tmp_path / "cache"
    pip = [sys.executable, "-m", "pip", "--quiet", "--python", str(python)]
    subprocess.run([*pip, "install", "--no-deps", "--no-index", str(wheel)], check=True)
    # the packages that it needs are those of the tests; of these itself is not found, for it is not in that folder
    around = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT", "PYTHONDONTWRITEBYTECODE")}
    around |= {"PYTHONPATH": str(Path(np.__file__).parents[1]), "XDG_CACHE_HOME": str(cache)}
    subprocess.run([python, "-c", COMPILE], cwd=tmp_path, env=around, check=True)
    assert list(cache.glob("rangecheck/*/normals.area_vectors_into*.nbi"))
    subprocess.run([*pip, "uninstall", "--yes", "rangecheck"], check=True)
    assert list((tmp_path / "env").rglob("rangecheck*")) == []
